"""Loads the native library, which is built when the package is installed, if a compiler is there.

XLA calls its functions by name (`jax.ffi`). Everything that uses it has a twin in JAX, which runs
where there is no library.
"""

import ctypes
import functools
import pathlib

import jax


# The functions that XLA may call, of `splats.cc`, `surfels.cc`, `gather.cc`, `stereo.cc`,
# `hash_grid.cc` and `ssim.cc`.
TARGETS = (
    *("splats_forward", "splats_backward", "splats_count"),
    *("surfels_forward", "surfels_backward"),
    *("gather", "stereo", "hash_forward", "hash_backward", "ssim"),
)

INSTALL = (
    "install g++ or clang++ (Debian and Ubuntu: apt-get install g++), then install jaxcloseup again"
)


class LibraryError(OSError):
    """The library was asked for, and cannot be loaded."""


def path() -> pathlib.Path | None:
    """Return the library's file, or None if it was not built."""
    file = pathlib.Path(__file__).with_name("_native.lib.so")
    return file if file.exists() else None


@functools.cache
def missing() -> str | None:
    """Load the library on the first call; return None if it is loaded, else why it is not."""
    file = path()
    if file is None:
        return "the native library was not built"
    try:
        library = ctypes.CDLL(str(file))
        for name in TARGETS:
            capsule = jax.ffi.pycapsule(getattr(library, name))
            jax.ffi.register_ffi_target(f"jaxcloseup_{name}", capsule, platform="cpu")
    except Exception as error:  # whatever keeps it from loading
        reason = str(error).splitlines() or [type(error).__name__]
        return f"the native library cannot be loaded: {reason[0]}"
    return None


def require(wanted: str, instead: str) -> None:
    """Load the library.

    Args:
      wanted: what needs it.
      instead: what to do where it is not there.

    Raises:
      LibraryError: it is not there, or cannot be loaded.
    """
    if why := missing():
        raise LibraryError(f"{wanted} cannot run: {why}; {INSTALL}, or {instead}")


def available() -> bool:
    """Return whether programs for CPUs can call the library."""
    return missing() is None
