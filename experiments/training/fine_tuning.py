"""Fine-tuning a stored state for target views: the cameras that somebody wants rendered."""

import pathlib

import jax.numpy as jnp

from experiments.training.gate import weigh
from experiments.training.loop import TrainingError
from experiments.training.programs import Programs
from experiments.training.setup import LabelStart, label_targets
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.train import TrainState


def fine_tune(
    programs: Programs,
    start: LabelStart,
    cameras: Camera,
    *,
    most: int | None,
    kept: pathlib.Path | None = None,
) -> TrainState:
    """Train a state for target views, with labels made once for them.

    Where the preset has a gate, it weighs warped labels again. Without labels the state stays as it
    is.

    Args:
      programs: the run's.
      start: the state, and the photographs with its depths.
      cameras: stacked `[Q]`, of the target views.
      most: the largest number of steps in all; by default the method's.
      kept: file with the detail of the state, see `find_detail`.

    Raises:
      TrainingError: no step was finite.
    """
    preset, method, state = programs.preset, programs.method, start.state
    settings, gate = weigh(programs, start)
    if gate is not None and not gate["weight"]:
        print("nothing is fine-tuned")
        return state
    labels = label_targets(programs, start, cameras, preset.labels, settings, kept)
    steps = method.target_steps(preset.field, cameras.intrinsics.shape[0])
    steps = min(steps, most or steps)
    coverage = float(jnp.mean(labels.weight))
    print(f"labels on {coverage:.0%} of the pixels to be rendered; {steps} steps", flush=True)
    if coverage == 0:
        print("nothing is fine-tuned")
        return state
    views = programs.photographs
    state, values = programs.run("target_views", state, views, labels, settings, count=steps)
    if values["skipped"] == steps:
        raise TrainingError(f"loss or gradient was not finite in each of {steps} steps for them")
    numbers = {key: value for key, value in values.items() if isinstance(value, float)}
    print("  ".join(f"{key} {value:.4g}" for key, value in numbers.items()))
    return state
