"""Read and write whole files and JSON, append to files, and find the cache folder.

Files and strict JSON are written atomically. Files of others are read only if they are ordinary
ones of a stated size: a pipe or a device may never end, and a sparse file may claim terabytes.
"""

import contextlib
import errno
import io
import json
import math
import os
import pathlib
import stat
from collections.abc import Iterator, Mapping
from typing import Any


LARGEST = 2**30  # bytes


def cache_folder() -> pathlib.Path:
    """Return the user's folder for files that a program can make again."""
    # Unlike `Path.home`, `expanduser` does not fail for a user without a home folder.
    return pathlib.Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))


def check_file(path: str | pathlib.Path, *, most: int = LARGEST) -> None:
    """Check that a path is an ordinary file of at most `most` bytes.

    Raises:
      OSError: it is not; `strerror` is the reason.
    """
    held = os.stat(path)
    if stat.S_ISDIR(held.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(held.st_mode):
        raise OSError(errno.EINVAL, "Not an ordinary file", str(path))
    if held.st_size > most:
        raise OSError(errno.EFBIG, f"More than {most / 2**20:g} MiB", str(path))


def read_bytes(path: str | pathlib.Path, *, most: int = LARGEST) -> bytes:
    """Read an ordinary file of at most `most` bytes.

    Raises:
      OSError: the file is missing, unreadable, larger, or not an ordinary one; `strerror` is the
        reason.
    """
    check_file(path, most=most)
    return pathlib.Path(path).read_bytes()


def read_object(path: str | pathlib.Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
      OSError: the file cannot be read.
      ValueError: it holds no object; the message says what is wrong.
    """
    try:
        value = json.loads(read_bytes(path))
    except RecursionError:
        raise ValueError("it is nested too deep") from None
    if not isinstance(value, dict):
        raise ValueError("it is not an object")
    return value


def write_file(path: str | pathlib.Path, data: bytes) -> None:
    """Write `data` to `path` and create its folders; nobody sees half a file, even after a crash.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    with writing(path) as file:
        file.write(data)


@contextlib.contextmanager
def writing(path: str | pathlib.Path) -> Iterator[io.BufferedRandom]:
    """Yield an open file, which may be read and sought too, that becomes `path` in the end.

    As `write_file`, for what should not be in memory as a whole.
    """
    path = pathlib.Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with part.open("w+b") as file:
                yield file
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise _unwritable(path, error) from error


def write_json(path: str | pathlib.Path, value: Any) -> None:
    """Write `value` as strict JSON, atomically; numbers that are not finite become null.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    write_file(path, json.dumps(strict(value), indent=1, allow_nan=False).encode())


def strict(value: Any) -> Any:
    """Copy a value for strict JSON, with None in place of numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: strict(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [strict(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def append_file(path: str | pathlib.Path, data: bytes) -> None:
    """Append `data` to `path`; create the file and its folders if they do not exist.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    path = pathlib.Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") as file:
            file.write(data)
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: pathlib.Path, error: OSError) -> OSError:
    return OSError(
        f"{path} cannot be written ({error.strerror}): choose another output folder or make room "
        "in this one."
    )
