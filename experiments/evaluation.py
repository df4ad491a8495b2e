"""Scoring a field on held-out views, full frame and where training photographs saw the surface."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.surface_error import (
    Landmarks,
    find_landmarks,
    point_depth_error,
    surface_error,
)
from jaxcloseup.batch import Views, camera_at, to_float
from jaxcloseup.field import Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.metrics import SSIM_TAPS, cc_psnr, psnr, quantize, ssim
from jaxcloseup.pseudo import count_seen
from jaxcloseup.scenes import Scene
from jaxcloseup.scenes.scene import Surface


SEEN_BY = (1, 3)
LPIPS_REASON = "LPIPS is not part of this version"


class Target(NamedTuple):
    """A held-out view.

    Attributes:
      name: of its photograph.
      camera: its camera.
      rgb: `[H, W, 3]` the photograph, float.
      weight: `[H, W]` 0 in padding.
      seen: `[H, W]` how many training photographs saw the surface there.
      surface: the exact one, or None where it is not known.
      landmarks: points of the capture that it shows, where the surface is not known.
    """

    name: str
    camera: Camera
    rgb: jax.Array
    weight: jax.Array
    seen: jax.Array
    surface: Surface | None = None
    landmarks: Landmarks | None = None


def exact_depths(scene: Scene, cameras: Camera) -> jax.Array:
    """Exact z-depths `[V, H, W]` of stacked cameras on a procedural scene."""
    depth = jax.jit(lambda camera: scene.surface(camera).depth)  # leaves the colours undrawn
    count = cameras.intrinsics.shape[0]
    return jnp.stack([depth(camera_at(cameras, i)) for i in range(count)])


def make_targets(
    scene: Scene, split: str, train_depths: jax.Array, render: Callable[[Camera], Rendering]
) -> list[Target]:
    """The held-out views of a split, with their coverage.

    Depth, for the coverage, is exact on procedural scenes and rendered on captures: from the
    baseline, so that every stage is scored on the same pixels.
    """
    views: Views = getattr(scene, split)
    surface = jax.jit(scene.surface) if scene.surface else None
    count = jax.jit(count_seen)
    targets = []
    for i, name in enumerate(scene.names[split]):
        camera = camera_at(views.cameras, i)
        exact = surface(camera) if surface else None
        landmarks = None if exact else find_landmarks(camera, scene.points)
        depth = exact.depth if exact else render(camera).depth
        pixels = pixel_grid(camera.height, camera.width)
        seen = count(camera, pixels, depth, scene.train, train_depths)
        rgb = to_float(jnp.asarray(views.rgb[i]))
        weight = jnp.asarray(views.weight[i])
        targets.append(Target(name, camera, rgb, weight, seen, exact, landmarks))
    return targets


def targets_by_split(
    scene: Scene,
    train_depths: jax.Array,
    exact: jax.Array | None,
    render: Callable[[Camera], Rendering],
) -> dict[str, list[Target]]:
    """`make_targets` of all splits but the training one; with `exact` depths where there are."""
    seen_from = train_depths if exact is None else exact
    return {
        split: make_targets(scene, split, seen_from, render)
        for split in scene.names
        if split != "train"
    }


def score(rendering: Rendering, target: Target) -> dict[str, float | str | None]:
    """Metrics of one view, on 8-bit colours; what cannot be computed is None beside its reason."""
    rows, columns = _frame(np.asarray(target.weight))

    def crop(array):
        return array[rows, columns]

    image, truth, weight = map(crop, (rendering.rgb, target.rgb, target.weight))
    seen = crop(target.seen)
    values = dict(_full_metrics(image, truth, weight))
    for least in SEEN_BY:
        values |= {
            f"{key}_seen{least}": value
            for key, value in _masked_metrics(
                image, truth, np.where(seen >= least, weight, 0)
            ).items()
        }
    if target.surface is not None:
        values |= surface_error(target.camera, rendering, target.surface)
    if target.landmarks is not None:
        values |= point_depth_error(rendering.depth, target.landmarks)
    finite_image = np.isfinite(image).all()
    result = {}
    for key, value in values.items():
        result[key] = float(value) if np.isfinite(value) else None
        if result[key] is not None:
            continue
        if not finite_image:
            reason = "the rendering is not finite"
        elif np.isposinf(value):
            reason = "equals the truth"
        elif "ssim" in key and min(truth.shape[:2]) < SSIM_TAPS:
            reason = f"SSIM needs {SSIM_TAPS} pixels a side"
        else:
            reason = "no pixel of this view counts"
        result[f"{key}_reason"] = reason
    return result | {"lpips_vgg": None, "lpips_vgg_reason": LPIPS_REASON}


def summarise(views: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Means over views of every metric that some view has, and the views themselves."""
    keys = sorted({key for values in views.values() for key in values if "_reason" not in key})
    summary: dict[str, Any] = {}
    for key in keys:
        known = [values[key] for values in views.values() if values.get(key) is not None]
        summary[key] = float(np.mean(known)) if known else None
        if not known:
            reasons = (values.get(f"{key}_reason") for values in views.values())
            summary[f"{key}_reason"] = next(filter(None, reasons))
    return summary | {"views": {name: dict(values) for name, values in views.items()}}


def evaluate(
    render: Callable[[Camera], Rendering], targets: Sequence[Target]
) -> tuple[dict[str, Any], dict[str, Rendering]]:
    """Render and score every target; returns the summary and the renderings by name."""
    renderings = {target.name: jax.device_get(render(target.camera)) for target in targets}
    return summarise({t.name: score(renderings[t.name], t) for t in targets}), renderings


@jax.jit
def _full_metrics(image, truth, weight):
    image, truth = quantize(image), quantize(truth)
    metrics = {"psnr": psnr, "cc_psnr": cc_psnr, "ssim": _ssim}
    return {name: metric(image, truth, weight=weight) for name, metric in metrics.items()}


@jax.jit
def _masked_metrics(image, truth, weight):
    image, truth = quantize(image), quantize(truth)
    return {
        "psnr": psnr(image, truth, weight=weight),
        "ssim": _ssim(image, truth, weight=weight),
        "coverage": jnp.mean(weight > 0),
    }


def _ssim(image, truth, *, weight):
    return ssim(image, truth, weight=weight) if min(truth.shape[:2]) >= SSIM_TAPS else jnp.nan


def _frame(weight):
    """The smallest rectangle that holds all weight: photographs are padded at two sides."""
    rows, columns = np.nonzero(weight.any(axis=1))[0], np.nonzero(weight.any(axis=0))[0]
    if not len(rows):
        return slice(None), slice(None)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
