"""Losses per pixel, unreduced, that gather surfels on a surface (2DGS, section 4.2).

One makes normals agree with depth (equation 14); the other removes the spread of depth along a ray
(equation 13).
"""

import chex
import jax
import jax.numpy as jnp
from jax import lax

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points
from jaxcloseup.geometry.numerics import safe_norm


def depth_to_normal(camera: Camera, depth: jax.Array) -> jax.Array:
    """Return normals `[H, W, 3]` of depth by central differences, world frame, facing the camera.

    Exact on planes. Normals are 0, with gradient 0, at the border and beside pixels without depth.

    Args:
      camera: one camera.
      depth: `[H, W]` z-depth; 0 where it is undefined.
    """
    chex.assert_shape(depth, (camera.height, camera.width))
    if min(depth.shape) < 3:  # all is border
        return jnp.zeros((*depth.shape, 3), depth.dtype)
    pixels = pixel_grid(camera.height, camera.width).astype(depth.dtype)
    points = pixels_to_points(camera, pixels, depth)
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    across = points[1:-1, 2:] - points[1:-1, :-2]
    normal = jnp.cross(down, across)  # towards the camera, since y points down
    length = safe_norm(normal, keepdims=True)
    seen = depth > 0
    seen = seen[2:, 1:-1] & seen[:-2, 1:-1] & seen[1:-1, 2:] & seen[1:-1, :-2]
    defined = seen[..., None] & (length > 0)
    normal = jnp.where(defined, normal / jnp.where(defined, length, 1), 0)
    return jnp.pad(normal, ((1, 1), (1, 1), (0, 0)))


def normal_inconsistency(normal: jax.Array, depth_normal: jax.Array, alpha: jax.Array) -> jax.Array:
    """Return alpha (1 - <normal, depth_normal>) `[H, W]`; 0 where `depth_normal` is undefined.

    Args:
      normal: `[H, W, 3]` rendered normals, not normalized.
      depth_normal: `[H, W, 3]` from `depth_to_normal`.
      alpha: `[H, W]` weight; it gets no gradient.
    """
    chex.assert_equal_shape([normal, depth_normal])
    defined = jnp.any(depth_normal != 0, axis=-1)
    agreement = jnp.sum(normal * depth_normal, axis=-1)
    return lax.stop_gradient(alpha) * jnp.where(defined, 1 - agreement, 0)


def scale_free_distortion(distortion: jax.Array, reference_depth: jax.Array | float) -> jax.Array:
    """Return the distortion of m = 1 - reference_depth / z, the same for every unit of length.

    Args:
      distortion: rendered distortion of inverse depths.
      reference_depth: a typical depth of the scene in world units. The published mapping of z with
        planes n = 0.2 and f = 100 has the reference depth n f / (f - n) = 0.2004.
    """
    return reference_depth**2 * distortion
