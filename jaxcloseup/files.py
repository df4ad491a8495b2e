"""Write whole files and strict JSON atomically, append to files, and find the cache folder."""

import json
import math
import os
import pathlib
from collections.abc import Mapping
from typing import Any


def cache_folder() -> pathlib.Path:
    """The user's folder for files that a program can make again."""
    # Unlike `Path.home`, `expanduser` does not fail for a user without a home folder.
    return pathlib.Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))


def write_file(path: str | pathlib.Path, data: bytes) -> None:
    """Write `data` to `path` and create its folders; nobody sees half a file, even after a crash.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    path = pathlib.Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.write_bytes(data)
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


def _unwritable(path, error):
    return OSError(
        f"{path} cannot be written ({error.strerror}): choose another output folder or make room "
        "in this one."
    )
