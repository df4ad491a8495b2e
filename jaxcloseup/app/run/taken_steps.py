"""Steps that are taken: one after the other outside of `jax.jit`, and what they say."""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.training.parallel import in_threads
from jaxcloseup.training.state import Metrics, TrainState


def run_in_parts(
    step: Callable[..., tuple[TrainState, Metrics]], state: TrainState, *, count: int
) -> tuple[TrainState, Metrics]:
    """Take `count` steps whose parts are compiled, and shared by all kinds of steps.

    Compiling the rendering of an image, with its derivative, takes as long as hundreds of steps.
    """
    metrics = []
    for i in range(count):
        # Two threads would compile the same parts, so the first step takes one.
        state, measured = step(state, spread=in_threads(progress.workers() if i else 1))
        # No step begins before the last one ends: what waits would hold memory.
        metrics.append(jax.block_until_ready(measured))
    return state, jax.tree.map(lambda *values: np.mean(values, axis=0), *metrics)


def check_steps(metrics: dict[str, Any], count: int) -> dict[str, Any]:
    """Return finite means as numbers and counts of skipped steps; warn if steps were skipped."""
    skipped = np.round(metrics.pop("skipped") * count).astype(int)
    if skipped.any():
        by_arm = f", by arm: {skipped.tolist()}" if skipped.ndim else ""
        print(f"warning: {skipped.max()} of {count} steps skipped, not finite{by_arm}")
    values = {key: float(np.mean(value)) for key, value in metrics.items()}
    values = {key: value for key, value in values.items() if math.isfinite(value)}
    return values | {"skipped": skipped.tolist()}
