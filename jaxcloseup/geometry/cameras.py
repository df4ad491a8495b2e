"""Pinhole cameras: pixels to rays to points, and back.

The camera frame is OpenCV's (x right, y down, z forward) and poses are camera-to-world. Pixels are
continuous (x, y) with the center of the top-left pixel at (0.5, 0.5). Depth is z-depth in world
units; ray directions have unit camera-z, so the parameter along a ray *is* the depth.

Functions take one camera and any number of pixels or points `[...]`; batch cameras with `jax.vmap`.
"""

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.geometry.numerics import matmul


@struct.dataclass
class Camera:
    """A pinhole camera; stacked cameras have leading axes on both arrays.

    Attributes:
      camtoworld: `[3, 4]` rotation and position, camera to world.
      intrinsics: `[4]` fx, fy, cx, cy in pixels.
      height: image height in pixels, static.
      width: image width in pixels, static.
    """

    camtoworld: jax.Array
    intrinsics: jax.Array
    height: int = struct.field(pytree_node=False)
    width: int = struct.field(pytree_node=False)

    @property
    def rotation(self) -> jax.Array:
        """`[..., 3, 3]` camera-to-world rotation; its columns are the camera's axes."""
        return self.camtoworld[..., :3]

    @property
    def position(self) -> jax.Array:
        """`[..., 3]` center of projection, world units."""
        return self.camtoworld[..., 3]


@jax.jit(static_argnames=("height", "width"))
def pixel_grid(height: int, width: int) -> jax.Array:
    """Centers of all pixels, `[height, width, 2]` as (x, y)."""
    x, y = jnp.meshgrid(jnp.arange(0.5, width), jnp.arange(0.5, height))
    return jnp.stack([x, y], axis=-1)


def pixels_to_rays(camera: Camera, pixels: jax.Array) -> tuple[jax.Array, jax.Array]:
    """World rays through pixels.

    Args:
      camera: one camera.
      pixels: `[..., 2]` continuous (x, y).

    Returns:
      `[..., 3]` origins and `[..., 3]` directions. Directions have unit camera-z, not unit length.
    """
    _check_camera(camera)
    chex.assert_axis_dimension(pixels, -1, 2)
    focal, center = camera.intrinsics[:2], camera.intrinsics[2:]
    xy = (pixels - _match(center, pixels)) / _match(focal, pixels)
    in_camera = jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)
    directions = matmul(in_camera, camera.rotation.T)
    return jnp.broadcast_to(camera.position, directions.shape), directions


def pixels_to_points(camera: Camera, pixels: jax.Array, depth: jax.Array) -> jax.Array:
    """World points `[..., 3]` seen at `pixels[..., 2]` with z-depth `depth[...]`."""
    chex.assert_equal_shape_prefix([pixels, depth], depth.ndim)
    origins, directions = pixels_to_rays(camera, pixels)
    return origins + depth[..., None] * directions


def points_to_pixels(camera: Camera, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Project world points.

    Args:
      camera: one camera.
      points: `[..., 3]` in world units.

    Returns:
      `[..., 2]` pixels and `[...]` z-depths. A point with depth <= 0 is not in front of the camera:
      its pixel and gradients are finite but have no meaning, so callers test the depth.
    """
    _check_camera(camera)
    chex.assert_axis_dimension(points, -1, 3)
    in_camera = matmul(points - _match(camera.position, points), camera.rotation)
    depth = in_camera[..., 2]
    in_front = depth > jnp.finfo(depth.dtype).eps
    xy = in_camera[..., :2] / jnp.where(in_front, depth, 1)[..., None]
    focal, center = camera.intrinsics[:2], camera.intrinsics[2:]
    return xy * _match(focal, xy) + _match(center, xy), depth


def crop_camera(camera: Camera, corner: jax.Array, *, height: int, width: int) -> Camera:
    """The camera of a part of an image, which may reach beyond it.

    Args:
      camera: one camera.
      corner: `[2]` x, y of the part's first pixel, 0, 0 at the image's.
      height: of the part in pixels.
      width: of the part in pixels.
    """
    moved = jnp.concatenate([jnp.zeros(2), jnp.asarray(corner, camera.intrinsics.dtype)])
    return camera.replace(intrinsics=camera.intrinsics - moved, height=height, width=width)


def mean_focal(intrinsics: jax.Array) -> jax.Array:
    """Geometric mean `[...]` of fx and fy in pixels, of intrinsics `[..., 4]`."""
    return jnp.sqrt(intrinsics[..., 0] * intrinsics[..., 1])


def _check_camera(camera: Camera) -> None:
    chex.assert_shape(camera.camtoworld, (3, 4))
    chex.assert_shape(camera.intrinsics, (4,))


def _match(vector: jax.Array, like: jax.Array) -> jax.Array:
    """Reshape a vector to broadcast along the last axis of `like` without rank promotion."""
    return vector.reshape((1,) * (like.ndim - 1) + vector.shape)
