"""Fair timing on shared, noisy machines: one process, interleaved calls, medians."""

import statistics
import time
from collections.abc import Callable, Mapping

import jax


def interleaved_medians(
    calls: Mapping[str, Callable[[], object]], repeats: int = 5
) -> dict[str, float]:
    """Median wall seconds of calls taken in turn (A B, A B, ...), after one warm-up each."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        jax.block_until_ready(call())
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in seconds.items()}
