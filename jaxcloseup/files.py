"""Files that are either whole or not there."""

import os
import pathlib


def write_file(path: str | pathlib.Path, data: bytes) -> None:
    """Write `data` to `path`, making its folders; a reader or a crash never meets half a file.

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
        raise OSError(
            f"{path} cannot be written ({error.strerror}): choose another output folder or make "
            "room in this one."
        ) from error
