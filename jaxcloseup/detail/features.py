"""Features of a pixel from which networks predict how far to trust what is gathered for it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.detail.weights import CONTRAST
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.photos.gather import Gathered


FEATURES = 29  # for each pixel
_NEAREST, _FARTHEST = -1.0, 3.0  # bounds of log2 of how much finer a view is than the photographs
_BLURS = 1.0, 4.0  # standard deviations in pixels


def pixel_features(
    residual: Gathered,
    colors: Gathered,
    instead: jax.Array,
    alpha: jax.Array,
    depth: jax.Array,
    finer: jax.Array,
) -> jax.Array:
    """Return the networks' inputs `[H, W, F]`; their order is that of the stored weights.

    Args:
      residual: gathered residuals.
      colors: gathered colors.
      instead: `[H, W, 3]` what gathered colors would add to the render.
      alpha: `[H, W]` rendered opacity.
      depth: `[H, W]` rendered z-depth; 0 where undefined.
      finer: `[]` of a `Detail`.
    """
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
    # candidates differ: at the pixel, then blurred over its neighbors.
    powers = (
        *(residual.variance, colors.variance / 4),
        *(jnp.mean(residual.mean**2, axis=-1), jnp.mean(instead**2, axis=-1)),
        jnp.mean((CONTRAST * residual.mean - instead) ** 2, axis=-1),
    )
    product = jnp.mean(residual.mean * instead, axis=-1)
    around = [*map(_log_power, powers)]
    for deviation in _BLURS:
        *means, alike = blur_images(jnp.stack([*powers, product]), deviation)
        alike = alike / jnp.sqrt(means[2] * means[3] + 1e-8)
        around += [*map(_log_power, means), alike]
    return jnp.stack([*ways, *around], axis=-1)


def _log2_size(footprint: jax.Array) -> jax.Array:
    return jnp.log2(jnp.clip(footprint, 0.25, 16))


def _log_power(values: jax.Array) -> jax.Array:
    return jnp.log2(jnp.maximum(values, 0) + 1e-5)


def blur_images(images: jax.Array, deviation: float) -> jax.Array:
    """Blur images `[N, H, W]` by a Gaussian of a standard deviation in pixels; borders repeat."""
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


def _edges(depth: jax.Array) -> jax.Array:
    """Return how sharply inverse depth `[H, W]` bends, in [0, 1]; 1 where depth is undefined."""
    # Inverse depth is linear over a plane, so its second differences vanish there.
    inverse = safe_divide(jnp.ones_like(depth), depth)
    padded = jnp.pad(inverse, 1, mode="reflect")
    across = padded[1:-1, 2:] + padded[1:-1, :-2] - 2 * inverse
    down = padded[2:, 1:-1] + padded[:-2, 1:-1] - 2 * inverse
    bend = safe_divide(jnp.maximum(jnp.abs(across), jnp.abs(down)), inverse, fill=1.0)
    return bend / (bend + 0.02)
