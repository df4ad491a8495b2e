"""The flag for where results go, and what a folder must be for that."""

import pathlib

from absl import flags


flags.DEFINE_string(
    "output_dir",
    None,
    "where results go; default outputs/<scene>/<method>/<date_time>, and of renders "
    "<run>/videos/<date_time>",
)


def check_unused(folder: str | pathlib.Path) -> pathlib.Path:
    """The path of a folder that does not exist yet or is empty.

    Raises:
      FileExistsError: it holds something.
    """
    path = pathlib.Path(folder)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise FileExistsError(
            f"--output_dir={folder} already holds something: name a new folder, or remove it first"
        )
    return path


def make(folder: pathlib.Path) -> None:
    """Make a folder for results, with those around it, if it is not there.

    Raises:
      OSError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(
            f"--output_dir={folder} cannot be made ({error.strerror}): name a folder where you may "
            "write"
        ) from error
