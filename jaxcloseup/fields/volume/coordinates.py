"""Changes of coordinates: distances along rays, and all of space into a ball."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.numerics import safe_norm


def spaced(x: jax.Array, near: float, far: float, *, spacing: float) -> jax.Array:
    """Map distances in [near, far] to [0, 1], in proportion to a power transformation.

    The transformation is P(x) = |p - 1| / p ((x / |p - 1| + 1)^p - 1) for an exponent p (Zip-NeRF,
    eq. 24): even steps for p = 1, logarithmic ones for p = 0, and steps that grow with the square
    of the distance far away for p = -1.

    Args:
      x: `[...]` distances.
      near: what becomes 0.
      far: what becomes 1.
      spacing: p, at most 1.
    """
    low, high = (_power(np.float64(end), spacing, np) for end in (near, far))
    return (_power(x, spacing, jnp) - low) / (high - low)


def unspaced(s: jax.Array, near: float, far: float, *, spacing: float) -> jax.Array:
    """Map [0, 1] back to distances: the inverse of `spaced`."""
    low, high = (_power(np.float64(end), spacing, np) for end in (near, far))
    y = float(low) + s * float(high - low)
    if spacing == 1:
        return y
    if spacing == 0:
        return jnp.expm1(y)
    bend = abs(spacing - 1)
    return bend * ((1 + spacing * y / bend) ** (1 / spacing) - 1)


def _power(x: Any, p: float, xnp: Any) -> Any:
    if p == 1:
        return x
    if p == 0:
        return xnp.log1p(x)
    bend = abs(p - 1)
    return bend / p * ((x / bend + 1) ** p - 1)


def contract(positions: jax.Array) -> jax.Array:
    """Draw positions `[3, ...]` beyond the unit ball into a ball of radius 2.

    `(2 - 1 / |x|) x / |x|` where |x| > 1 (mip-NeRF 360, eq. 10).
    """
    norm = safe_norm(positions, axis=0, keepdims=True)
    outside = norm > 1
    norm = jnp.where(outside, norm, 1)
    return jnp.where(outside, (2 - 1 / norm) / norm * positions, positions)


def contraction_scale(positions: jax.Array) -> jax.Array:
    """Return the factor `[...]` by which `contract` scales lengths at positions `[3, ...]`.

    It is a geometric mean: the cube root of the determinant of the contraction's Jacobian, whose
    singular values are 1 / |x|^2 along x and (2 |x| - 1) / |x|^2 across it.
    """
    norm = jnp.maximum(safe_norm(positions, axis=0), 1)
    return jnp.cbrt(jnp.square(2 * norm - 1)) / jnp.square(norm)
