"""Detail: what photographs show beyond a model, added to its renders as far as it is there.

The residual of a photograph is the photograph minus the model's render of its view. Gathered into
another view, it adds what the model did not learn, unless photographs disagree or depth is wrong:
then it is noise. Networks that were trained on true close-ups of other scenes predict how much of
it is there, and how far colors are off in the end (`detail.weights`). Pixels that no photograph
shows are half filled (`detail.holes`).
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.detail.features import pixel_features
from jaxcloseup.detail.holes import OPAQUE, fill_holes, find_empty
from jaxcloseup.detail.smoothing import smooth_depth
from jaxcloseup.detail.strips import predict_by_strips
from jaxcloseup.detail.weights import DetailWeights, mix
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera, mean_focal, pixel_grid
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.depth_maps import GatherSources
from jaxcloseup.photos.gather import Gathered, GatherSettings, gather_parts
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.views import Views, camera_at


# Residuals are averaged over many photographs; colors come only from those that confirm the depth
# closely.
SETTINGS = GatherSettings(), GatherSettings(tolerance=0.02)
# Share of a hole that is filled. What no photograph shows may be unlike its surroundings, and where
# it is alike, half leaves a quarter of the squared error.
_FILLED = 0.5


class Detail(struct.PyTreeNode):
    """What photographs show beyond a model's renders.

    Attributes:
      shown: `[P, 6]` photograph minus render, then the photograph's colors c as 2 c - 1, in the
        exposure of its render.
      sources: the model's depth maps of the photographs.
      weights: networks that predict how far to trust what is gathered.
      finer: `[]` log2 of how much finer the finest level is than the photographs that the model
        learned from.
      grain: `[]` typical radius of the model's splats, world units; 0 of a model without.
      confirmed: `[]` part in [0, 1] of what the networks take to be there that is added.
      brightest: `[]` largest color of a render, 1; infinity where photographs differ in exposure,
        so that one that is taken darker shows what is brighter than white at the middle one.
    """

    shown: Pyramid
    sources: GatherSources
    weights: DetailWeights
    finer: jax.Array
    grain: jax.Array
    confirmed: jax.Array | float = 1.0
    brightest: jax.Array | float = 1.0

    @property
    def map_sizes(self) -> jax.Array:
        """Return height and width `[V, 2]` of the depth maps, which are padded to one size."""
        return self.shown.extents[:, self.shown.sizes.index(self.sources.trust.shape[1:])]


class Detailed(NamedTuple):
    """An image with detail.

    Attributes:
      rgb: `[H, W, 3]` from 0 to the detail's `brightest`; where no photograph saw a surface, half
        of what a render lacks in opacity has the colors around it.
      weight: `[H, W]` in [0, 1], how far the photographs' detail is trusted.
      footprint: `[H, W]` side of the finest pixel that saw the surface, in pixels of the view;
        infinity where no photograph saw it.
      error: `[H, W]` expected mean absolute error of colors, exposure apart; NaN where no
        photograph saw the surface.
    """

    rgb: jax.Array
    weight: jax.Array
    footprint: jax.Array
    error: jax.Array


class Candidates(NamedTuple):
    """Residuals and colors that photographs offer for a render `[H, W]`.

    Attributes:
      features: `[H, W, F]` inputs of the networks; they change smoothly with the camera.
      residual: `[H, W, 3]` gathered residual.
      colors: `[H, W, 3]` gathered colors minus the render; 0 where no photograph confirms the
        depth.
      weight: `[H, W]` sum of the photographs' weights.
      footprint: `[H, W]` side of the finest pixel that saw the surface, in pixels of the view.
    """

    features: jax.Array
    residual: jax.Array
    colors: jax.Array
    weight: jax.Array
    footprint: jax.Array


def add_detail(
    detail: Detail,
    camera: Camera,
    pixels: jax.Array,
    rgb: jax.Array,
    alpha: jax.Array,
    depth: jax.Array,
) -> Detailed:
    """Add the detail of photographs to a render, and fill its holes.

    Args:
      detail: detail of the model that was rendered.
      camera: camera of the render.
      pixels: `[H, W, 2]` its pixel centers, neighbors in the image.
      rgb: `[H, W, 3]` rendered colors, over black.
      alpha: `[H, W]` rendered opacity.
      depth: `[H, W]` rendered z-depth; 0 is undefined and gets no detail.
    """
    depth = _smooth(detail.grain, camera, depth)
    gathered = gather_parts(camera, pixels, depth, detail.sources, detail.shown, SETTINGS)
    sharper = _add(
        detail.weights,
        detail.finer,
        detail.confirmed,
        detail.brightest,
        gathered,
        rgb,
        alpha,
        depth,
    )
    seen = gathered[0].weight > 0
    del gathered  # 70 bytes for each pixel
    filled = _fill(camera, pixels, sharper.rgb, alpha, seen, detail.sources, detail.map_sizes)
    return sharper._replace(rgb=filled)


def add_to_rendering(
    detail: Detail, camera: Camera, rendering: Rendering, *, far: float = math.inf
) -> Detailed:
    """Add the detail of photographs to the rendering of a whole image.

    Args:
      detail: detail of the model that was rendered.
      camera: camera of the rendering.
      rendering: whole image `[H, W]`.
      far: largest z-depth of a surface, world units.
    """
    pixels = pixel_grid(camera.height, camera.width)
    depth = label_depth(rendering, near=0, far=far)
    return add_detail(detail, camera, pixels, rendering.rgb, rendering.alpha, depth)


def leave_out(detail: Detail, view: int) -> Detail:
    """Return detail to which one photograph, by its index, adds nothing."""
    maps = detail.sources.maps.at[view, ..., 1].set(0)
    return detail.replace(sources=dataclasses.replace(detail.sources, maps=maps))


def label_with_detail(
    detail: Detail,
    render: Callable[[Camera], Rendering],
    cameras: Camera,
    *,
    far: float = math.inf,
    each: Callable[[Callable[[int], Any], Sequence[int]], Iterable[Any]] = map,
) -> Views:
    """Label whole views by their own renders with detail.

    Args:
      detail: detail of the model.
      render: renders a whole image of the model.
      cameras: stacked `[Q]`.
      far: largest z-depth of a surface, world units.
      each: like `map`; may show progress.

    Returns:
      Views whose pixels weigh as much as their detail is trusted.
    """

    def label(index: int) -> Detailed:
        camera = camera_at(cameras, index)
        return add_to_rendering(detail, camera, render(camera), far=far)

    views = list(each(label, range(cameras.intrinsics.shape[0])))
    rgb, weight = ([getattr(view, name) for view in views] for name in ("rgb", "weight"))
    return Views(cameras, jnp.stack(rgb), jnp.stack(weight))


@jax.jit
def _smooth(grain: jax.Array, camera: Camera, depth: jax.Array) -> jax.Array:
    """Smooth the depth `[H, W]` of a view over as many pixels as a splat covers in it."""
    some = depth[:: max(1, depth.shape[0] // 64), :: max(1, depth.shape[1] // 64)]
    typical = jnp.nanmedian(jnp.where(some > 0, some, jnp.nan))
    radius = jnp.nan_to_num(grain * mean_focal(camera.intrinsics) / typical)
    return smooth_depth(depth, radius)


@jax.jit
def _add(
    weights: DetailWeights,
    finer: jax.Array,
    confirmed: jax.Array | float,
    brightest: jax.Array | float,
    gathered: tuple[Gathered, Gathered],
    rgb: jax.Array,
    alpha: jax.Array,
    depth: jax.Array,
) -> Detailed:
    residual, _ = gathered
    instead = _instead(gathered, rgb)
    outputs, errors = predict_by_strips(weights, finer, gathered, instead, alpha, depth)
    mixed, weight = mix(jnp.moveaxis(outputs, 0, -1), residual.mean, instead)
    seen = residual.weight > 0
    weight = jnp.where(seen, confirmed * weight, 0)
    added = weight[..., None] * mixed
    # Photographs and view may differ in exposure, so detail keeps the mean color of the view.
    shift = safe_divide(jnp.sum(added, axis=(0, 1)), jnp.sum(weight))
    added = added - weight[..., None] * shift[None, None]
    error = jnp.where(seen, jnp.exp(errors[1]), jnp.nan)
    sharper = jnp.clip(jnp.clip(rgb, 0, brightest) + added, 0, brightest)
    return Detailed(sharper, weight, residual.footprint, error)


@jax.jit
def _fill(
    camera: Camera,
    pixels: jax.Array,
    rgb: jax.Array,
    alpha: jax.Array,
    seen: jax.Array,
    sources: GatherSources,
    sizes: jax.Array,
) -> jax.Array:
    def fill() -> jax.Array:
        empty = find_empty(camera, pixels, sources, ~seen, sizes=sizes)
        filled = fill_holes(rgb, alpha, seen, empty)
        return rgb + _FILLED * (filled - rgb)

    # Most views have no holes.
    return jax.lax.cond(jnp.any(~seen & (alpha < OPAQUE)), fill, lambda: rgb)


def find_candidates(
    detail: Detail,
    camera: Camera,
    pixels: jax.Array,
    rgb: jax.Array,
    alpha: jax.Array,
    depth: jax.Array,
) -> Candidates:
    """Gather residuals and colors of the photographs at the surface of a render.

    Args:
      detail: detail of the model that was rendered; its weights are not needed.
      camera: camera of the render.
      pixels: `[H, W, 2]` its pixel centers, neighbors in the image.
      rgb: `[H, W, 3]` rendered colors.
      alpha: `[H, W]` rendered opacity.
      depth: `[H, W]` rendered z-depth; 0 is undefined.
    """
    depth = _smooth(detail.grain, camera, depth)
    gathered = gather_parts(camera, pixels, depth, detail.sources, detail.shown, SETTINGS)
    return _candidates(detail.finer, gathered, rgb, alpha, depth)


@jax.jit
def _candidates(
    finer: jax.Array,
    gathered: tuple[Gathered, Gathered],
    rgb: jax.Array,
    alpha: jax.Array,
    depth: jax.Array,
) -> Candidates:
    residual, colors = gathered
    instead = _instead(gathered, rgb)
    features = pixel_features(residual, colors, instead, alpha, depth, finer)
    return Candidates(features, residual.mean, instead, residual.weight, residual.footprint)


def _instead(gathered: tuple[Gathered, Gathered], rgb: jax.Array) -> jax.Array:
    """Return gathered colors minus the render, `[H, W, 3]`; 0 where there are none."""
    _, colors = gathered
    instead = (1 + colors.mean) / 2 - jnp.clip(rgb, 0, 1)
    return jnp.where(colors.weight[..., None] > 0, instead, 0)
