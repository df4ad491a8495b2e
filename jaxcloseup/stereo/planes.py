"""Slanted planes, one at each pixel, and how they carry pixels into another photograph.

Inverse z-depth is affine in the pixels of a plane's image. So a plane at pixel (x, y) is three
numbers: inverse depth w there, and its change per pixel along x and y. The point of pixel p is
seen by another camera at A (p, 1) + b w(p), in homogeneous coordinates: the plane's homography.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.numerics import matmul, safe_divide, safe_norm


class Relative(NamedTuple):
    """Where another photograph sees the points of one: at A (p, 1) + b w, over its last row.

    Attributes:
      matrix: `[..., 3, 3]` A, pixels to pixels of points at infinity.
      offset: `[..., 3]` b, the epipole in pixels times world units.
    """

    matrix: jax.Array
    offset: jax.Array


def relative_transforms(camera: Camera, others: Camera) -> Relative:
    """Return how pixels and inverse depths of one camera map to pixels of stacked others `[N]`.

    The last homogeneous coordinate is the ratio of the two z-depths.
    """
    fx, fy, cx, cy = camera.intrinsics
    zero, one = jnp.zeros_like(fx), jnp.ones_like(fx)
    lift = [[1 / fx, zero, -cx / fx], [zero, 1 / fy, -cy / fy], [zero, zero, one]]
    to_rays = matmul(camera.rotation, jnp.stack([jnp.stack(row) for row in lift]))

    def transform(other: Camera) -> Relative:
        fx, fy, cx, cy = other.intrinsics
        lens = jnp.stack(
            [jnp.stack(row) for row in ([fx, zero, cx], [zero, fy, cy], [zero, zero, one])]
        )
        project = matmul(lens, other.rotation.T)
        moved = camera.position - other.position
        return Relative(matmul(project, to_rays), matmul(project, moved[:, None])[:, 0])

    return jax.vmap(transform)(others)


def shift_planes(planes: jax.Array, dx: jax.Array | int, dy: jax.Array | int) -> jax.Array:
    """Return planes `[..., 3, H, W]` as seen from pixels (dx, dy) away, which lie on them."""
    inverse, along_x, along_y = jnp.moveaxis(planes, -3, 0)
    return jnp.stack([inverse + dx * along_x + dy * along_y, along_x, along_y], axis=-3)


def plane_normals(camera: Camera, pixels: jax.Array, planes: jax.Array) -> jax.Array:
    """Return unit world normals `[H, W, 3]` of planes, facing the camera.

    Args:
      camera: one camera.
      pixels: `[H, W, 2]` where the planes are.
      planes: `[3, H, W]` inverse depth and its change per pixel along x and y; 0 is undefined and
        has the normal 0.
    """
    fx, fy, cx, cy = camera.intrinsics
    inverse, along_x, along_y = planes
    across = inverse - along_x * (pixels[..., 0] - cx) - along_y * (pixels[..., 1] - cy)
    normal = -jnp.stack([fx * along_x, fy * along_y, across], axis=-1)
    normal = safe_divide(normal, jnp.broadcast_to(safe_norm(normal, keepdims=True), normal.shape))
    return matmul(normal, camera.rotation.T)
