"""Measure errors of pseudo-labels against true close-ups, and against left-out photographs.

A label cannot be sharper than its source photograph. On built-in scenes it is therefore compared
with the true close-up, blurred to the footprint of the source's pixels. On all scenes, training
photographs are left out one by one, labeled from the others, and compared with their labels.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.score.footprints import blur_to_footprint, seen_by
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.labels.make import (
    LabelSources,
    PseudoLabel,
    PseudoSettings,
    label_pixels,
    label_sources,
    sample_virtual_camera,
)
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.labels.target_views import best_source
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import camera_at, to_float


CURVE_POINTS = 20


def audit_labels(
    key: jax.Array,
    exact_depths: jax.Array,
    scene: Scene,
    sources: LabelSources,
    settings: PseudoSettings,
    *,
    render_depth: Callable[[Camera], jax.Array],
    count: int = 16,
) -> dict[str, Any]:
    """Measure errors and shares of labels over random virtual close-ups of a built-in scene.

    Args:
      key: random key.
      exact_depths: `[V, H, W]` exact depths of the training views; they decide what a view sees.
      scene: a scene with `surface`.
      sources: the photographs with the depths that labels are made from.
      settings: settings of poses and labels.
      render_depth: `camera -> [H, W]`, the depth that labels of a virtual camera are made from.
      count: number of virtual cameras.

    Returns:
      `error`: mean absolute difference between kept labels and the blurred true image. `kept`:
      share of the pixels seen by the source view that keep their label. `leaked`: share of kept
      labels whose surface the source view does not see. A share of nothing is None, and
      `<name>_reason` says why. `curve`: `error_curve` with the mean of `leaked`, and coverage as a
      share of all pixels.
    """
    sample = jax.jit(sample_virtual_camera)
    error = kept = kept_visible = visible = 0.0
    shots = []
    for camera_key in progress.track(list(jax.random.split(key, count)), "close-ups"):
        camera, index = sample(camera_key, sources, settings)
        depth = render_depth(camera)
        shot = _audit_closeup(camera, depth, index, exact_depths[index], scene, sources, settings)
        error += float((shot.weight * shot.error).sum())
        kept += float(shot.weight.sum())
        kept_visible += float((shot.weight * shot.visible).sum())
        visible += float(shot.visible.sum())
        shots.append(shot)
    shares = {
        "error": (error, kept, "no label was kept"),
        "kept": (kept_visible, visible, "the source sees nothing"),
        "leaked": (kept - kept_visible, kept, "no label was kept"),
    }
    result: dict[str, Any] = {}
    for name, (part, whole, reason) in shares.items():
        result |= {name: part / whole} if whole else {name: None, f"{name}_reason": reason}
    result["curve"] = error_curve(
        np.concatenate([shot.disagreement[shot.reached] for shot in shots]),
        np.concatenate([shot.error[shot.reached] for shot in shots]),
        sum(shot.reached.size for shot in shots),
        {"leaked": np.concatenate([(1 - shot.visible)[shot.reached] for shot in shots])},
    )
    return result


class _Audited(NamedTuple):
    """Labels of a virtual close-up against its blurred true image, all `[H, W]`."""

    weight: np.ndarray  # of each label
    error: np.ndarray  # mean absolute difference from the true color
    visible: np.ndarray  # 1 where the source sees the surface, else 0
    disagreement: np.ndarray  # largest difference of both warps in a channel
    reached: np.ndarray  # whether both warps reach a pixel, whatever their colors


def _audit_closeup(
    camera: Camera,
    depth: jax.Array,
    index: jax.Array,
    exact_depth: jax.Array,
    scene: Scene,
    sources: LabelSources,
    settings: PseudoSettings,
) -> _Audited:
    """Label a close-up from the training view `index`, and compare it with the exact scene."""
    assert scene.surface is not None
    pixels = pixel_grid(camera.height, camera.width)
    label = label_pixels(camera, pixels, depth, index, sources, settings)
    any_color = label_pixels(camera, pixels, depth, index, sources, _any_color(settings))
    truth, source = scene.surface(camera), camera_at(scene.train.cameras, index)
    visible, footprint = seen_by(camera, pixels, truth.depth, source, exact_depth)
    blurred = blur_to_footprint(np.asarray(truth.rgb), np.asarray(footprint))
    return _Audited(
        weight=np.asarray(label.weight),
        error=np.abs(label.rgb - blurred).mean(axis=-1),
        visible=np.asarray(visible, np.float32),
        disagreement=np.abs(label.backward - label.forward).max(axis=-1),
        reached=np.asarray(any_color.weight) > 0,
    )


def error_curve(
    score: np.ndarray, error: np.ndarray, total: int, more: Mapping[str, np.ndarray] | None = None
) -> dict[str, list[float] | float] | None:
    """Return the mean error of the best labels by score, for a growing number of labels.

    The area under the sparsification error (AUSE; Ilg et al., "Uncertainty Estimates and
    Multi-Hypotheses Networks for Optical Flow", ECCV 2018) is 0 for a score that sorts labels by
    their true error. It is one half for an uninformative score and uniform errors.

    Args:
      score: `[N]` scores of the labels; smaller is better.
      error: `[N]` true errors of the labels.
      total: number of pixels in all images, labeled or not.
      more: other quantities `[N]` by name, averaged over the same labels as `error`.

    Returns:
      Lists over `CURVE_POINTS` numbers of labels, from few to all. `coverage`: their share of
      `total`. `error`: their mean error. `oracle`: mean error of the same number of labels with the
      smallest errors. Each name of `more`: its mean. The number `ause`. None without labels.
    """
    if not len(score):
        return None
    shares = np.arange(1, CURVE_POINTS + 1) / CURVE_POINTS
    counts = np.maximum(1, np.round(shares * len(score)).astype(int))
    by_score = np.argsort(score, kind="stable")

    def means(values: np.ndarray) -> list[float]:
        return (np.cumsum(values, dtype=np.float64)[counts - 1] / counts).tolist()

    errors, oracle = means(error[by_score]), means(np.sort(error))
    gap, largest = np.subtract(errors, oracle), errors[-1]
    return {
        "coverage": (counts / total).tolist(),
        "error": errors,
        "oracle": oracle,
        **{name: means(values[by_score]) for name, values in (more or {}).items()},
        # From no labels on, of which the gap is that of the fewest.
        "ause": float(np.trapezoid([gap[0], *gap], [0, *shares]) / largest) if largest else 0.0,
    }


def _any_color(settings: PseudoSettings) -> PseudoSettings:
    """Return settings that keep every label that both warps reach, whatever its colors."""
    return settings.replace(use_mask=jnp.float32(1), rgb_tolerance=jnp.float32(jnp.inf))


def audit_left_out(
    sources: LabelSources,
    render: Callable[[Camera], Rendering],
    candidates: Sequence[PseudoSettings],
    *,
    count: int = 8,
) -> list[dict[str, float | None]]:
    """Compare labels of left-out training photographs, and the model, with these photographs.

    The model was trained on them, so its error is as small as it can be. Labels that beat it even
    here are better than the model.

    Args:
      sources: the training photographs with their depths.
      render: `camera -> Rendering` of the model.
      candidates: settings of labels to compare.
      count: number of photographs to leave out, spread evenly.

    Returns:
      For each candidate `label_psnr` and `model_psnr` in dB over the labeled pixels, None without
      any, and `coverage`, the share of labeled pixels.
    """
    sums = np.zeros((len(candidates), 4))
    for left_out in _left_out(sources, render, count):
        for row, settings in enumerate(candidates):
            label = left_out.label_by(settings)
            sums[row] += _compare(label, left_out.model, left_out.truth, left_out.weight)
    return [
        {
            "label_psnr": _psnr(label, kept),
            "model_psnr": _psnr(model, kept),
            "coverage": kept / total,
        }
        for label, model, kept, total in sums
    ]


def _psnr(squared_errors: float, weight: float) -> float | None:
    if not weight or not squared_errors:
        return None
    return float(-10 * np.log10(squared_errors / weight))


def left_out_curve(
    sources: LabelSources,
    render: Callable[[Camera], Rendering],
    settings: PseudoSettings,
    *,
    count: int = 8,
) -> dict[str, list[float] | float] | None:
    """Return `error_curve` for labels of left-out training photographs, with the model's error.

    The curve needs no exact depth. Where the labels' error is above the `model` error, a tolerance
    that keeps that many labels trains on worse colors than the model has. Arguments are those of
    `audit_left_out`.
    """
    scores, errors, model_errors, total = [], [], [], 0
    for left_out in _left_out(sources, render, count):
        label, truth = left_out.label_by(_any_color(settings)), left_out.truth
        reached = np.asarray(label.weight * left_out.weight) > 0
        scores.append(np.abs(label.backward - label.forward).max(axis=-1)[reached])
        errors.append(np.abs(label.rgb - truth).mean(axis=-1)[reached])
        clipped = jnp.clip(left_out.model, 0, 1)
        model_errors.append(np.abs(clipped - truth).mean(axis=-1)[reached])
        total += int(np.sum(np.asarray(left_out.weight) > 0))
    score, error, model = map(np.concatenate, (scores, errors, model_errors))
    return error_curve(score, error, total, {"model": model})


class _LeftOut(NamedTuple):
    """A training photograph, and what labels it from the others."""

    label_by: Callable[[PseudoSettings], PseudoLabel]
    model: jax.Array  # [H, W, 3] colors of the model
    truth: jax.Array  # [H, W, 3] the photograph
    weight: jax.Array  # [H, W] weight of its pixels


def _left_out(
    sources: LabelSources, render: Callable[[Camera], Rendering], count: int
) -> Iterator[_LeftOut]:
    """Leave out photographs, spread evenly."""
    views, depths = sources.views, sources.depths
    for index in np.unique(np.linspace(0, len(views) - 1, count).round().astype(int)):
        camera = camera_at(views.cameras, index)
        seen = render(camera)
        depth = label_depth(seen)
        others = dataclasses.replace(views, weight=views.weight.at[index].set(0))
        source = jax.jit(best_source)(camera, others, depths, depth=depth)
        pixels = pixel_grid(camera.height, camera.width)
        without = jax.jit(label_sources)(others, depths)
        label_by = functools.partial(label_pixels, camera, pixels, depth, source, without)
        yield _LeftOut(label_by, seen.rgb, to_float(views.rgb[index]), views.weight[index])


@jax.jit
def _compare(
    label: PseudoLabel, model: jax.Array, truth: jax.Array, weight: jax.Array
) -> jax.Array:
    """Return `[4]` sums: squared errors of labels and of the model, kept weight, all weight."""
    kept = label.weight * weight

    def error(image: jax.Array) -> jax.Array:
        return jnp.sum(kept * jnp.mean((jnp.clip(image, 0, 1) - truth) ** 2, axis=-1))

    return jnp.stack([error(label.rgb), error(model), jnp.sum(kept), jnp.sum(weight)])
