"""Fine-tuning for target views: the cameras that somebody wants rendered."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.gate import gated, lets_in, weigh
from jaxcloseup.app.run.kept_detail import FindDetail, refresh_detail
from jaxcloseup.app.run.loop import TrainingError
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.setup import LabelStart, label_targets, rendered_depths
from jaxcloseup.detail.add import Detail
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.labels.config import LabelConfig
from jaxcloseup.labels.make import PseudoSettings
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.gather import gather
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.views import Views, camera_at
from jaxcloseup.photos.windows import Windows, view_windows, windows_that_see
from jaxcloseup.training.steps import TrainState


_REPORTS = 10
_ENOUGH = 0.95  # share of a view's detail that the photographs must carry that are rendered for it
_PIXELS = 4096  # of a view, that tell these shares
_TOGETHER = 8  # numbers of photographs are multiples of this, so that little is compiled


class TargetData(NamedTuple):
    """What steps for target views begin with and learn from, as `Programs.run` takes it.

    Attributes:
      state: with what the method adds to it for these labels.
      photographs: as training reads them, or windows of them that see what the targets see.
      labels: of the target views, or windows of those that are larger than training's.
      settings: of these labels.
      steps: how many.
      coverage: share of the target views that has labels.
    """

    state: TrainState
    photographs: Views | Windows
    labels: Views | Windows
    settings: PseudoSettings
    steps: int
    coverage: float


def target_data(
    programs: Programs,
    start: LabelStart,
    cameras: Camera,
    how: LabelConfig,
    settings: PseudoSettings,
    find: FindDetail,
) -> TargetData:
    """What a state learns from for target views.

    Args:
      programs: the run's.
      start: the state, and the photographs with its depths.
      cameras: stacked `[Q]`, of the target views.
      how: how these are labeled.
      settings: of warps, after the gate, and of the steps.
      find: finds the detail of the state, if labels need it.
    """
    method, field, state = programs.method, programs.preset.field, start.state
    photographs, render = programs.photographs, functools.partial(programs.render, state)
    labels = label_targets(programs, start, cameras, how, settings, find)
    steps, coverage = method.target_steps(field, len(labels)), float(jnp.mean(labels.weight))
    if how.label == "residual":
        key_add, key_windows = jax.random.split(jax.random.fold_in(state.key, state.step))
        state = method.add_for_targets(key_add, field, state, labels, render, programs.scene)
        if isinstance(photographs, Windows):
            depths = rendered_depths(render, cameras, programs.scene)
            seen = cameras, depths, start.sources.views, start.sources.depths
            photographs = jax.jit(windows_that_see)(key_windows, photographs, *seen)
            height, width = photographs.size
            # What is compiled for windows of photographs serves, and a step takes as long.
            if _is_larger(labels.cameras, height, width):
                labels = view_windows(labels, height, width)
    return TargetData(state, photographs, labels, settings, steps, coverage)


def _is_larger(cameras, height, width):
    """Whether images hold such a window, and are not just that."""
    holds = cameras.height >= height and cameras.width >= width
    return holds and (cameras.height, cameras.width) != (height, width)


def tuned_detail(programs: Programs, state: TrainState, cameras: Camera, detail: Detail) -> Detail:
    """Detail of a state that was fine-tuned for target views, of the photographs that it needs.

    Args:
      programs: the run's.
      state: what fine-tuning ended with.
      cameras: stacked `[Q]`, of the target views.
      detail: of the state that fine-tuning began with.
    """
    shares = []
    for index in range(cameras.intrinsics.shape[0]):
        camera = camera_at(cameras, index)
        depth = label_depth(programs.render(state, camera), near=0, far=programs.scene.far)
        shares.append(np.asarray(_shares(detail, camera, depth)))
    shares = np.stack(shares)
    order = np.argsort(-shares, axis=1)
    reached = np.cumsum(np.take_along_axis(shares, order, axis=1), axis=1)
    needed = [own[: np.sum(sums < _ENOUGH) + 1] for own, sums in zip(order, reached, strict=True)]
    count = len(np.unique(np.concatenate(needed)))
    count = min(-(-count // _TOGETHER) * _TOGETHER, len(detail.sources.trust))
    views = np.argsort(-shares.max(axis=0), kind="stable")[:count]
    return refresh_detail(programs, state, detail, np.sort(views).tolist())


@jax.jit
def _shares(detail, camera, depth):
    """The share of each photograph in what is gathered into a view, `[V]`; its sum is at most 1."""
    count = detail.sources.trust.shape[0]
    # Each photograph shows nothing but its own number, in as fine pixels as it has.
    numbers = Pyramid(jnp.eye(count)[:, None], detail.shown.intrinsics[:, :1], ((1, 1),))
    every = max(1, round((depth.size / _PIXELS) ** 0.5))
    pixels = pixel_grid(camera.height, camera.width)[::every, ::every]
    found = gather(camera, pixels, depth[::every, ::every], detail.sources, numbers)
    return jnp.mean(found.mean, axis=(0, 1))


def fine_tune(
    programs: Programs,
    start: LabelStart,
    cameras: Camera,
    find: FindDetail,
    *,
    most: int | None = None,
    tell: Callable[[int, int], None] = lambda done, steps: None,
) -> TrainState:
    """Train a state for target views, with labels made once for them.

    Where the preset has a gate, it weighs warped labels again. Without labels the state stays as it
    is.

    Args:
      programs: the run's.
      start: the state, and the photographs with its depths.
      cameras: stacked `[Q]`, of the target views.
      find: finds the detail of the state, if labels need it.
      most: the largest number of steps in all; by default the method's.
      tell: is told ten times how many steps are done, and how many there are.

    Raises:
      TrainingError: no step was finite.
    """
    labels, state = programs.preset.target_labels, start.state
    gate = weigh(programs, start) if labels.label == "warp" else None
    if not lets_in(labels, gate):
        print("nothing is fine-tuned")
        return state
    data = target_data(programs, start, cameras, labels, gated(labels, gate), find)
    steps = min(data.steps, most or data.steps)
    print(f"labels on {data.coverage:.0%} of the pixels to be rendered; {steps} steps", flush=True)
    if data.coverage == 0:
        print("nothing is fine-tuned")
        return state
    state, *learned = data[:4]
    done = skipped = 0
    with progress.part("fine-tuning"):
        progress.count("fine-tuning", done, steps)
        while done < steps:
            tell(done, steps)
            count = min(-(-steps // _REPORTS), steps - done)
            state, values = programs.run("target_views", state, *learned, count=count)
            done, skipped = done + count, skipped + values["skipped"]
            progress.count("fine-tuning", done, steps)
    if skipped == steps:
        raise TrainingError(f"loss or gradient was not finite in each of {steps} steps for them")
    numbers = {key: value for key, value in values.items() if isinstance(value, float)}
    print("  ".join(f"{key} {value:.4g}" for key, value in numbers.items()))
    return state
