"""Output folders: never one that holds something, and only one process trains in each."""

import contextlib
import datetime
import os
import pathlib
import shlex
import sys
from typing import Any

from absl import flags

from jaxcloseup.app.cli.interrupt import when_stopped
from jaxcloseup.app.cli.invocation import program_command


try:
    import fcntl
except ImportError:  # not a Unix: nothing is locked
    fcntl = None  # type: ignore[assignment]


LOCK = ".lock"  # in a folder that a program trains in
CHECKPOINTS = "checkpoints"  # its folder that can be resumed from
FLAGS = flags.FLAGS


def dated(parent: str | pathlib.Path) -> pathlib.Path:
    """Return a folder within another whose name is the current date and time."""
    return pathlib.Path(parent, datetime.datetime.now().strftime("%Y-%m-%d_%H%M%S"))


def check_unused(folder: str | pathlib.Path) -> pathlib.Path:
    """Return the path of an output folder, which must be empty or not exist yet.

    Raises:
      FileExistsError: the folder holds files, or the path is a file.
      PermissionError: it cannot be made.
    """
    path = pathlib.Path(folder)
    if path.exists() and (not path.is_dir() or any(file.name != LOCK for file in path.iterdir())):
        raise FileExistsError(
            f"--output_dir={folder} already exists and is not empty: name a new folder, or remove "
            "it first"
        )
    check_writable(path)
    return path


def check_writable(path: pathlib.Path, flag: str = "output_dir") -> None:
    """Refuse a file or folder that surely cannot be made, before the work that it is to hold.

    `flag` is the one that names it.

    Raises:
      PermissionError: one sentence that names the flag.
    """
    there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not os.access(there, os.W_OK | os.X_OK if there.is_dir() else os.W_OK):
        raise PermissionError(
            f"--{flag}={path} cannot be written ({there} is read-only): name a place where you may "
            "write"
        )


def choose_output_dir(
    folder: str | None, scene: str, method: str, *, resume: bool = False, kept: str = CHECKPOINTS
) -> pathlib.Path:
    """Return the output folder: a new or empty one, or with `resume` that of a run to resume.

    `kept` is what such a folder holds once it can be resumed.

    Raises:
      OSError: one sentence that names the flag.
    """
    if resume:
        if folder is None or not (pathlib.Path(folder) / kept).exists():
            raise FileNotFoundError(
                f"--resume finds nothing to resume in --output_dir={folder or ''}: name the folder "
                "of a run or sweep that was cut off"
            )
        return pathlib.Path(folder)
    if folder is None:
        scene_name = os.path.basename(os.path.realpath(scene))  # of `..` too
        return check_unused(dated(pathlib.Path("outputs", scene_name, method)))
    if (pathlib.Path(folder) / kept).exists():
        raise FileExistsError(
            f"--output_dir={folder} already exists and is not empty: resume its training with "
            "--resume, or name a new folder"
        )
    return check_unused(folder)


def lock_output_dir(folder: pathlib.Path) -> contextlib.AbstractContextManager[Any]:
    """Create the output folder, and keep other processes from training in it.

    Returns:
      A context, which holds the lock until it is left or the process ends, in whatever way. Where
      files cannot be locked it holds nothing.

    Raises:
      OSError: the folder cannot be created or written, or another process trains in it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("a+")
    except OSError as error:
        raise OSError(
            f"--output_dir={folder} cannot be created or written ({error.strerror}): name a folder "
            "where you may write"
        ) from error
    if fcntl is None:
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        with file:
            file.seek(0)
            holder = file.read(20).strip() or "unknown"
        raise OSError(
            f"--output_dir={folder} is in use by the process {holder}: wait until it ends, or name "
            "another folder"
        ) from None
    except OSError:  # a file system without locks
        return file
    with contextlib.suppress(OSError):  # on a full disk the lock holds too
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
    return file


def prepare_to_stop(
    folder: pathlib.Path, program: str | None = None, *, kept: str = CHECKPOINTS
) -> None:
    """Let Ctrl-C remove unfinished files from an output folder, and print how to resume.

    `program` resumes training in the folder once it holds `kept`; None cannot be resumed.
    """
    arguments = sys.argv[1:]
    if FLAGS.output_dir is None:
        arguments += [f"--output_dir={folder}"]

    def say() -> str:
        remove_unfinished(folder)
        if program is None:
            return "stopped"
        if not (folder / kept).exists():
            used = folder.is_dir() and any(file.name != LOCK for file in folder.iterdir())
            again = f"remove {folder}, and give" if used else "give"
            return f"stopped before training began: {again} the same command again"
        resume = [] if "--resume" in arguments else ["--resume"]
        command = shlex.join([*program_command(program), *arguments, *resume])
        return f"stopped: resume it with {command}"

    when_stopped(say)


def remove_unfinished(folder: pathlib.Path) -> None:
    """Remove the files that this process has not finished."""
    for part in folder.rglob(f".*.{os.getpid()}.part*"):
        part.unlink(missing_ok=True)
