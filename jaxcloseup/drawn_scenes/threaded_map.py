"""Run host code in threads."""

import concurrent.futures
from collections.abc import Callable, Sequence
from typing import TypeVar


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def map_in_threads(fn: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    """Map `fn` over items, two at a time, because XLA runs such small loops on one core."""
    first = fn(items[0])  # alone, so that threads do not compile the same code twice
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        return [first, *pool.map(fn, items[1:])]
