"""Flags and set-up that the programs of `experiments` share."""

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
    "folder of the weights of LPIPS, vgg16-*.pth with vgg.pth or alexnet-*.pth with alex.pth; "
    "default: $JAXCLOSEUP_LPIPS, or PyTorch's cache",
)
flags.DEFINE_string(
    "compilation_cache",
    None,
    "folder of compiled programs, kept between runs; empty: none; default: under ~/.cache",
)


flags.DEFINE_string(
    "output_dir",
    None,
    "where results go; default outputs/<scene>/<method>/<date_time>, and of renders "
    "<run>/videos/<date_time>",
)


def set_up() -> None:
    """Compile into the cache of the flags, and say only what concerns the user."""
    set_up_compilation_cache(FLAGS.compilation_cache)
    # Warnings are sentences for the user; notes on absent accelerators, on every file of a
    # checkpoint, or that are printed anyway are not.
    warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
    logging.getLogger("jax._src.xla_bridge").setLevel(logging.WARNING)
    logging.getLogger("jaxcloseup").setLevel(logging.WARNING)
    # Errors of Orbax come with a traceback, and are raised too.
    logging.getLogger("absl").setLevel(logging.CRITICAL)


def set_up_compilation_cache(folder: str | None) -> None:
    """Keep compiled programs on disk, so that the next run starts at once."""
    if folder is None:
        folder = str(cache_folder() / "jaxcloseup" / "xla")
    if folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


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
