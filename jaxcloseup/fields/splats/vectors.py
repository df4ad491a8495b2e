"""Many vectors as components: on a CPU, sums over them are several times faster than over rows."""

import jax


# Components x, y, z `[N]` of N vectors.
Vector = tuple[jax.Array, jax.Array, jax.Array]


def dot(a: Vector, b: Vector) -> jax.Array:
    """Return inner products `[N]`."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Return cross products."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def scaled(factor: jax.Array, vector: Vector) -> Vector:
    """Return vectors times factors `[N]`."""
    return factor * vector[0], factor * vector[1], factor * vector[2]
