"""Fine-tuning for target views: the cameras that somebody wants rendered."""

import functools
import pathlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments import progress
from experiments.training.detail import refresh_detail
from experiments.training.gate import gated, lets_in, weigh
from experiments.training.loop import TrainingError
from experiments.training.programs import Programs
from experiments.training.setup import LabelStart, label_targets, rendered_depths
from jaxcloseup.detail import Detail
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points
from jaxcloseup.geometry.visibility import sample_where_visible
from jaxcloseup.photographs import Views
from jaxcloseup.pseudo import PseudoSettings
from jaxcloseup.train import TrainState
from jaxcloseup.windows import Windows, windows_that_see


_REPORTS = 10
_TOLERANCE = 0.05  # relative difference of depths up to which a photograph sees a surface
_LEAST_SEEN = 0.02  # share of a view's pixels that a photograph must see to be of use for it
_TOGETHER = 8  # numbers of photographs are multiples of this, so that little is compiled


class TargetData(NamedTuple):
    """What steps for target views learn from, as `Programs.run` takes it.

    Attributes:
      photographs: as training reads them, or windows of them that see what the targets see.
      labels: of the target views.
      settings: of these labels.
      steps: how many.
    """

    photographs: Views | Windows
    labels: Views
    settings: PseudoSettings
    steps: int


def target_data(
    programs: Programs,
    start: LabelStart,
    cameras: Camera,
    gate: Mapping[str, Any] | None,
    kept: pathlib.Path | None = None,
) -> TargetData:
    """What a state learns from for target views.

    Args:
      programs: the run's.
      start: the state, and the photographs with its depths.
      cameras: stacked `[Q]`, of the target views.
      gate: of warped labels, from `weigh`.
      kept: file with the detail of the state, see `find_detail`.
    """
    preset, photographs = programs.preset, programs.photographs
    settings = gated(preset.target_labels, gate)
    labels = label_targets(programs, start, cameras, preset.target_labels, settings, kept)
    steps = programs.method.target_steps(preset.field, len(labels))
    if isinstance(photographs, Windows) and preset.target_labels.label == "residual":
        render = functools.partial(programs.render, start.state)
        depths = rendered_depths(render, cameras, programs.scene)
        seen = cameras, depths, start.sources.views, start.sources.depths
        key = jax.random.fold_in(start.state.key, start.state.step)
        photographs = jax.jit(windows_that_see)(key, photographs, *seen)
    return TargetData(photographs, labels, settings, steps)


def tuned_detail(
    programs: Programs, start: LabelStart, state: TrainState, cameras: Camera, detail: Detail
) -> Detail:
    """Detail of a state that was fine-tuned for target views, of the photographs that see these.

    Args:
      programs: the run's.
      start: what fine-tuning began with.
      state: what it ended with.
      cameras: stacked `[Q]`, of the target views.
      detail: of the state that fine-tuning began with.
    """
    depths = rendered_depths(functools.partial(programs.render, state), cameras, programs.scene)
    sources = start.sources
    seen = np.asarray(_share_seen(cameras, depths, sources.views, sources.depths))
    count = max(int((seen >= _LEAST_SEEN).sum()), 1)
    count = min(-(-count // _TOGETHER) * _TOGETHER, len(seen))
    return refresh_detail(programs, state, detail, np.sort(np.argsort(-seen)[:count]).tolist())


@jax.jit
def _share_seen(cameras, depths, views, view_depths):
    """The largest share of a target view's pixels that each photograph sees, `[V]`."""
    pixels = pixel_grid(cameras.height, cameras.width)

    def of_target(item):
        camera, depth = item
        points = pixels_to_points(camera, pixels, jnp.where(depth > 0, depth, 1))

        def of_photograph(item):
            seen = sample_where_visible(*item, points, _TOLERANCE)[2]
            return jnp.mean((seen > 0) & (depth > 0))

        return jax.lax.map(of_photograph, (views.cameras, view_depths, views.weight))

    return jnp.max(jax.lax.map(of_target, (cameras, depths)), axis=0)


def fine_tune(
    programs: Programs,
    start: LabelStart,
    cameras: Camera,
    *,
    most: int | None,
    kept: pathlib.Path | None = None,
    tell: Callable[[int, int], None] = lambda done, steps: None,
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
      tell: is told ten times how many steps are done, and how many there are.

    Raises:
      TrainingError: no step was finite.
    """
    gate, state = weigh(programs, start), start.state
    if not lets_in(programs.preset.target_labels, gate):
        print("nothing is fine-tuned")
        return state
    data = target_data(programs, start, cameras, gate, kept)
    steps = min(data.steps, most or data.steps)
    coverage = float(jnp.mean(data.labels.weight))
    print(f"labels on {coverage:.0%} of the pixels to be rendered; {steps} steps", flush=True)
    if coverage == 0:
        print("nothing is fine-tuned")
        return state
    done = skipped = 0
    with progress.part("fine-tuning"):
        progress.count("fine-tuning", done, steps)
        while done < steps:
            tell(done, steps)
            count = min(-(-steps // _REPORTS), steps - done)
            state, values = programs.run("target_views", state, *data[:3], count=count)
            done, skipped = done + count, skipped + values["skipped"]
            progress.count("fine-tuning", done, steps)
    if skipped == steps:
        raise TrainingError(f"loss or gradient was not finite in each of {steps} steps for them")
    numbers = {key: value for key, value in values.items() if isinstance(value, float)}
    print("  ".join(f"{key} {value:.4g}" for key, value in numbers.items()))
    return state
