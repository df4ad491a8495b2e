"""Residuals: photographs, at several sizes, minus a model's renders of their views."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.detail.add import Detail
from jaxcloseup.detail.features import blur_images
from jaxcloseup.detail.weights import DetailWeights
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.numerics import matmul
from jaxcloseup.io.buffers import empty_for_jax
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.metrics.image_metrics import change_colors, fit_colors
from jaxcloseup.photos.depth_maps import GatherSources, gather_sources
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.views import Views, camera_at, pad_images, to_float


# How many times finer than the photographs that the model learned from their depth maps are, if
# their renders are as fine.
FINER_DEPTHS = 2
MISFIT = 4  # times the median error, where a photograph has a quarter of its trust
# Smaller errors, in steps of an int8, are rounding and noise. A plain background is reproduced
# exactly, and would make every error of what stands before it look large.
NOISE = 1.0
COLOR_RIDGE = 0.01  # regularizes the affine map of a photograph's colors, see `fit_colors`
_BLUR = 1.5  # standard deviation in pixels of errors that lower trust


class Residuals(NamedTuple):
    """What V photographs show beyond a model.

    Attributes:
      shown: int8 `[P, 6]`, see `Detail`.
      cameras: stacked cameras of the depths.
      depths: `[V, H, W]` rendered z-depths, 0 where undefined.
    """

    shown: Pyramid
    cameras: Camera
    depths: jax.Array


def make_detail(
    render: Callable[[Camera], Rendering],
    views: Views,
    pyramid: Pyramid,
    weights: DetailWeights,
    *,
    near: float = 0.0,
    far: float = np.inf,
    grain: float = 0.0,
    brightest: float = 1.0,
) -> Detail:
    """Return the detail of photographs beyond a model that renders every level of a pyramid.

    Args:
      render: renders a whole image of the model.
      views: the photographs that the model learned from.
      pyramid: the same photographs at finer sizes too, see `photograph_pyramid`.
      weights: such as `known_weights()`.
      near: smallest z-depth of a surface, world units.
      far: largest one.
      grain: typical radius of the model's splats, world units; 0 of a model without.
      brightest: see `Detail`.
    """
    found = render_residuals(
        render, views.cameras, pyramid, near=near, far=far, brightest=brightest
    )
    sources = trusted_depths(found, views.weight * reproduced(found.shown))
    finer = jnp.float32(np.log2(pyramid.sizes[0][1] / views.cameras.width))
    return Detail(
        found.shown, sources, weights, finer, jnp.float32(grain), brightest=jnp.float32(brightest)
    )


def trusted_depths(found: Residuals, trust: jax.Array) -> GatherSources:
    """Return the depth maps of photographs with a trust `[V, H, W]` of any size in [0, 1]."""
    enlarged = jax.image.resize(trust, found.depths.shape, "linear")
    return gather_sources(found.cameras, found.depths, enlarged)


def render_residuals(
    render: Callable[[Camera], Rendering],
    cameras: Camera,
    pyramid: Pyramid,
    chosen: Sequence[int] | None = None,
    *,
    near: float,
    far: float,
    brightest: float = 1.0,
    rendered: int = 0,
    enlarge: Callable[[Any, Camera, Camera], Any] | None = None,
    each: Callable[[Callable[[int], Any], Sequence[int]], Iterable[Any]] = map,
) -> Residuals:
    """Render photographs' views, and subtract the renders from the photographs at every level.

    Exposure is not detail: an affine map first brings each photograph's colors to its render's.

    Args:
      render: renders a whole image of the model.
      cameras: stacked `[V]`, of photographs at the size that the model learned from.
      pyramid: the photographs with their weights; its last level has that size.
      chosen: indices of the photographs; None takes all.
      near, far: smallest and largest z-depth of a surface, world units.
      brightest: see `Detail`.
      rendered: finest level that is rendered; `enlarge` makes finer ones.
      enlarge: `(rgb, camera, finer_camera) -> rgb` of a render; not called where `rendered` is 0.
      each: like `map`; may show progress.
    """
    rows = np.arange(len(pyramid)) if chosen is None else np.asarray(chosen)
    extents = np.asarray(pyramid.extents)[rows]
    values = empty_for_jax((int(extents.prod(-1).sum()), 6), np.int8)
    depth_level = max(rendered, pyramid.level_near(FINER_DEPTHS * cameras.width))

    def compare(view: int) -> tuple[np.ndarray, jax.Array]:
        """Return the residuals of all levels, the finest first, and the depth at one."""
        levels: list[np.ndarray] = []
        for level in reversed(range(len(pyramid.sizes))):
            camera = pyramid.camera(camera_at(cameras, view), view, level)
            photograph = pyramid.image(view, level)
            if level >= rendered:
                rgb, shown_by = (rendering := render(camera)).rgb, camera
            else:
                assert enlarge is not None, "levels that are not rendered need `enlarge`"
                rgb, shown_by = enlarge(rgb, shown_by, camera), camera
            if not levels:  # at the size that the model learned from, where exposure is best known
                colors = _match(photograph, rendering.rgb, rendering.alpha, brightest)
            if level == depth_level:
                depth = label_depth(rendering, near=near, far=far)
            residual = _subtract(photograph, rgb, colors, brightest)
            levels.append(_filled(residual, photograph[..., 3] == 0, *levels[-1:]))
        return np.concatenate([level.reshape(-1, 6) for level in levels[::-1]]), depth

    depths, of_views = [], np.split(values, extents.prod(-1).sum(-1).cumsum()[:-1])
    for residual, (found, depth) in zip(of_views, each(compare, rows.tolist()), strict=True):
        residual[:] = found
        depths.append(depth)
    shown = Pyramid(jax.device_put(values), pyramid.intrinsics[rows], jnp.asarray(extents))
    own = shown.cameras(jax.tree.map(lambda leaf: leaf[rows], cameras), depth_level)
    return Residuals(shown, own, jnp.asarray(pad_images(depths, *shown.sizes[depth_level])))


def reproduced(shown: Pyramid, *, blur: Callable[[Any, float], Any] = blur_images) -> jax.Array:
    """Return how far the model reproduces each photograph, `[V, H, W]` in [0, 1]; 0 in padding.

    Where it fails at the size that it learned from, its depth is not to be trusted either: a
    floater in front of one camera would otherwise spoil every view that it appears in.

    Args:
      shown: residuals of V photographs.
      blur: `(images[V, H, W], deviation) -> [V, H, W]`, a Gaussian blur.
    """
    last, errors, counted = len(shown.sizes) - 1, [], []

    def blurred(image: np.ndarray) -> np.ndarray:
        return np.asarray(blur(image[None], _BLUR))[0]

    for view in range(len(shown)):
        values = np.asarray(shown.image(view, last), np.float32)
        error = blurred(np.abs(values[..., :3]).mean(-1))
        counts = np.any(values, axis=-1)  # masked pixels are 0, which no others are but by chance
        if not counts.all():
            error = np.where(
                counts, error / np.maximum(blurred(counts.astype(np.float32)), 1e-6), 0
            )
        errors.append(error)
        counted.append(error[error > NOISE])  # where masked, it is 0
    known = np.concatenate(counted)
    typical = float(np.median(known)) if len(known) else NOISE
    trust = [1 / (1 + (error / (MISFIT * typical)) ** 4) ** 2 for error in errors]
    return jnp.asarray(pad_images(trust, *shown.sizes[last]))


def _filled(
    residual: jax.Array, masked: jax.Array, coarser: np.ndarray | None = None
) -> np.ndarray:
    """Return a level whose masked pixels repeat those of the coarser level, if there is one.

    They are read where a coarser pixel, which trust is of, is partly masked, and beside the rim.
    The coarser one has the mean of what the mask leaves.
    """
    if coarser is None or not masked.any():
        return np.asarray(residual)
    rows, columns = (
        np.arange(size) * old // size
        for size, old in zip(masked.shape, coarser.shape, strict=False)
    )
    return np.where(masked[..., None], coarser[rows[:, None], columns], residual)


@jax.jit
def _match(
    photograph: jax.Array, rgb: jax.Array, alpha: jax.Array, brightest: float
) -> tuple[jax.Array, jax.Array]:
    """Return the affine change `(matrix, offset)` of a photograph's colors to those of its render.

    It is the inverse of the best change of the render: a blurred render predicts a photograph
    without bias, but a photograph predicts a blurred render with too little contrast.
    """
    values = to_float(photograph)
    rgb = jnp.clip(rgb, 0, brightest)
    # Pixels that the model misses or invents do not inform about exposure.
    error = jnp.mean(jnp.abs(values[..., :3] - rgb), axis=-1)
    # A sixteenth of them says it as well, and XLA sorts slowly.
    known = jnp.where(values[..., 3] > 0, error, jnp.nan)
    typical = jnp.maximum(jnp.nan_to_num(jnp.nanmedian(known[::4, ::4])), 1e-3)
    weight = values[..., 3] * alpha**2 / (1 + (error / (2 * typical)) ** 2) ** 2
    matrix, offset = fit_colors(rgb, values[..., :3], weight, ridge=COLOR_RIDGE)
    inverse = jnp.linalg.inv(matrix)
    change = inverse, -matmul(offset[None], inverse)[0]
    known = jnp.all(jnp.isfinite(change[0])) & jnp.all(jnp.abs(change[0]) < 2)
    same = jnp.eye(3, dtype=rgb.dtype), jnp.zeros(3, rgb.dtype)
    return jax.tree.map(lambda fitted, none: jnp.where(known, fitted, none), change, same)


@jax.jit
def _subtract(
    photograph: jax.Array, rgb: jax.Array, change: tuple[jax.Array, jax.Array], brightest: float
) -> jax.Array:
    """Return the residual and the matched colors of a photograph, int8 `[H, W, 6]`."""
    values, (matrix, offset) = to_float(photograph), change
    matched = change_colors(values[..., :3], matrix, offset)
    both = jnp.concatenate([matched - jnp.clip(rgb, 0, brightest), 2 * matched - 1], axis=-1)
    both = jnp.where(values[..., 3:] > 0, both, 0)
    return jnp.round(127 * jnp.clip(both, -1, 1)).astype(jnp.int8)
