"""Rotations as matrices, Euler angles and quaternions.

Angles are radians about x, y, z, composed as R = Rz Ry Rx. Quaternions are (w, x, y, z).
Functions take any leading axes `[...]`.
"""

import chex
import jax
import jax.numpy as jnp


def euler_to_matrix(angles: jax.Array) -> jax.Array:
    """Return rotation matrices `[..., 3, 3]` of Euler angles `[..., 3]` (x, y, z): R = Rz Ry Rx."""
    chex.assert_axis_dimension(angles, -1, 3)
    # R = Rz Ry Rx, multiplied out.
    (cx, cy, cz), (sx, sy, sz) = (jnp.moveaxis(f(angles), -1, 0) for f in (jnp.cos, jnp.sin))
    rows = [
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_euler(rotation: jax.Array) -> jax.Array:
    """Return Euler angles `[..., 3]` of rotation matrices `[..., 3, 3]`.

    This is the inverse of `euler_to_matrix`. y lies in [-pi/2, pi/2]. At gimbal lock (|y| = pi/2)
    x and z turn about one axis: x takes the whole turn and z is 0, which reproduces the matrix.
    Gradients are finite everywhere.
    """
    chex.assert_axis_dimension(rotation, -1, 3)
    chex.assert_axis_dimension(rotation, -2, 3)
    m = rotation
    locked = m[..., 0, 0] ** 2 + m[..., 1, 0] ** 2 < jnp.finfo(m.dtype).eps ** 2
    z = jnp.arctan2(jnp.where(locked, 0, m[..., 1, 0]), jnp.where(locked, 1, m[..., 0, 0]))
    # Solve Rz^T R = Ry Rx for x and y. Near the lock z is mostly rounding error; x absorbs it here,
    # while the usual quotients of small entries would not.
    cos_z, sin_z = jnp.cos(z), jnp.sin(z)
    y = jnp.arctan2(-m[..., 2, 0], cos_z * m[..., 0, 0] + sin_z * m[..., 1, 0])
    x = jnp.arctan2(
        sin_z * m[..., 0, 2] - cos_z * m[..., 1, 2], cos_z * m[..., 1, 1] - sin_z * m[..., 0, 1]
    )
    return jnp.stack([x, y, z], axis=-1)


def quaternion_to_matrix(wxyz: jax.Array) -> jax.Array:
    """Return rotation matrices `[..., 3, 3]` of quaternions `[..., 4]`, which need not be unit.

    The zero quaternion gives the identity, with finite gradients.
    """
    chex.assert_axis_dimension(wxyz, -1, 4)
    rows = quaternion_rows(*jnp.moveaxis(wxyz, -1, 0))
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_rows(
    w: jax.Array, x: jax.Array, y: jax.Array, z: jax.Array
) -> list[list[jax.Array]]:
    """Return the rows of `quaternion_to_matrix` as nine arrays `[...]`.

    On a CPU, loops over many quaternions are several times faster than with stacked matrices.
    """
    squared = w * w + x * x + y * y + z * z
    norm = jnp.sqrt(jnp.where(squared == 0, 1, squared))
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
