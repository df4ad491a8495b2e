"""Read how much memory is installed and was taken, and keep or return freed memory."""

import contextlib
import ctypes
import os
import pathlib
import platform
import re
from collections.abc import Iterator


def installed_memory() -> int:
    """Return the memory of this computer, or of its container, in bytes."""
    held = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with contextlib.suppress(OSError, ValueError):  # the file says "max" without a limit
        held = min(held, int(pathlib.Path("/sys/fs/cgroup/memory.max").read_text()))
    return held


def peak_memory() -> int | None:
    """Return the largest resident memory of this process so far in bytes; None if unknown.

    On Linux it is VmHWM of proc(5), for getrusage(2) counts what the starting program had, too.
    """
    with contextlib.suppress(OSError):
        status = pathlib.Path("/proc/self/status").read_text()
        if found := re.search(r"^VmHWM:\s*(\d+) kB$", status, re.MULTILINE):
            return int(found[1]) * 2**10
    try:
        import resource
    except ImportError:  # not a Unix
        return None
    unit = 1 if platform.system() == "Darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


# Parameters of glibc's mallopt.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MAX, _ARENA_MAX = -1, -3, -4, -8
_LARGE = 2**25  # bytes, the largest M_MMAP_THRESHOLD of mallopt(3)
_MMAP_MAX_DEFAULT = 2**16


def reuse_freed_memory() -> None:
    """Keep freed buffers of up to 32 MiB, until `give_back_memory`; call it before JAX starts.

    XLA's buffers live for a part of a program. By default glibc gives them back to the system,
    which must find and zero their pages again. Larger ones go back: kept, they leave gaps between
    what stays, and a run on large photographs took a quarter more memory.
    """
    _set(_ARENA_MAX, 1)  # threads free what others allocated
    _set(_MMAP_THRESHOLD, _LARGE)
    _set(_TRIM_THRESHOLD, 2**31 - 1)


@contextlib.contextmanager
def reusing_large_buffers() -> Iterator[None]:
    """Keep larger buffers too, in a body whose steps take the same ones again and again."""
    _set(_MMAP_MAX, 0)
    try:
        yield
    finally:
        _set(_MMAP_MAX, _MMAP_MAX_DEFAULT)


def _set(parameter: int, value: int) -> None:
    with _other_libraries():
        ctypes.CDLL(None).mallopt(parameter, value)


def give_back_memory() -> None:
    """Return freed memory to the system, such as hundreds of MiB that a compilation took."""
    with _other_libraries():
        ctypes.CDLL(None).malloc_trim(0)


def _other_libraries() -> contextlib.suppress:
    """Ignore that a C library other than glibc cannot be loaded or lacks these functions."""
    return contextlib.suppress(OSError, TypeError, AttributeError)
