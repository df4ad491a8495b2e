"""Fair timing on shared, noisy machines: one process, calls in turns, medians."""

import statistics
import time
from collections.abc import Callable, Mapping

import jax


REPEATS = 5


def interleaved_medians(
    calls: Mapping[str, Callable[[], object]], repeats: int = REPEATS
) -> dict[str, float]:
    """Return the median wall seconds of each call.

    The calls take turns (A B, A B, ...), after one warm-up each.

    Args:
      calls: functions to time, by name; their results are waited for.
      repeats: number of timed calls of each function.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        jax.block_until_ready(call())
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in seconds.items()}
