"""Detail: what photographs show beyond a model, added to its renders as far as it is there.

The residual of a photograph is the photograph minus the model's render of its view. Gathered into
another view, it adds what the model did not learn, as far as it is really there: where photographs
disagree or depth is wrong, it is noise. True close-ups of other scenes told how much of it is
there, and how far colors are off in the end (`detail_weights`). What no photograph shows is filled
(`holes`).
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcloseup.detail.holes import OPAQUE, fill_holes, find_empty
from jaxcloseup.detail.weights import CONTRAST, DetailWeights, Evidence, blend, expected_errors
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.photos.gather import Gathered, GatherSettings, GatherSources, gather_parts
from jaxcloseup.photos.pyramids import Pyramid


# Residuals want many photographs, and colors only those that confirm the depth closely.
SETTINGS = GatherSettings(), GatherSettings(tolerance=0.02)
FEATURES = 29  # that tell how far to trust what is gathered
_NEAREST, _FARTHEST = -1.0, 3.0  # log2 of how much finer views are than photographs can imitate
_BLURS = 1.0, 4.0  # standard deviations in pixels


class Detail(struct.PyTreeNode):
    """What a model's renders lack, as the photographs show it.

    Attributes:
      shown: `[V, P, 6]` photograph minus render, then the photograph's colors c as 2 c - 1, in the
        exposure of its render.
      sources: the model's depth maps of the photographs.
      weights: how far to trust what is gathered.
      finer: `[]` log2 of how much finer the finest level is than the photographs that the model
        learned from.
    """

    shown: Pyramid
    sources: GatherSources
    weights: DetailWeights
    finer: jax.Array


class Detailed(NamedTuple):
    """An image with detail.

    Attributes:
      rgb: `[H, W, 3]` in [0, 1]; what no photograph shows has the colors around it.
      weight: `[H, W]` in [0, 1], how far the photographs' detail is trusted.
      footprint: `[H, W]` side of the finest pixel that saw the surface, in pixels of the view;
        infinity where no photograph saw it.
      error: `[H, W]` the mean absolute error of colors that is expected, but for exposure; NaN
        where no photograph saw the surface.
    """

    rgb: jax.Array
    weight: jax.Array
    footprint: jax.Array
    error: jax.Array


class Candidates(NamedTuple):
    """What the photographs offer for a render `[H, W]`.

    Attributes:
      features: `[H, W, F]` what is known of each pixel, smooth in the camera.
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
    """Add what the photographs show beyond a render to its colors, and fill its holes.

    Args:
      detail: of the state that was rendered.
      camera: camera of the render.
      pixels: `[H, W, 2]` its pixel centers, neighbors in the image.
      rgb: `[H, W, 3]` rendered colors, over black.
      alpha: `[H, W]` rendered opacity.
      depth: `[H, W]` rendered z-depth; 0 is undefined and gets no detail.
    """
    found = find_candidates(detail, camera, pixels, rgb, alpha, depth)
    sharper = _add(detail.weights, found, rgb)
    filled = _fill(camera, pixels, sharper.rgb, alpha, found.weight > 0, detail.sources)
    return sharper._replace(rgb=filled)


@jax.jit
def _add(weights, found, rgb):
    mixed, weight = blend(weights, found.features, found.residual, found.colors)
    seen = found.weight > 0
    weight = jnp.where(seen, weight, 0)
    added = weight[..., None] * mixed
    # Photographs and view may differ in exposure, so detail keeps the mean color of the view.
    shift = safe_divide(jnp.sum(added, axis=(0, 1)), jnp.sum(weight))
    added = added - weight[..., None] * shift[None, None]
    error = jnp.where(seen, expected_errors(weights, found.features)[..., 1], jnp.nan)
    return Detailed(jnp.clip(jnp.clip(rgb, 0, 1) + added, 0, 1), weight, found.footprint, error)


@jax.jit
def _fill(camera, pixels, rgb, alpha, seen, sources):
    def fill():
        return fill_holes(rgb, alpha, seen, find_empty(camera, pixels, sources))

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
    """Gather what the photographs show at the surface of a render.

    Args:
      detail: of the state that was rendered; its weights are not needed.
      camera: camera of the render.
      pixels: `[H, W, 2]` its pixel centers, neighbors in the image.
      rgb: `[H, W, 3]` rendered colors.
      alpha: `[H, W]` rendered opacity.
      depth: `[H, W]` rendered z-depth; 0 is undefined.
    """
    gathered = gather_parts(camera, pixels, depth, detail.sources, detail.shown, SETTINGS)
    return _candidates(detail.finer, gathered, rgb, alpha, depth)


@jax.jit
def _candidates(finer, gathered, rgb, alpha, depth):
    residual, colors = gathered
    instead = (1 + colors.mean) / 2 - jnp.clip(rgb, 0, 1)
    instead = jnp.where(colors.weight[..., None] > 0, instead, 0)
    features = _features(residual, colors, instead, alpha, depth, finer)
    return Candidates(features, residual.mean, instead, residual.weight, residual.footprint)


@jax.jit
def testify(found: Candidates, own: jax.Array, weight: jax.Array) -> Evidence:
    """What the truth says of the candidates for a view.

    Args:
      found: gathered from the photographs; pixels that none of them saw say nothing.
      own: `[H, W, 3]` the truth minus the render.
      weight: `[H, W]` weight of its pixels.
    """
    weight = jnp.where(found.weight > 0, weight, 0)
    images = found.features, found.residual, found.colors, own, weight[..., None]
    *rows, weight = (image.reshape(-1, image.shape[-1]) for image in images)
    return Evidence(*rows, weight[:, 0])


def _features(residual: Gathered, colors: Gathered, instead, alpha, depth, finer):
    """`[H, W, F]`; `instead` is what gathered colors would add to the render."""
    # log2 of how much finer the view is than the model, and than the finest photographs.
    beyond_model = jnp.clip(finer - residual.detail, _NEAREST, _FARTHEST)
    beyond_photographs = jnp.clip(-residual.detail, 0, _FARTHEST)
    ways = (
        *(beyond_model, beyond_photographs, jnp.clip(colors.detail, -4, 4)),
        *(_log2_size(residual.footprint), _log2_size(colors.footprint)),
        *(jnp.minimum(residual.angle, 0.6), jnp.minimum(colors.angle, 0.6)),
        *(jnp.log2(1 + jnp.minimum(residual.count, 31)), jnp.minimum(colors.count, 8)),
        *(jnp.where(colors.weight > 0, 1.0, 0.0), _edges(depth), alpha),
    )
    # How much the photographs differ among themselves, what they would add, and how much the two
    # candidates differ: here, and around here.
    powers = (
        *(residual.variance, colors.variance / 4),
        *(jnp.mean(residual.mean**2, axis=-1), jnp.mean(instead**2, axis=-1)),
        jnp.mean((CONTRAST * residual.mean - instead) ** 2, axis=-1),
    )
    product = jnp.mean(residual.mean * instead, axis=-1)
    around = [*map(_log_power, powers)]
    for blur in _BLURS:
        *means, alike = _blur(jnp.stack([*powers, product]), blur)
        alike = alike / jnp.sqrt(means[2] * means[3] + 1e-8)
        around += [*map(_log_power, means), alike]
    return jnp.stack([*ways, *around], axis=-1)


def _log2_size(footprint):
    return jnp.log2(jnp.clip(footprint, 0.25, 16))


def _log_power(values):
    return jnp.log2(jnp.maximum(values, 0) + 1e-5)


def _blur(images, deviation):
    """Means `[N, H, W]` of images over neighbors by Gaussian weights."""
    reach = int(np.ceil(2.5 * deviation))
    taps = np.exp(-((np.arange(-reach, reach + 1) / deviation) ** 2) / 2)
    for axis in (1, 2):
        padding = [(reach, reach) if i == axis else (0, 0) for i in range(3)]
        padded, size = jnp.pad(images, padding, mode="edge"), images.shape[axis]
        parts = (
            float(tap) * jax.lax.slice_in_dim(padded, i, i + size, axis=axis)
            for i, tap in enumerate(taps / taps.sum())
        )
        images = functools.reduce(jnp.add, parts)
    return images


def _edges(depth):
    """How sharply inverse depth `[H, W]` bends, in [0, 1]; 1 where depth is undefined."""
    inverse = safe_divide(jnp.ones_like(depth), depth)
    padded = jnp.pad(inverse, 1, mode="reflect")
    across = padded[1:-1, 2:] + padded[1:-1, :-2] - 2 * inverse
    down = padded[2:, 1:-1] + padded[:-2, 1:-1] - 2 * inverse
    bend = safe_divide(jnp.maximum(jnp.abs(across), jnp.abs(down)), inverse, fill=1.0)
    return bend / (bend + 0.02)
