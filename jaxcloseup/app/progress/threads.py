"""Work on several values at once, as far as the host has cores."""

import collections
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from jaxcloseup.app.progress.display import track


_MOST = 4  # threads, each of which holds an image and its inputs
# Pixels of images that are worked on at once: 300 bytes each. XLA uses all cores for larger images.
_PIXELS = 2**22


def workers() -> int:
    """Return the number of threads that XLA can serve: one for each core, or one for a GPU."""
    import jax  # not before the flags are read

    return (os.cpu_count() or 1) if jax.default_backend() == "cpu" else 1


def each(
    work: Callable[[Any], Any], values: Iterable[Any], what: str, *, pixels: int = 1
) -> Iterator[Any]:
    """Yield `work(value)` for each value, in order, while threads work on the next ones.

    XLA uses several cores for large arrays only, so two renders at once take less time than one
    after the other.

    Args:
      work: may run in another thread. Its first call ends before the next begins, because it
        compiles.
      values: the values.
      what: text for `track`.
      pixels: number of pixels of the largest image, of which few are worked on at once.
    """
    values = list(values)
    count = min(workers(), _MOST, len(values) - 1, _PIXELS // pixels)
    if count < 2:
        yield from map(work, track(values, what))
        return
    with ThreadPoolExecutor(count) as pool:
        waiting = collections.deque(values[1:])
        under_way = collections.deque([pool.submit(work, values[0])])
        under_way[0].result()
        try:
            for _ in track(values, what):
                while waiting and len(under_way) <= count:
                    under_way.append(pool.submit(work, waiting.popleft()))
                yield under_way.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
