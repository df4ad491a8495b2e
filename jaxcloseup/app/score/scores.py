"""Scores of held-out views: on the full frame, and where training photographs saw the surface."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.score.metrics_text import FINER
from jaxcloseup.app.score.surface_error import (
    Landmarks,
    find_landmarks,
    point_depth_error,
    surface_error,
)
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.metrics.image_metrics import SSIM_TAPS, cc_psnr, psnr, quantize, ssim
from jaxcloseup.metrics.perceptual import (
    BACKBONES,
    SMALLEST,
    LpipsError,
    LpipsWeights,
    load_lpips,
    lpips,
)
from jaxcloseup.photos.scene import Scene, SceneError, Surface
from jaxcloseup.photos.support import count_seen
from jaxcloseup.photos.views import Views, camera_at, to_float
from jaxcloseup.photos.windows import in_quarters


SEEN_BY = (1, 3)  # least numbers of photographs, for metrics of the seen pixels alone


class Perceptual(NamedTuple):
    """LPIPS networks by backbone, and the reason for each missing one."""

    networks: Mapping[str, LpipsWeights]
    reasons: Mapping[str, str]


def find_perceptual(folder: str | None = None) -> Perceptual:
    """Load the LPIPS networks whose weights are in `folder` or in the default folders.

    Args:
      folder: folder of weights, or None for the default folders.

    Raises:
      ValueError: `folder` holds no weights.
    """
    networks, reasons = {}, {}
    for backbone in BACKBONES:
        try:
            networks[backbone] = load_lpips(backbone, folder)
        except LpipsError as error:
            reasons[backbone] = str(error)
    if folder is not None and not networks:
        raise ValueError(f"--lpips_weights={folder}: {reasons[BACKBONES[0]]}")
    return Perceptual(networks, reasons)


NO_PERCEPTUAL = Perceptual({}, dict.fromkeys(BACKBONES, "LPIPS was not requested"))


class Target(NamedTuple):
    """A held-out view of `[H, W]` pixels, the photograph's own size.

    Attributes:
      name: name of its photograph.
      camera: its camera; padded at the right and the bottom, as all views of its split are, so that
        they share what is compiled.
      rgb: `[H, W, 3]` the photograph, float in [0, 1].
      weight: `[H, W]` weights.
      seen: `[H, W]` number of training photographs that saw the surface at each pixel.
      surface: the exact surface, or None where it is unknown.
      landmarks: visible points of the capture, or None where the exact surface is known.
    """

    name: str
    camera: Camera
    rgb: jax.Array
    weight: jax.Array
    seen: jax.Array
    surface: Surface | None = None
    landmarks: Landmarks | None = None


def exact_depths(scene: Scene, cameras: Camera) -> jax.Array:
    """Return the exact z-depths `[V, H, W]` of stacked cameras on a built-in scene."""
    geometry, count = _geometry(scene.surface), cameras.intrinsics.shape[0]

    def depth(i):
        return geometry(camera_at(cameras, i)).depth

    return jnp.stack(list(progress.each(depth, range(count), "exact depths")))


@functools.lru_cache(maxsize=4)
def _geometry(surface):
    """The surface without colors: they take longest to compile."""
    return jax.jit(lambda camera: surface(camera)._replace(rgb=None))


def make_targets(
    scene: Scene,
    split: str,
    train_depths: jax.Array,
    render: Callable[[Camera], Rendering],
    finer: tuple[Views, Sequence[tuple[int, int]]] | None = None,
) -> list[Target]:
    """Return the held-out views of a split, with the number of photographs that saw each pixel.

    That number needs a depth. It is exact on built-in scenes. On captures it is rendered from the
    baseline, so that all stages are scored on the same pixels.

    Args:
      scene: the scene.
      split: name of the split.
      train_depths: `[V, H, W]` depths of the training views.
      render: `camera -> Rendering` of the baseline.
      finer: the split's photographs of another size, as `Scene.photographs_at` returns them; by
        default those of the scene.
    """
    views, sizes = finer or (getattr(scene, split), scene.sizes(split))
    surface = _geometry(scene.surface) if scene.surface else None
    if surface and finer:
        # Quarters of finer views are mostly as large as the others: one program serves both.
        surface = functools.partial(in_quarters, surface)
    count = jax.jit(count_seen)
    rgb_of, weight_of = jax.device_get((views.rgb, views.weight))

    def make(i):
        camera, (width, height) = camera_at(views.cameras, i), sizes[i]
        own = camera.replace(width=width, height=height)
        exact = surface(camera) if surface else None
        landmarks = None if exact else find_landmarks(own, scene.points)
        depth = exact.depth if exact else render(camera).depth
        pixels = pixel_grid(camera.height, camera.width)
        seen = count(camera, pixels, depth, scene.train, train_depths)[:height, :width]
        rgb = jnp.asarray(to_float(rgb_of[i, :height, :width]))
        weight = jnp.asarray(weight_of[i, :height, :width])
        return Target(scene.names[split][i], camera, rgb, weight, seen, exact, landmarks)

    return list(progress.each(make, range(len(sizes)), f"truth of {split}"))


def targets_by_split(
    scene: Scene,
    train_depths: jax.Array,
    exact: jax.Array | None,
    render: Callable[[Camera], Rendering],
    *,
    finer: int | None = None,
) -> dict[str, list[Target]]:
    """Return `make_targets` for every split except the training views.

    Args:
      scene: the scene.
      train_depths: `[V, H, W]` rendered depths of the training views.
      exact: `[V, H, W]` exact depths to use instead, or None on captures.
      render: `camera -> Rendering` of the baseline.
      finer: divisor of the photographs' size, if the views count at that size too, as splits of
        their own, named with `FINER`.
    """
    seen_from = train_depths if exact is None else exact
    splits = [split for split in scene.names if split != "train"]
    targets = {split: make_targets(scene, split, seen_from, render) for split in splits}
    for split in splits if finer is not None and scene.photographs_at else ():
        try:
            photographs = scene.photographs_at(finer, split)
        except SceneError as error:  # such as full-size photographs that were not kept
            print(f"views are scored at the size of training alone: {error}")
            break
        targets[split + FINER] = make_targets(scene, split, seen_from, render, photographs)
    return targets


def score(
    rendering: Rendering, target: Target, perceptual: Perceptual = NO_PERCEPTUAL
) -> dict[str, float | str | None]:
    """Return the metrics of one view on 8-bit colors, cropped to the pixels that count.

    Args:
      rendering: the rendered view, `[H, W]`.
      target: the held-out view.
      perceptual: LPIPS networks.

    Returns:
      As `score_image`, with the metrics of seen pixels and of the surface.
    """
    rows, columns = _frame(np.asarray(target.weight))

    def crop(array):
        return array[rows, columns]

    image, truth, weight = map(crop, (rendering.rgb, target.rgb, target.weight))
    image, truth = _as_8_bits(image, truth)
    seen = crop(target.seen)
    values = {}
    for least in SEEN_BY:
        counted = np.where(seen >= least, weight, 0)
        for key, value in _masked_metrics(image, truth, counted).items():
            values[f"{key}_seen{least}"] = value
        share = (counted > 0).sum() / max((np.asarray(weight) > 0).sum(), 1)
        values[f"coverage_seen{least}"] = share
    if target.surface is not None:
        values |= surface_error(target.camera, rendering, target.surface)
    if target.landmarks is not None:
        values |= point_depth_error(rendering.depth, target.landmarks)
    return score_image(image, truth, weight, perceptual, values)


def score_image(
    image: jax.Array,
    truth: jax.Array,
    weight: jax.Array,
    perceptual: Perceptual = NO_PERCEPTUAL,
    more: Mapping[str, jax.Array | float] | None = None,
) -> dict[str, float | str | None]:
    """Return the metrics of one image, on 8-bit colors.

    Args:
      image: `[H, W, 3]` rendered image.
      truth: `[H, W, 3]` true image.
      weight: `[H, W]` weight of each pixel.
      perceptual: LPIPS networks; they see the true image at pixels without weight.
      more: other metrics of the image, to add to the result.

    Returns:
      Each metric by name. A metric that cannot be computed is None, and `<metric>_reason` says why.
      The PSNR of equal images is infinite, and so None too.
    """
    image, truth = _as_8_bits(image, truth)
    values = dict(_full_metrics(image, truth, weight)) | dict(more or {})
    finite_image, smallest = np.isfinite(image).all(), min(truth.shape[:2])
    result: dict[str, float | str | None] = {}
    for key, value in values.items():
        result[key] = float(value) if np.isfinite(value) else None
        if result[key] is not None:
            continue
        if not finite_image:
            reason = "the rendering is not finite"
        elif np.isposinf(value):
            reason = "equals the truth"
        elif "ssim" in key and smallest < SSIM_TAPS:
            reason = f"SSIM needs at least {SSIM_TAPS} pixels a side"
        else:
            reason = "no pixel of this view counts"
        result[f"{key}_reason"] = reason
    for backbone in BACKBONES:
        key = f"lpips_{backbone}"
        result[key], reason = None, perceptual.reasons.get(backbone)
        if reason is None and not finite_image:
            reason = "the rendering is not finite"
        elif reason is None and smallest < SMALLEST[backbone]:
            reason = f"LPIPS needs at least {SMALLEST[backbone]} pixels a side"
        elif reason is None:
            result[key] = float(_lpips(perceptual.networks[backbone], image, truth, weight))
        if reason is not None:
            result[f"{key}_reason"] = reason
    return result


def summarize(views: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the mean over views of every metric that some view has, and each view's in `views`."""
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
    render: Callable[[Camera], Rendering],
    targets: Sequence[Target],
    perceptual: Perceptual = NO_PERCEPTUAL,
) -> tuple[dict[str, Any], dict[str, Rendering]]:
    """Render and score every target; return the summary and the renderings by name.

    Renderings have their photograph's own size, and no `aux`.
    """

    def seen(target):
        return without_padding(jax.device_get(render(target.camera)), *target.weight.shape)

    names = [target.name for target in targets]
    renderings = dict(zip(names, progress.each(seen, targets, "rendering views"), strict=True))
    scores = {t.name: score(renderings[t.name], t, perceptual) for t in targets}
    return summarize(scores), renderings


def without_padding(rendering: Rendering, height: int, width: int) -> Rendering:
    """The upper left `height` x `width` pixels of a rendering: padding is at the other sides."""
    images = {name: getattr(rendering, name) for name in ("rgb", "depth", "alpha", "normal")}
    cut = {name: image[:height, :width] for name, image in images.items() if image is not None}
    return rendering._replace(**cut, aux=())


def _as_8_bits(image, truth):
    # Outside the compiled functions, whose fused products make equal images differ by rounding.
    return quantize(image), quantize(truth)


@jax.jit
def _full_metrics(image, truth, weight):
    metrics = {"psnr": psnr, "cc_psnr": cc_psnr, "ssim": _ssim}
    return {name: metric(image, truth, weight=weight) for name, metric in metrics.items()}


@jax.jit
def _masked_metrics(image, truth, weight):
    return {
        "psnr": psnr(image, truth, weight=weight),
        "ssim": _ssim(image, truth, weight=weight),
    }


@jax.jit
def _lpips(network, image, truth, weight):
    return lpips(network, jnp.where(weight[..., None] > 0, image, truth), truth)


def _ssim(image, truth, *, weight):
    return ssim(image, truth, weight=weight) if min(truth.shape[:2]) >= SSIM_TAPS else jnp.nan


def _frame(weight: np.ndarray) -> tuple[slice, slice]:
    """Return the smallest rectangle with all weight: masks may leave a part of a photograph."""
    rows, columns = np.nonzero(weight.any(axis=1))[0], np.nonzero(weight.any(axis=0))[0]
    if not len(rows):
        return slice(None), slice(None)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
