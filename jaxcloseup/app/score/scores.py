"""Score held-out views: on the full frame, and where training photographs saw the surface."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.score.surface_error import point_depth_error, surface_error
from jaxcloseup.app.score.targets import Target
from jaxcloseup.artifacts.images import to_uint8
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.metrics.color_corrections import gsplat_cc_psnr, multinerf_cc_psnr
from jaxcloseup.metrics.image_metrics import SSIM_TAPS, cc_psnr, psnr, quantize, ssim
from jaxcloseup.metrics.perceptual import (
    BACKBONES,
    SMALLEST,
    LpipsError,
    LpipsWeights,
    load_lpips,
    lpips,
)
from jaxcloseup.metrics.resolution import SMALLEST as SMALLEST_RINGS
from jaxcloseup.metrics.resolution import resolved_period, ring_correlation
from jaxcloseup.photos.exposures import Taken
from jaxcloseup.photos.views import to_float


# Renders a camera as its photograph was taken, if that is known.
RenderTaken = Callable[[Camera, Taken | None], Rendering]
Metrics = dict[str, jax.Array | float]
View = dict[str, float | str | list[float] | None]  # metrics of one view by name
SEEN_BY = (1, 3)  # least numbers of photographs, for metrics of the seen pixels alone
CURVE = "ring_correlation"  # the one metric that is a list, of which `resolves` is made


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


def score(rendering: Rendering, target: Target, perceptual: Perceptual = NO_PERCEPTUAL) -> View:
    """Return the metrics of one view on 8-bit colors, cropped to the pixels that count.

    Args:
      rendering: the rendered view, `[H, W]`.
      target: the held-out view.
      perceptual: LPIPS networks.

    Returns:
      As `score_image`, with the metrics of seen pixels and of the surface.
    """
    rows, columns = _frame(np.asarray(target.weight))

    def crop(array: Any) -> Any:
        return array[rows, columns]

    image, truth, weight = (
        crop(rendering.rgb),
        *(jnp.asarray(to_float(crop(array))) for array in (target.rgb, target.weight)),
    )
    image, truth = _as_8_bits(image, truth)
    seen = crop(target.seen)
    values: Metrics = {}
    masks = {f"seen{least}": np.where(seen >= least, weight, 0) for least in SEEN_BY}
    for name, counted in masks.items():
        share = (counted > 0).sum() / max((np.asarray(weight) > 0).sum(), 1)
        values[f"coverage_{name}"] = share
    if target.surface is not None:
        values |= surface_error(target.camera, rendering, target.surface)
    if target.could_resolve is not None:
        values["could_resolve"] = target.could_resolve
    values |= target.proximity or {}
    if target.landmarks is not None:
        values |= point_depth_error(np.asarray(rendering.depth), target.landmarks)
    # Drawn scenes have one exposure.
    others = target.surface is None
    return score_image(image, truth, weight, perceptual, values, masks, corrections=others)


def score_image(
    image: jax.Array,
    truth: jax.Array,
    weight: jax.Array,
    perceptual: Perceptual = NO_PERCEPTUAL,
    more: Metrics | None = None,
    masks: Mapping[str, np.ndarray] | None = None,
    *,
    corrections: bool = True,
) -> View:
    """Return the metrics of an image, on 8-bit colors.

    Args:
      image: `[H, W, 3]` rendered image.
      truth: `[H, W, 3]` true image.
      weight: `[H, W]` weight of each pixel.
      perceptual: LPIPS networks; they see the true image at pixels without weight.
      more: other metrics of the image, to add to the result.
      masks: further weights by name; PSNR and SSIM with these have the names as their ending.
      corrections: whether colors are also corrected as other programs do.

    Returns:
      Each metric by name. A metric that cannot be computed is None, and `<metric>_reason` says why;
      so is the infinite PSNR of equal images. `resolves` is the finest period in pixels that the
      image resolves, and `ring_correlation` the curve it is read from, where the image is so large.
    """
    image, truth = _as_8_bits(image, truth)
    values = dict(_metrics(image, truth, weight, dict(masks or {}))) | dict(more or {})
    if corrections:
        values |= _corrected(image, truth, weight)
    finite, side = bool(np.isfinite(image).all()), min(truth.shape[:2])
    result: View = {}
    if finite and side >= SMALLEST_RINGS:
        values["resolves"] = np.nan
        if np.any(np.asarray(weight) > 0):
            curve = np.asarray(ring_correlation(image, truth, weight=weight))
            values["resolves"] = resolved_period(curve)
            result[CURVE] = curve.tolist()
    for key, value in values.items():
        known = bool(np.isfinite(value))
        result[key] = float(value) if known else None
        if not known:
            result[f"{key}_reason"] = _why_unknown(key, float(value), side, finite=finite)
    for backbone in BACKBONES:
        key, reason = f"lpips_{backbone}", perceptual.reasons.get(backbone)
        if reason is None and not finite:
            reason = _NOT_FINITE
        elif reason is None and side < SMALLEST[backbone]:
            reason = f"LPIPS needs at least {SMALLEST[backbone]} pixels a side"
        if reason is None:
            result[key] = float(_lpips(perceptual.networks[backbone], image, truth, weight))
        else:
            result |= {key: None, f"{key}_reason": reason}
    return result


_NOT_FINITE = "the rendering is not finite"
_UNRESOLVED = "no period is resolved"


def _why_unknown(key: str, value: float, side: int, *, finite: bool) -> str:
    """Explain why a metric is not finite, for an image whose shorter side has `side` pixels."""
    if not finite:
        return _NOT_FINITE
    if key == "resolves" and np.isposinf(value):
        return _UNRESOLVED
    if np.isposinf(value):
        return "equals the truth"
    if "ssim" in key and side < SSIM_TAPS:
        return f"SSIM needs at least {SSIM_TAPS} pixels a side"
    return "no pixel of this view counts"


def summarize(views: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the mean over views of every metric that some view has, and each view's in `views`.

    `resolves` is read from the mean of the views' curves, which stays beside it.
    """
    curves = [values[CURVE] for values in views.values() if CURVE in values]
    views = {
        name: {key: value for key, value in values.items() if key != CURVE}
        for name, values in views.items()
    }
    keys = sorted({key for values in views.values() for key in values if "_reason" not in key})
    summary: dict[str, Any] = {}
    for key in keys:
        known = [values[key] for values in views.values() if values.get(key) is not None]
        summary[key] = float(np.mean(known)) if known else None
        if not known:
            reasons = (values.get(f"{key}_reason") for values in views.values())
            summary[f"{key}_reason"] = next(filter(None, reasons))
    if summary.get("resolves") is not None:
        curve = np.mean(curves, axis=0)
        period = resolved_period(curve)
        summary |= {"resolves": period, CURVE: curve.tolist()}
        if not np.isfinite(period):
            summary |= {"resolves": None, "resolves_reason": _UNRESOLVED}
    return summary | {"views": views}


def evaluate(
    render: RenderTaken, targets: Sequence[Target], perceptual: Perceptual = NO_PERCEPTUAL
) -> tuple[dict[str, Any], dict[str, Rendering]]:
    """Render and score every target; return the summary and the renderings by name.

    `render` gets a camera and how its photograph was taken, see `Target.taken`.

    Renderings have the size of their target, colors of 8 bits, and neither `aux` nor normals.
    """

    def scored(target: Target) -> tuple[View, Rendering]:
        seen = jax.device_get(render(target.camera, target.taken)._replace(aux=()))
        kept = seen._replace(rgb=to_uint8(seen.rgb), normal=None)
        return score(seen, target, perceptual), kept

    names = [target.name for target in targets]
    pixels = max((target.weight.size for target in targets), default=1)
    found = progress.each(scored, targets, "rendering and scoring views", pixels=pixels)
    views = dict(zip(names, found, strict=True))
    scores = {name: values for name, (values, _) in views.items()}
    return summarize(scores), {name: seen for name, (_, seen) in views.items()}


def _as_8_bits(image: jax.Array, truth: jax.Array) -> tuple[jax.Array, jax.Array]:
    # Outside the compiled functions, whose fused products make equal images differ by rounding.
    return quantize(image), quantize(truth)


@jax.jit
def _metrics(
    image: jax.Array, truth: jax.Array, weight: jax.Array, masks: Mapping[str, jax.Array]
) -> Metrics:
    # In one program, all weights share one map of SSIM.
    found: Metrics = {"cc_psnr": cc_psnr(image, truth, weight=weight)}
    for ending, counted in {"": weight, **{f"_{name}": w for name, w in masks.items()}}.items():
        found[f"psnr{ending}"] = psnr(image, truth, weight=counted)
        found[f"ssim{ending}"] = _ssim(image, truth, weight=counted)
    return found


@jax.jit
def _corrected(image: jax.Array, truth: jax.Array, weight: jax.Array) -> Metrics:
    return {
        "cc_psnr_gsplat": gsplat_cc_psnr(image, truth, weight=weight),
        "cc_psnr_multinerf": multinerf_cc_psnr(image, truth, weight=weight),
    }


@jax.jit
def _lpips(
    network: LpipsWeights, image: jax.Array, truth: jax.Array, weight: jax.Array
) -> jax.Array:
    return lpips(network, jnp.where(weight[..., None] > 0, image, truth), truth)


def _ssim(image: jax.Array, truth: jax.Array, *, weight: jax.Array) -> jax.Array | float:
    return ssim(image, truth, weight=weight) if min(truth.shape[:2]) >= SSIM_TAPS else jnp.nan


def _frame(weight: np.ndarray) -> tuple[slice, slice]:
    """Return the smallest rectangle with all weight: masks may leave a part of a photograph."""
    rows, columns = np.nonzero(weight.any(axis=1))[0], np.nonzero(weight.any(axis=0))[0]
    if not len(rows):
        return slice(None), slice(None)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
