"""Real spherical harmonics to degree 3, the view-dependent color of a splat."""

import math
from collections.abc import Sequence

import chex
import jax
import jax.numpy as jnp


_CONSTANT = math.sqrt(1 / (4 * math.pi))


def sh_basis(directions: jax.Array, degree: int) -> jax.Array:
    """Return the orthonormal basis `[..., (degree + 1)^2]` at unit `directions[..., 3]`.

    `degree` is 0 to 3. Functions are ordered by degree, then order, with the signs (-1)^m that
    splat files use.

    Raises:
      ValueError: `degree` is not 0 to 3.
    """
    chex.assert_axis_dimension(directions, -1, 3)
    x, y, z = jnp.moveaxis(directions, -1, 0)
    return jnp.stack(_basis(x, y, z, degree), axis=-1)


def _basis(x: jax.Array, y: jax.Array, z: jax.Array, degree: int) -> list[jax.Array]:
    if degree not in range(4):
        raise ValueError(f"spherical harmonics must have degree 0 to 3, not {degree}")
    xx, yy, zz = x * x, y * y, z * z
    root = lambda numerator, denominator: math.sqrt(numerator / (denominator * math.pi))  # noqa: E731
    basis = [jnp.full_like(x, _CONSTANT)]
    if degree >= 1:
        basis += [-root(3, 4) * y, root(3, 4) * z, -root(3, 4) * x]
    if degree >= 2:
        basis += [
            root(15, 4) * x * y,
            -root(15, 4) * y * z,
            root(5, 16) * (2 * zz - xx - yy),
            -root(15, 4) * x * z,
            root(15, 16) * (xx - yy),
        ]
    if degree >= 3:
        basis += [
            -root(35, 32) * y * (3 * xx - yy),
            root(105, 4) * x * y * z,
            -root(21, 32) * y * (4 * zz - xx - yy),
            root(7, 16) * z * (2 * zz - 3 * xx - 3 * yy),
            -root(21, 32) * x * (4 * zz - xx - yy),
            root(105, 16) * z * (xx - yy),
            -root(35, 32) * x * (xx - 3 * yy),
        ]
    return basis


def sh_to_rgb(sh: jax.Array, directions: jax.Array) -> jax.Array:
    """Return colors max(0, 1/2 + sum_k Y_k sh_k) `[..., 3]` along viewing directions.

    Args:
      sh: `[..., (L + 1)^2, 3]` coefficients.
      directions: `[..., 3]` unit vectors from the camera to the splat, world frame.
    """
    chex.assert_axis_dimension(directions, -1, 3)
    columns = [[sh[..., k, c] for c in range(3)] for k in range(sh.shape[-2])]
    return jnp.stack(sh_to_channels(columns, *jnp.moveaxis(directions, -1, 0)), axis=-1)


def sh_to_channels(
    sh: Sequence[Sequence[jax.Array]], x: jax.Array, y: jax.Array, z: jax.Array
) -> tuple[jax.Array, ...]:
    """Return `sh_to_rgb` of `(L + 1)^2` times 3 arrays `[...]` of coefficients, as 3 of colors.

    `x`, `y` and `z` are the components `[...]` of the directions.
    """
    degree = math.isqrt(len(sh)) - 1
    if (degree + 1) ** 2 != len(sh):
        raise ValueError(f"spherical harmonics of degree L have (L + 1)^2 terms, not {len(sh)}")
    basis = _basis(x, y, z, degree)
    return tuple(
        jnp.maximum(sum(y * terms[c] for y, terms in zip(basis, sh, strict=True)) + 0.5, 0)
        for c in range(3)
    )


def rgb_to_sh(rgb: jax.Array) -> jax.Array:
    """Return constant coefficients `[..., 3]` of the color `rgb[..., 3]` in all directions."""
    return (rgb - 0.5) / _CONSTANT
