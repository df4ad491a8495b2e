"""Alignment: by which small motion a camera is off, from what it took and what a model shows.

To first order, a photograph is p = g r + o - grad r . J m for a render r of its view: the camera is
off by m, which moves the image of a surface at the render's depth by J m pixels, and colors have a
gain g and an offset o (Lucas and Kanade 1981, for a rigid motion). Robust least squares over all
pixels solve for the eight numbers.
"""

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.numerics import matmul, safe_divide
from jaxcloseup.geometry.rotations import quaternion_to_matrix


_ROUNDS = 6  # of reweighted least squares
_SQUARE = 16  # side in pixels of the squares of a checkerboard
_LEAST = 1e-3  # difference of gray levels that is not less than typical


def estimate_motion(
    photograph: jax.Array, shown: jax.Array, depth: jax.Array, weight: jax.Array, camera: Camera
) -> jax.Array:
    """Estimate the motion `[6]` that brings a camera to where its photograph was taken.

    Args:
      photograph: `[H, W, 3]` what the camera took, in [0, 1].
      shown: `[H, W, 3]` what a model shows of its view.
      depth: `[H, W]` z-depth of the model, world units.
      weight: `[H, W]` 0 where a pixel does not count, such as without depth.
      camera: the camera.

    Returns:
      A translation in world units, then a rotation vector in radians, both in the camera's frame,
      for `move_camera`; 0 where the pixels do not determine it.
    """
    chex.assert_equal_shape([photograph, shown])
    chex.assert_equal_shape([depth, weight])
    seen, gray = photograph.mean(-1), shown.mean(-1)
    weight = weight.astype(gray.dtype)
    down, across = jnp.gradient(gray)
    moved = _flow(camera, depth)
    moved = -(across[None] * moved[..., 0] + down[None] * moved[..., 1])
    columns = jnp.stack([*moved, gray, jnp.ones_like(gray)], axis=-1).reshape(-1, 8)
    weight = jnp.where(depth > 0, weight, 0).reshape(-1)
    size = jnp.sqrt(jnp.sum(weight[:, None] * columns**2, axis=0))
    columns = safe_divide(columns, size[None])
    missing = (seen - gray).reshape(-1)

    def solve(_: jax.Array, found: jax.Array) -> jax.Array:
        off = missing - matmul(columns, found)
        typical = safe_divide(jnp.sum(weight * jnp.abs(off)), jnp.sum(weight)) + _LEAST
        rows = (weight / (1 + (off / typical) ** 2))[:, None] * columns
        normal, right = matmul(rows.T, columns), matmul(rows.T, missing)
        ridge = 1e-5 * jnp.trace(normal) * jnp.eye(8, dtype=normal.dtype)
        return jnp.linalg.solve(normal + ridge, right)

    found = jax.lax.fori_loop(0, _ROUNDS, solve, jnp.zeros(8, gray.dtype))
    motion = safe_divide(found, size)[:6]
    return jnp.where(jnp.all(jnp.isfinite(motion)), motion, 0)


def _flow(camera: Camera, depth: jax.Array) -> jax.Array:
    """Return by how many pixels each part of a motion moves the image, `[6, H, W, 2]`."""
    points = pixels_to_points(camera, pixel_grid(*depth.shape), jnp.where(depth > 0, depth, 1))

    def project(motion: jax.Array) -> jax.Array:
        return points_to_pixels(move_camera(camera, motion), points)[0]

    return jnp.moveaxis(jax.jacfwd(project)(jnp.zeros(6, depth.dtype)), -1, 0)


def move_camera(camera: Camera, motion: jax.Array) -> Camera:
    """Move a camera by a small motion `[6]` in its own frame, see `estimate_motion`."""
    half = jnp.concatenate([jnp.ones(1, motion.dtype), motion[3:] / 2])
    rotation = matmul(camera.rotation, quaternion_to_matrix(half))
    position = camera.position + matmul(camera.rotation, motion[:3])
    return camera.replace(camtoworld=jnp.concatenate([rotation, position[:, None]], axis=1))


def halves_agree(
    photograph: jax.Array, shown: jax.Array, depth: jax.Array, weight: jax.Array, camera: Camera
) -> jax.Array:
    """Return how alike the motions from two halves of an image are, `[]` in [-1, 1].

    The halves are those of a checkerboard, so that noise in one is not that of the other. Motions
    a and b are as alike as 2 a . b / (|a|^2 + |b|^2) of the pixels that they move, the median.
    Arguments as of `estimate_motion`.
    """
    rows, columns = (jnp.arange(size) // _SQUARE for size in depth.shape)
    odd = ((rows[:, None] + columns[None]) % 2).astype(weight.dtype)
    flow = _flow(camera, depth).reshape(6, -1)
    (x, y), (u, v) = (
        matmul(estimate_motion(photograph, shown, depth, part, camera)[None], flow)
        .reshape(*depth.shape, 2)
        .transpose(2, 0, 1)
        for part in (weight * odd, weight * (1 - odd))
    )
    alike = safe_divide(2 * (x * u + y * v), x * x + y * y + u * u + v * v)
    return jnp.nan_to_num(jnp.nanmedian(jnp.where((weight > 0) & (depth > 0), alike, jnp.nan)))


def shift_between(one: Camera, other: Camera, depth: jax.Array) -> jax.Array:
    """Return how far apart two cameras show the same points, in pixels `[]`, the median.

    Args:
      one: a camera.
      other: a camera of the same size.
      depth: `[H, W]` z-depth of the first one; pixels at 0 do not count.
    """
    pixels = pixel_grid(*depth.shape)
    points = pixels_to_points(one, pixels, jnp.where(depth > 0, depth, 1))
    apart = points_to_pixels(other, points)[0] - pixels
    x, y = apart[..., 0], apart[..., 1]
    shift = jnp.nanmedian(jnp.where(depth > 0, jnp.sqrt(x * x + y * y), jnp.nan))
    return jnp.nan_to_num(shift)
