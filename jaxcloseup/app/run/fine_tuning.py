"""Fine-tuning for target views: the cameras that somebody asks to be rendered."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.gate import gated, uses_labels, weigh
from jaxcloseup.app.run.kept_detail import GetDetail, refresh_detail
from jaxcloseup.app.run.labels import LabelStart, label_target_views, rendered_depths
from jaxcloseup.app.run.loop import TrainingError, describe_means
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.step_data import LabeledData
from jaxcloseup.detail.add import Detail
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.labels.config import LabelConfig
from jaxcloseup.labels.make import PseudoSettings
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.gather import gather
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.views import Views, camera_at
from jaxcloseup.photos.windows import Windows, view_windows, windows_that_see
from jaxcloseup.training.state import TrainState


_REPORTS = 10
_ENOUGH = 0.95  # share of a view's detail that the photographs rendered for it must carry
_PIXELS = 4096  # of a view, on which these shares are measured
_TOGETHER = 8  # numbers of photographs are multiples of this, so that few shapes are compiled


class TargetTraining(NamedTuple):
    """What training for target views begins with and learns from."""

    state: TrainState  # the first state, with what the method adds to it for these labels
    data: LabeledData  # what the steps learn from
    steps: int
    coverage: float  # share of the target views' pixels that have labels


def prepare_target_views(
    programs: Programs,
    start: LabelStart,
    cameras: Camera,
    labels: LabelConfig,
    settings: PseudoSettings,
    get_detail: GetDetail,
) -> TargetTraining:
    """Label target views, and prepare what a state learns from for them.

    `settings` are of warps, after the gate, and of the steps.
    `get_detail` is called if labels need it.
    """
    method, field, state = programs.method, programs.preset.field, start.state
    photographs, render = programs.photographs, functools.partial(programs.render, state)
    views = label_target_views(programs, start, cameras, labels, settings, get_detail)
    steps, coverage = method.target_steps(field, len(views)), float(jnp.mean(views.weight))
    learned: Views | Windows = views
    if labels.label == "residual":
        key_add, key_windows = jax.random.split(jax.random.fold_in(state.key, state.step))
        state = method.add_for_targets(key_add, field, state, views, render, programs.scene)
        if isinstance(photographs, Windows):
            depths = rendered_depths(render, cameras, programs.scene)
            photographs = windows_that_see(
                key_windows, photographs, cameras, depths, start.sources.views, start.sources.depths
            )
            # What is compiled for windows of photographs serves windows of labels too, and a step
            # takes as long.
            if _is_larger(cameras, photographs.size):
                learned = view_windows(views, *photographs.size)
    return TargetTraining(state, LabeledData(photographs, learned, settings), steps, coverage)


def _is_larger(cameras: Camera, size: tuple[int, int]) -> bool:
    """Return True if images hold a window of this height and width, and are not just that."""
    height, width = size
    holds = cameras.height >= height and cameras.width >= width
    return holds and (cameras.height, cameras.width) != size


def tuned_detail(programs: Programs, state: TrainState, cameras: Camera, detail: Detail) -> Detail:
    """Return the detail of a fine-tuned state, of the photographs that its target views need.

    `detail` is of the state before fine-tuning.
    """
    shares = np.stack(
        [
            np.asarray(_shares(programs, state, camera_at(cameras, index), detail))
            for index in range(cameras.intrinsics.shape[0])
        ]
    )
    order = np.argsort(-shares, axis=1)
    reached = np.cumsum(np.take_along_axis(shares, order, axis=1), axis=1)
    counts = np.sum(reached < _ENOUGH, axis=1) + 1
    needed = [views[:count] for views, count in zip(order, counts, strict=True)]
    first = np.unique(np.concatenate(needed))
    count = min(-(-len(first) // _TOGETHER) * _TOGETHER, len(detail.sources.maps))
    others = np.argsort(-shares.max(axis=0), kind="stable")
    views = [*first, *others[~np.isin(others, first)]][:count]
    return refresh_detail(programs, state, detail, sorted(map(int, views)))


def _shares(programs: Programs, state: TrainState, camera: Camera, detail: Detail) -> jax.Array:
    depth = label_depth(programs.render(state, camera), near=0, far=programs.scene.far)
    return _shares_at(detail, camera, depth)


@jax.jit
def _shares_at(detail: Detail, camera: Camera, depth: jax.Array) -> jax.Array:
    """Return each photograph's share in what a view gathers, `[V]`; the sum is 1, or 0 of nothing.

    Pixels that no photograph shows have no part in it.
    """
    count = len(detail.sources.maps)
    # Each photograph shows nothing but its own number, in as fine pixels as it has.
    one = jnp.ones((count, 1, 2), jnp.int32)
    numbers = Pyramid(jnp.eye(count), detail.shown.intrinsics[:, :1], one)
    every = max(1, round((depth.size / _PIXELS) ** 0.5))
    pixels = pixel_grid(camera.height, camera.width)[::every, ::every]
    gathered = gather(camera, pixels, depth[::every, ::every], detail.sources, numbers)
    parts = jnp.sum(gathered.mean, axis=(0, 1))
    return safe_divide(parts, jnp.sum(parts))


def fine_tune(
    programs: Programs,
    start: LabelStart,
    cameras: Camera,
    get_detail: GetDetail,
    *,
    most: int | None = None,
    report: Callable[[int, int], None] = lambda done, steps: None,
) -> TrainState:
    """Train a state for target views, with labels made once for them.

    Where the preset has a gate, it weighs warped labels again. Without labels the state stays as it
    is.

    `most` bounds the steps; `report(done, steps)` is called ten times.

    Raises:
      TrainingError: no step was finite.
    """
    labels, state = programs.preset.target_labels, start.state
    gate = weigh(programs, start) if labels.label == "warp" else None
    if not uses_labels(labels, gate):
        print("nothing is fine-tuned")
        return state
    prepared = prepare_target_views(
        programs, start, cameras, labels, gated(labels, gate), get_detail
    )
    steps = min(prepared.steps, most or prepared.steps)
    print(
        f"labels on {prepared.coverage:.0%} of the pixels to be rendered; {steps} steps", flush=True
    )
    if prepared.coverage == 0:
        print("nothing is fine-tuned")
        return state
    state, done, skipped = prepared.state, 0, 0
    metrics: dict[str, Any] = {}
    with progress.part("fine-tuning"):
        progress.count("fine-tuning", done, steps)
        while done < steps:
            report(done, steps)
            count = min(-(-steps // _REPORTS), steps - done)
            state, metrics = programs.run(state, prepared.data, count=count)
            done, skipped = done + count, skipped + metrics["skipped"]
            progress.count("fine-tuning", done, steps)
    if skipped == steps:
        raise TrainingError(f"loss or gradient was not finite in each of {steps} steps for them")
    print("  ".join(describe_means(metrics)))
    return state
