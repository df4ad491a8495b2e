"""Cut the cones of pixels into frustums, and encode the content of a frustum.

A cone has radius `radius` t at z-depth t. Along a ray with unit camera-z, a frustum reaches from
one edge to the next. Arrays have coordinates or features first; intervals are `[R, S]`.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.fields.volume.encodings import positional_encoding
from jaxcloseup.fields.volume.rays import Rays


# A disc of this radius, in widths of a pixel, has the variance of the square pixel (mip-NeRF, 3.1).
RADIUS = 2 / 12**0.5
# Order of the angles about the ray of a frustum's six samples (Zip-NeRF, eq. 3).
_SIX = np.array([0, 2, 4, 3, 5, 1])


class Moments(NamedTuple):
    """Moments of a uniform density in a frustum, along its ray and across, each `[R, S]`."""

    mean: jax.Array
    along: jax.Array
    across: jax.Array


def frustum_moments(edges: jax.Array, radius: jax.Array) -> Moments:
    """Compute mean and variances of points in frustums (mip-NeRF, eq. 7).

    Args:
      edges: `[R, S + 1]` ascending z-depths.
      radius: `[R]` of the cones at z-depth 1.

    Returns:
      Mean and variance of z-depth, and variance of either coordinate across the ray.
    """
    middle = 0.5 * (edges[..., 1:] + edges[..., :-1])
    half = 0.5 * jnp.diff(edges, axis=-1)
    m2, h2 = middle**2, half**2
    total = 3 * m2 + h2
    return Moments(
        mean=middle + 2 * middle * h2 / total,
        along=h2 / 3 - 4 / 15 * (h2 / total) ** 2 * (12 * m2 - h2),
        across=radius[..., None] ** 2 * (m2 / 4 + 5 / 12 * h2 - 4 / 15 * h2**2 / total),
    )


def frustum_gaussians(rays: Rays, edges: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute means and variances `[3, R, S]` of frustums (mip-NeRF, eq. 8 and 16)."""
    moments = frustum_moments(edges, RADIUS * rays.pixel)
    squared = (rays.directions**2).T[..., None]  # [3, R, 1]
    share = squared / jnp.sum(squared, axis=0, keepdims=True)
    variance = moments.along[None] * squared + moments.across[None] * (1 - share)
    return rays.at(moments.mean), variance


def integrated_encoding(mean: jax.Array, variance: jax.Array, num_octaves: int) -> jax.Array:
    """Return the mean positional encoding of normally distributed positions (mip-NeRF, eq. 14).

    Args:
      mean: `[3, M]`.
      variance: `[3, M]`, of independent coordinates.
      num_octaves: number of octaves k.

    Returns:
      `[6 num_octaves, M]`: sin and cos of `2^k mean`, times `exp(-4^k variance / 2)`.
    """
    chex.assert_equal_shape([mean, variance])
    waves = positional_encoding(mean, num_octaves)[len(mean) :]
    powers = 4.0 ** np.arange(num_octaves)[:, None, None, None]
    kept = jnp.exp(-0.5 * jnp.asarray(powers, mean.dtype) * variance[None, None])
    return waves * jnp.tile(kept, (1, 2, 1, 1)).reshape(waves.shape)


def frustum_samples(
    key: jax.Array | None, rays: Rays, edges: jax.Array, count: int = 6
) -> tuple[jax.Array, jax.Array]:
    """Place points with a frustum's moments in it, with their scale (Zip-NeRF, eq. 1 to 3).

    Fewer points than the paper's six are cheaper. Depth and place across then go together in one
    frustum, though not on average over turns, and a single point has no variance along the ray.

    Args:
      key: consumed, turns each frustum's points about its ray; None does not, and has a single
        point on the ray.
      rays: `[R]`.
      edges: `[R, S + 1]` ascending z-depths.
      count: number of points, N.

    Returns:
      Positions `[3, R, S, N]`, and standard deviations `[R, S, N]` of Gaussians about them.
    """
    begin = edges[..., :-1, None]
    middle = 0.5 * (edges[..., 1:] + edges[..., :-1])[..., None]
    half = 0.5 * jnp.diff(edges, axis=-1)[..., None]
    m2, h2 = middle**2, half**2
    # Of variance 3/5, as in the paper, whose six have a factor of 3 / sqrt(7).
    even = (2 * np.arange(count) - (count - 1)) * (1.8 / max(count**2 - 1, 1)) ** 0.5
    steps = jnp.asarray(even[None, None], edges.dtype)
    root = jnp.sqrt((h2 - m2) ** 2 + 4 * m2**2)
    depth = begin + half * ((edges[..., 1:, None]) ** 2 + 2 * m2 + steps * root) / (h2 + 3 * m2)
    turns = _SIX if count == 6 else np.arange(count)
    angles = jnp.asarray(turns[None, None] * 2 * np.pi / count, edges.dtype)
    if key is not None:
        angles = angles + 2 * jnp.pi * jax.random.uniform(key, middle.shape, edges.dtype)
    away = RADIUS * rays.pixel[:, None, None] * depth / 2**0.5  # [R, S, N]
    # A single point beside the ray, always on one side, would move all that is seen.
    beside = jnp.zeros_like(away) if count == 1 and key is None else away
    first, second = _across(rays.unit)
    turned = first[..., None, None] * jnp.cos(angles)[None]
    turned += second[..., None, None] * jnp.sin(angles)[None]
    along = rays.origins.T[..., None, None] + rays.directions.T[..., None, None] * depth[None]
    return along + turned * beside[None], 0.5 * away


def _across(unit: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return two unit vectors `[3, R]` orthogonal to unit vectors and to each other."""
    axes = jnp.eye(3, dtype=unit.dtype)
    least = axes[:, jnp.argmin(jnp.abs(unit), axis=0)]
    first = jnp.cross(unit, least, axis=0)
    first /= jnp.linalg.norm(first, axis=0, keepdims=True)
    return first, jnp.cross(unit, first, axis=0)
