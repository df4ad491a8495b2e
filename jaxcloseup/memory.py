"""How much memory there is, so that what cannot fit is refused before it is begun."""

import contextlib
import os
import pathlib


def installed_memory() -> int:
    """Memory of this computer, or of the container, in bytes."""
    held = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with contextlib.suppress(OSError, ValueError):  # the file says "max" without a limit
        held = min(held, int(pathlib.Path("/sys/fs/cgroup/memory.max").read_text()))
    return held
