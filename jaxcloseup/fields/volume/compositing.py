"""Volume rendering: a ray's color, alpha and depth from the samples along it."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.geometry.numerics import safe_divide


_INFINITE = 1e10  # length of the last interval, which stands for the rest of the ray
_EMPTY = 1e-10  # a ray of less alpha is empty: its depth and gradient would overflow


class Composite(NamedTuple):
    """The samples of rays `[...]`, composited.

    Attributes:
      weights: `[..., S]` share of each sample, `w_i = T_i (1 - exp(-sigma_i delta_i))`.
      rgb: `[..., 3]` weighted sum of colors, without a background.
      alpha: `[...]` sum of weights.
      depth: `[...]` weighted mean z-depth; 0 where alpha is below 1e-10.
      expected_depth: `[...]` weighted sum of z-depths, equal to depth times alpha.
      median_depth: `[...]` z-depth of the sample at which transmittance falls below one half; 0
        where it never does.
    """

    weights: jax.Array
    rgb: jax.Array
    alpha: jax.Array
    depth: jax.Array
    expected_depth: jax.Array
    median_depth: jax.Array

    def over(self, background: float | None) -> "Composite":
        """Return the same with a gray level behind the samples in `rgb`; None adds nothing."""
        if background is None:
            return self
        return self._replace(rgb=self.rgb + (1 - self.alpha[..., None]) * background)


def composite(
    rgb: jax.Array, density: jax.Array, depth: jax.Array, ray_length: jax.Array
) -> Composite:
    """Integrate samples along rays by the quadrature of NeRF, eq. 3.

    Args:
      rgb: `[..., S, 3]` colors of the samples.
      density: `[..., S]` non-negative, per world unit.
      depth: `[..., S]` ascending z-depths; each sample stands for the interval up to the next, and
        the last sample for the rest of its ray.
      ray_length: `[...]` length of the ray's direction, in world units per unit of z-depth.
    """
    chex.assert_equal_shape([density, depth])
    chex.assert_shape(rgb, (*density.shape, 3))
    chex.assert_shape(ray_length, density.shape[:-1])
    delta = jnp.diff(depth, axis=-1) * ray_length[..., None]
    optical = density[..., :-1] * delta
    last = density[..., -1:] * _INFINITE * ray_length[..., None]
    return _composite(rgb, jnp.concatenate([optical, last], axis=-1), depth)


def composite_intervals(
    rgb: jax.Array | None, density: jax.Array, edges: jax.Array, ray_length: jax.Array
) -> Composite:
    """Integrate densities and colors that are constant in intervals (mip-NeRF, eq. 4).

    Args:
      rgb: `[..., S, 3]` colors; None: black.
      density: `[..., S]` non-negative, per world unit.
      edges: `[..., S + 1]` ascending z-depths; nothing lies beyond the last. The depth of an
        interval is its middle.
      ray_length: `[...]` length of the ray's direction, in world units per unit of z-depth.
    """
    chex.assert_shape(edges, (*density.shape[:-1], density.shape[-1] + 1))
    chex.assert_shape(ray_length, density.shape[:-1])
    if rgb is None:
        rgb = jnp.zeros((*density.shape, 3), density.dtype)
    optical = density * jnp.diff(edges, axis=-1) * ray_length[..., None]
    return _composite(rgb, optical, 0.5 * (edges[..., 1:] + edges[..., :-1]))


def _composite(rgb: jax.Array, optical: jax.Array, depth: jax.Array) -> Composite:
    """Composite samples of optical depths `[..., S]`."""
    # From the optical depth behind each sample. A sum stays precise where transmittance is tiny.
    after = jnp.exp(-jnp.cumsum(optical, axis=-1))
    transmittance = jnp.concatenate([jnp.ones_like(after[..., :1]), after[..., :-1]], axis=-1)
    weights = transmittance * -jnp.expm1(-optical)
    alpha = jnp.sum(weights, axis=-1)
    expected = jnp.sum(weights * depth, axis=-1)
    median = jnp.where((transmittance >= 0.5) & (after < 0.5), depth, 0)
    return Composite(
        weights=weights,
        rgb=jnp.sum(weights[..., None] * rgb, axis=-2),
        alpha=alpha,
        depth=safe_divide(expected, jnp.where(alpha < _EMPTY, 0, alpha)),
        expected_depth=expected,
        median_depth=jnp.sum(median, axis=-1),
    )
