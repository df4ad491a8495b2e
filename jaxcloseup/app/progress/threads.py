"""Work on many values at once, as far as the host has cores for it."""

import collections
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from jaxcloseup.app.progress.display import track


_MOST = 4  # threads, each of which holds an image and what it is made from


def workers() -> int:
    """How many threads have something to do for XLA: one for each core, one alone for a GPU."""
    import jax  # not before the flags are read

    return (os.cpu_count() or 1) if jax.default_backend() == "cpu" else 1


def each(give: Callable[[Any], Any], values: Sequence[Any], what: str) -> Iterator[Any]:
    """Yield `give(value)` of each value, in order, while threads work on the next ones.

    XLA uses several cores for large arrays alone. Two renders at once take less time than one
    after the other.

    Args:
      give: may run in another thread; its first call is over before another one begins, because
        that one compiles.
      values: any.
      what: what is done with them, see `track`.
    """
    values = list(values)
    count = min(workers(), _MOST, len(values) - 1)
    if count < 2:
        yield from map(give, track(values, what))
        return
    with ThreadPoolExecutor(count) as pool:
        waiting = collections.deque(values[1:])
        under_way = collections.deque([pool.submit(give, values[0])])
        under_way[0].result()
        try:
            for _ in track(values, what):
                while waiting and len(under_way) <= count:
                    under_way.append(pool.submit(give, waiting.popleft()))
                yield under_way.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
