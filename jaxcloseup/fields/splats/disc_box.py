"""Exact boxes of discs in the image, also of discs that reach through the near plane."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.splats.vectors import Vector, cross
from jaxcloseup.geometry.cameras import Camera


Point = tuple[jax.Array, jax.Array]  # cos and sin `[N]`


def disc_box(
    center: Vector, vectors: tuple[Vector, Vector], cutoff: jax.Array, camera: Camera, near: float
) -> list[jax.Array]:
    """Return exact bounds x0, y0, x1, y1 `[N]` in pixels of discs of radius `cutoff[N]`.

    The rim is center + cutoff (cos t vectors[0] + sin t vectors[1]). The part beyond z = near is
    convex, so points of its rim bound its image: those where a coordinate is stationary along the
    circle, and the ends of the chord at z = near. Published code bounds the ellipse of the whole
    disc, which for a disc that crosses the camera's plane bounds what is *not* visible.
    """
    # The margin keeps pixels that only just reach the cutoff in spite of rounding.
    radius = 1.001 * cutoff
    # Each coordinate x, y, z of the rim is a cos + b sin + c, a triple of [N].
    circle = [(radius * vectors[0][i], radius * vectors[1][i], center[i]) for i in range(3)]
    depth = circle[2]
    chord, has_chord = _meet_circle(depth[0], depth[1], depth[2] - near)
    low, high = [], []
    for axis in range(2):
        a = circle[axis]
        # The derivative of (a.p) / (depth.p) vanishes, where p = (cos t, sin t, 1).
        cos, sin, constant = cross(a, depth)
        rim, has_rim = _meet_circle(cos, sin, -constant)
        candidates: list[tuple[Point, jax.Array | float, jax.Array]] = [
            (point, near, has_chord) for point in chord
        ]
        for point in rim:
            at_depth = _on_circle(depth, point)
            exists = has_rim & (at_depth >= near)
            candidates.append((point, jnp.where(exists, at_depth, 1), exists))
        least: Any = jnp.inf
        most: Any = -jnp.inf
        for point, depth_there, exists in candidates:
            at = _on_circle(a, point) / depth_there
            at = at * camera.intrinsics[axis] + camera.intrinsics[2 + axis]
            least = jnp.minimum(least, jnp.where(exists, at, jnp.inf))
            most = jnp.maximum(most, jnp.where(exists, at, -jnp.inf))
        low.append(least - 0.01)
        high.append(most + 0.01)
    return [*low, *high]


def _on_circle(coordinate: Vector, point: Point) -> jax.Array:
    """Return the value `[N]` of a coordinate (a, b, c) of the rim at a point (cos, sin)."""
    return coordinate[0] * point[0] + coordinate[1] * point[1] + coordinate[2]


def _meet_circle(a: jax.Array, b: jax.Array, c: jax.Array) -> tuple[tuple[Point, Point], jax.Array]:
    """Return both points (cos, sin) with a cos + b sin + c = 0, and whether they exist `[N]`."""
    # Scaled to 1: squares of large coordinates would leave the range of float32.
    largest = jnp.maximum(jnp.maximum(jnp.abs(a), jnp.abs(b)), jnp.maximum(jnp.abs(c), 1e-30))
    a, b, c = a / largest, b / largest, c / largest
    squared = a * a + b * b
    discriminant = squared - c * c
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    # For a disc without extent the equation vanishes, and any point of its rim serves.
    divisor = jnp.where(squared == 0, 1, squared)
    first, second = (
        ((-c * a - s * b * root) / divisor, (-c * b + s * a * root) / divisor) for s in (-1, 1)
    )
    return (first, second), discriminant >= 0
