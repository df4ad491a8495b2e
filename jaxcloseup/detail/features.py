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
    powers = feature_powers(residual, colors, instead)
    rows = jnp.pad(powers, ((0, 0), (REACH, REACH), (0, 0)), mode="edge")
    planes = feature_planes(residual, colors, alpha, edges(depth), rows, finer)
    return jnp.moveaxis(planes, 0, -1)


def feature_powers(residual: Gathered, colors: Gathered, instead: jax.Array) -> jax.Array:
    """Compute what features blur, `[6, H, W]`; arguments as of `pixel_features`.

    How much the photographs differ among themselves, what they would add, how much the two
    candidates differ, and how far they point the same way.
    """
    return jnp.stack(
        [
            *(residual.variance, colors.variance / 4),
            *(_mean(residual.mean**2), _mean(instead**2)),
            *(_mean((CONTRAST * residual.mean - instead) ** 2), _mean(residual.mean * instead)),
        ]
    )


def feature_planes(
    residual: Gathered,
    colors: Gathered,
    alpha: jax.Array,
    bends: jax.Array,
    powers: jax.Array,
    finer: jax.Array,
) -> jax.Array:
    """Compute the networks' inputs for some rows of an image, `[F, H, W]`.

    Args:
      residual: gathered residuals.
      colors: gathered colors.
      alpha: `[H, W]` rendered opacity.
      bends: `[H, W]` of these rows, from `edges` of the whole image.
      powers: `[6, H + 2 REACH, W]` of these rows and of REACH more on each side, from
        `feature_powers`; the image's borders repeat.
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
        *(jnp.where(colors.weight > 0, 1.0, 0.0), bends, alpha),
    )
    # At the pixel, then blurred over its neighbors.
    around = [*map(_log_power, powers[:-1, REACH:-REACH])]
    for deviation in _BLURS:
        *means, alike = _blur_rows(powers, deviation)
        alike = alike / jnp.sqrt(means[2] * means[3] + 1e-8)
        around += [*map(_log_power, means), alike]
    return jnp.stack([*ways, *around])


def _mean(values: jax.Array) -> jax.Array:
    """Return the mean over three channels; a reduction of so few takes four times as long."""
    return (values[..., 0] + values[..., 1] + values[..., 2]) / 3


def _log2_size(footprint: jax.Array) -> jax.Array:
    return jnp.log2(jnp.clip(footprint, 0.25, 16))


def _log_power(values: jax.Array) -> jax.Array:
    return jnp.log2(jnp.maximum(values, 0) + 1e-5)


def blur_images(images: jax.Array, deviation: float) -> jax.Array:
    """Blur images `[N, H, W]` by a Gaussian of a standard deviation in pixels; borders repeat."""
    return _blur_axis(_blur_axis(images, deviation, axis=1), deviation, axis=2)


def _reach(deviation: float) -> int:
    return int(np.ceil(2.5 * deviation))


REACH = _reach(max(_BLURS))  # rows on each side that a pixel's features depend on


def _blur_rows(images: jax.Array, deviation: float) -> jax.Array:
    """Blur images `[N, H + 2 REACH, W]` that have REACH more rows on each side."""
    beyond = REACH - _reach(deviation)
    inner = images[:, beyond : images.shape[1] - beyond]
    return _blur_axis(_sum_taps(inner, deviation, axis=1), deviation, axis=2)


def _blur_axis(images: jax.Array, deviation: float, *, axis: int) -> jax.Array:
    reach = _reach(deviation)
    padding = [(reach, reach) if i == axis else (0, 0) for i in range(3)]
    return _sum_taps(jnp.pad(images, padding, mode="edge"), deviation, axis=axis)


def _sum_taps(padded: jax.Array, deviation: float, *, axis: int) -> jax.Array:
    """Blur along an axis, at whose ends the images have what the blur reaches."""
    reach = _reach(deviation)
    size = padded.shape[axis] - 2 * reach
    taps = np.exp(-((np.arange(-reach, reach + 1) / deviation) ** 2) / 2)
    parts = (
        float(tap) * jax.lax.slice_in_dim(padded, i, i + size, axis=axis)
        for i, tap in enumerate(taps / taps.sum())
    )
    return functools.reduce(jnp.add, parts)


def edges(depth: jax.Array) -> jax.Array:
    """Return how sharply inverse depth `[H, W]` bends, in [0, 1]; 1 where depth is undefined."""
    # Inverse depth is linear over a plane, so its second differences vanish there.
    inverse = safe_divide(jnp.ones_like(depth), depth)
    padded = jnp.pad(inverse, 1, mode="reflect")
    across = padded[1:-1, 2:] + padded[1:-1, :-2] - 2 * inverse
    down = padded[2:, 1:-1] + padded[:-2, 1:-1] - 2 * inverse
    bend = safe_divide(jnp.maximum(jnp.abs(across), jnp.abs(down)), inverse, fill=1.0)
    return bend / (bend + 0.02)
