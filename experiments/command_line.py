"""Flags and setup that the programs of `experiments` share."""

import contextlib
import functools
import logging
import os
import pathlib
import shlex
import sys
import warnings
from collections.abc import Callable
from typing import Any

import jax
from absl import app, flags

import experiments
from jaxcloseup.files import cache_folder


try:
    import fcntl
except ImportError:  # not a Unix: nothing is locked
    fcntl = None


LOCK = ".lock"  # in a folder that a program trains in
CHECKPOINTS = "checkpoints"  # its folder that can be resumed from
FLAGS = flags.FLAGS
flags.DEFINE_string(
    "lpips_weights",
    None,
    "folder of LPIPS weights: vgg16-*.pth with vgg.pth, or alexnet-*.pth with alex.pth; "
    "default: $JAXCLOSEUP_LPIPS, or PyTorch's cache",
)
flags.DEFINE_string(
    "compilation_cache",
    None,
    "folder that keeps compiled programs between runs; empty: no cache; default: under ~/.cache",
)
flags.DEFINE_string(
    "output_dir",
    None,
    "folder for results; default: outputs/<scene>/<method>/<date_time>, and for "
    "experiments.render <run>/videos/<date_time>",
)


def start(main: Callable[[list[str]], None]) -> None:
    """Run a program; `--help` and `-h` print its flags, and a wrong flag is one sentence."""
    if {"-h", "--help"} & set(sys.argv[1:]):
        try:
            app.run(main, argv=[sys.argv[0], "--help"])
        except SystemExit:
            sys.exit(0)
    call = functools.partial
    app.run(call(_in_a_sentence, main), flags_parser=call(_in_a_sentence, FLAGS))


def _in_a_sentence(call, words):
    """Call with the command line's words; what is wrong with them is one sentence."""
    try:
        return call(words)
    except (flags.Error, app.UsageError) as error:
        program = pathlib.Path(words[0]).stem
        sys.exit(f"experiments.{program}: {' '.join(str(error).split())} (--help lists the flags)")


def set_up() -> None:
    """Set up the compilation cache, and silence messages that do not concern the user."""
    set_up_compilation_cache(FLAGS.compilation_cache)
    # The program's own warnings are sentences for the user. Notes about missing accelerators, about
    # every file of a checkpoint, and repeats of what the program prints are not.
    warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
    logging.getLogger("jax._src.xla_bridge").setLevel(logging.WARNING)
    logging.getLogger("jaxcloseup").setLevel(logging.WARNING)
    # Orbax logs errors with a traceback, and raises them too.
    logging.getLogger("absl").setLevel(logging.CRITICAL)


def set_up_compilation_cache(folder: str | None) -> None:
    """Keep compiled programs on disk, so that the next run starts faster.

    Args:
      folder: cache folder; None for the default one, empty for no cache.
    """
    if folder is None:
        folder = str(cache_folder() / "jaxcloseup" / "xla")
    if folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def check_unused(folder: str | pathlib.Path) -> pathlib.Path:
    """Return the path of an output folder, which must be empty or not exist yet.

    Raises:
      FileExistsError: the folder holds files, or the path is a file.
    """
    path = pathlib.Path(folder)
    if path.exists() and (not path.is_dir() or any(one.name != LOCK for one in path.iterdir())):
        raise FileExistsError(
            f"--output_dir={folder} already exists and is not empty: name a new folder, or remove "
            "it first"
        )
    return path


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


def prepare_to_stop(folder: pathlib.Path, program: str | None = None) -> None:
    """Let Ctrl-C remove unfinished files from an output folder, and print how to resume.

    Args:
      folder: the output folder.
      program: name of a program that resumes training in it; None cannot be resumed.
    """
    arguments = sys.argv[1:]
    if FLAGS.output_dir is None:
        arguments += [f"--output_dir={folder}"]

    def say():
        for part in folder.rglob(f".*.{os.getpid()}.part*"):
            part.unlink(missing_ok=True)
        if program is None:
            return "stopped"
        if not (folder / CHECKPOINTS).is_dir():
            return "stopped before training began: give the same command again"
        resume = [] if "--resume" in arguments else ["--resume"]
        command = shlex.join(["python", "-m", program, *arguments, *resume])
        return f"stopped: resume it with {command}"

    experiments.when_stopped(say)
