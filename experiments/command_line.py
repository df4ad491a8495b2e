"""Flags and setup that the programs of `experiments` share."""

import logging
import pathlib
import sys
import warnings

import jax
from absl import flags

from jaxcloseup.files import cache_folder


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
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise FileExistsError(
            f"--output_dir={folder} already exists and is not empty: name a new folder, or remove "
            "it first"
        )
    return path


def make_output_dir(folder: pathlib.Path) -> None:
    """Create the output folder and its parents if they do not exist.

    Raises:
      OSError: the folder cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(
            f"--output_dir={folder} cannot be created ({error.strerror}): name a folder where you "
            "may write"
        ) from error
