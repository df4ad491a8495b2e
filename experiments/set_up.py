"""What every program of experiments begins with, and the flags for it."""

import logging
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
