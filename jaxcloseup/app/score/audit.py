"""Errors of pseudo-labels: against true close-ups on built-in scenes, against photographs on all.

A label cannot be sharper than its source photograph. On built-in scenes it is therefore compared
with the true close-up, blurred to the footprint of the source's pixels. On all scenes, training
photographs are left out one by one, labeled from the others, and compared with their labels.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.captures.load import Scene
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.masks import depth_consistent, in_bounds
from jaxcloseup.geometry.warp import backward_warp
from jaxcloseup.labels.make import (
    LabelSources,
    PseudoSettings,
    label_pixels,
    label_sources,
    sample_virtual_camera,
)
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.labels.target_views import best_source
from jaxcloseup.photos.views import camera_at, to_float


CURVE_POINTS = 20
_SIGMAS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)


def blur_to_footprint(image: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Blur an image as if it were photographed with pixels `footprint` times as large.

    A photograph averages over its pixel (variance 1/12), and bilinear sampling over the neighbors
    (1/6), so the standard deviation is half a source pixel. The variance that the image's own
    pixels already have is subtracted.

    Args:
      image: `[H, W, 3]` image to blur.
      footprint: `[H, W]` side of a source pixel, in pixels of the image.

    Returns:
      `[H, W, 3]` blurred image.
    """
    sigma = np.sqrt(np.maximum(footprint**2 / 4 - 1 / 12, 0))
    levels = [image] + [cv2.GaussianBlur(image, (0, 0), s) for s in _SIGMAS[1:]]
    position = np.interp(sigma, _SIGMAS, np.arange(len(_SIGMAS)))
    low = np.minimum(position.astype(int), len(_SIGMAS) - 2)
    rows, columns = np.indices(sigma.shape)
    stack, share = np.stack(levels), (position - low)[..., None]
    return (1 - share) * stack[low, rows, columns] + share * stack[low + 1, rows, columns]


def resolved_by_photographs(
    scene: Scene, camera: Camera, exact_depths: jax.Array
) -> tuple[np.ndarray, np.ndarray]:
    """Blur a camera's true image to the detail of the training photographs.

    At each pixel the photograph with the smallest footprint sets the blur. Labels from exact depth
    and all photographs cannot be better than this image.

    Args:
      scene: a scene with `surface`.
      camera: camera of the image.
      exact_depths: `[V, H, W]` exact depths of the training views.

    Returns:
      `[H, W, 3]` the blurred true image, and `[H, W]` whether any photograph sees the surface.
    """
    truth = scene.surface(camera)
    pixels = pixel_grid(camera.height, camera.width)
    finest = np.full(pixels.shape[:2], np.inf)
    for index, depth in enumerate(exact_depths):
        source = camera_at(scene.train.cameras, index)
        visible, footprint = _seen_by(camera, pixels, truth.depth, source, depth)
        finest = np.where(visible, np.minimum(finest, footprint), finest)
    seen = np.isfinite(finest)
    return blur_to_footprint(np.asarray(truth.rgb), np.where(seen, finest, 1)), seen


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
      render_depth: `camera -> [H, W]`, the depth of a virtual camera that labels are made from.
      count: number of virtual cameras.

    Returns:
      `error`: mean absolute difference between kept labels and the blurred true image. `kept`:
      share of the pixels seen by the source view that keep their label. `leaked`: share of kept
      labels whose surface the source view does not see. A share of nothing is None, and
      `<name>_reason` says why. `curve`: `error_curve` with the mean of `leaked`, and coverage as a
      share of all pixels.
    """
    sample = jax.jit(sample_virtual_camera)
    of_curve: list[tuple[np.ndarray, ...]] = []
    pixels_total = 0
    error = kept = kept_visible = visible_total = 0.0
    for one in progress.track(jax.random.split(key, count), "close-ups"):
        camera, index = sample(one, sources, settings)
        pixels = pixel_grid(camera.height, camera.width)
        known = camera, pixels, render_depth(camera), index, sources
        label = label_pixels(*known, settings)
        weight = np.asarray(label.weight)
        any_color_weight = np.asarray(label_pixels(*known, _any_color(settings)).weight)
        truth = scene.surface(camera)
        visible, footprint = _seen_by(
            camera, pixels, truth.depth, camera_at(scene.train.cameras, index), exact_depths[index]
        )
        visible = np.asarray(visible, np.float32)
        blurred = blur_to_footprint(np.asarray(truth.rgb), np.asarray(footprint))
        difference = np.abs(label.rgb - blurred).mean(axis=-1)
        error += float((weight * difference).sum())
        kept += float(weight.sum())
        kept_visible += float((weight * visible).sum())
        visible_total += float(visible.sum())
        inside = any_color_weight > 0
        score = np.abs(label.backward - label.forward).max(axis=-1)
        columns = score, difference, 1 - visible
        of_curve.append(tuple(column[inside] for column in columns))
        pixels_total += inside.size
    shares = {
        "error": (error, kept),
        "kept": (kept_visible, visible_total),
        "leaked": (kept - kept_visible, kept),
    }
    result: dict[str, Any] = {}
    for name, (part, whole) in shares.items():
        result[name] = part / whole if whole else None
        if not whole:
            result[f"{name}_reason"] = (
                "no label was kept" if name != "kept" else "the source sees nothing"
            )
    score, scored_error, leaked = map(np.concatenate, zip(*of_curve, strict=True))
    result["curve"] = error_curve(score, scored_error, pixels_total, {"leaked": leaked})
    return result


def error_curve(
    score: np.ndarray,
    error: np.ndarray,
    total: int,
    more: Mapping[str, np.ndarray] | None = None,
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

    def means(values):
        return (np.cumsum(values, dtype=np.float64)[counts - 1] / counts).tolist()

    curve = {
        "coverage": (counts / total).tolist(),
        "error": means(error[by_score]),
        "oracle": means(np.sort(error)),
    }
    for name, values in (more or {}).items():
        curve[name] = means(values[by_score])
    gap = np.subtract(curve["error"], curve["oracle"])
    largest = curve["error"][-1]
    return curve | {"ause": float(np.trapezoid(gap, shares) / largest) if largest else 0.0}


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
    for label_by, model, truth, weight in _left_out(sources, render, count):
        for row, settings in enumerate(candidates):
            sums[row] += _compare(label_by(settings), model, truth, weight)
    rows = []
    for label, model, kept, total in sums:
        of_label, of_model = (
            float(-10 * np.log10(error / kept)) if kept and error else None
            for error in (label, model)
        )
        rows.append({"label_psnr": of_label, "model_psnr": of_model, "coverage": kept / total})
    return rows


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
    found: list[tuple[np.ndarray, ...]] = []
    total = 0
    for label_by, model, truth, weight in _left_out(sources, render, count):
        label = label_by(_any_color(settings))
        inside = np.asarray(label.weight * weight) > 0
        columns = (
            np.abs(label.backward - label.forward).max(axis=-1),
            np.abs(label.rgb - truth).mean(axis=-1),
            np.abs(jnp.clip(model, 0, 1) - truth).mean(axis=-1),
        )
        found.append(tuple(column[inside] for column in columns))
        total += int(np.sum(np.asarray(weight) > 0))
    score, error, model = map(np.concatenate, zip(*found, strict=True))
    return error_curve(score, error, total, {"model": model})


def _left_out(sources, render, count):
    """Left-out photographs, spread evenly.

    For each, a function of settings that labels it from the others; the model's colors; the
    photograph; the weight of its pixels.
    """
    views, depths = sources.views, sources.depths
    for index in np.unique(np.linspace(0, len(views) - 1, count).round().astype(int)):
        camera = camera_at(views.cameras, index)
        seen = render(camera)
        depth = label_depth(seen)
        others = views.replace(weight=views.weight.at[index].set(0))
        source = jax.jit(best_source)(camera, others, depths, depth=depth)
        pixels = pixel_grid(camera.height, camera.width)
        without = jax.jit(label_sources)(others, depths)
        label_by = functools.partial(label_pixels, camera, pixels, depth, source, without)
        yield label_by, seen.rgb, to_float(views.rgb[index]), views.weight[index]


@jax.jit
def _compare(label, rgb, truth, weight):
    """Return `[4]` sums: squared errors of labels and of the model, kept weight, all weight."""
    kept = label.weight * weight

    def error(image):
        return jnp.sum(kept * jnp.mean((jnp.clip(image, 0, 1) - truth) ** 2, axis=-1))

    return jnp.stack([error(label.rgb), error(rgb), jnp.sum(kept), jnp.sum(weight)])


@jax.jit
def _seen_by(camera, pixels, depth, source, source_depth):
    """Return whether the source sees each surface, and its pixel's side in pixels of `camera`."""
    landed, landed_depth = points_to_pixels(source, pixels_to_points(camera, pixels, depth))
    observed = backward_warp(source_depth[..., None], landed, order=0)[..., 0]
    inside = in_bounds(landed, source.height, source.width)
    visible = (depth > 0) & inside & depth_consistent(observed, landed_depth, 0.02)
    magnification = landed_depth / jnp.where(depth > 0, depth, 1)
    return visible, magnification * camera.intrinsics[0] / source.intrinsics[0]
