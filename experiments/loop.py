"""Running a stage: steps in chunks, with rates and the time left."""

import functools
import time
from collections.abc import Callable
from typing import Any

import jax

from jaxcloseup.train import TrainState, run_steps


def make_runner(step: Callable[..., Any]) -> Callable[..., Any]:
    """`runner(state, *data, count=...)`, compiled; it leaves its input state alone."""
    return jax.jit(functools.partial(run_steps, step))


def run_stage(
    name: str,
    runner: Callable[..., Any],
    state: TrainState,
    *data: Any,
    steps: int,
) -> tuple[TrainState, list[dict[str, float]]]:
    """Take `steps` steps, reporting ten times or at least every 500 steps.

    Returns:
      The state, and for each chunk its metrics with `step`, counted within the stage.
    """
    chunk = max(1, min(-(-steps // 10), 500))
    history = []
    start = time.perf_counter()
    done = 0
    while done < steps:
        count = min(chunk, steps - done)
        state, metrics = runner(state, *data, count=count)
        done += count
        values = {key: float(value) for key, value in metrics.items()}
        history.append({"step": done} | values)
        seconds = time.perf_counter() - start
        left = seconds / done * (steps - done)
        shown = "  ".join(f"{key} {value:.4g}" for key, value in values.items())
        print(
            f"{name:>9} {done:>{len(str(steps))}}/{steps}  {done / seconds:6.1f} steps/s  "
            f"{int(left // 60)}:{int(left % 60):02d} left  {shown}",
            flush=True,
        )
    return state, history
