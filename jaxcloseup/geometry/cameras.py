"""Pinhole cameras: pixels to rays to points, and back.

The camera frame is OpenCV's (x right, y down, z forward) and poses are camera-to-world. Pixels are
continuous (x, y) with the center of the top-left pixel at (0.5, 0.5). Depth is z-depth in world
units; ray directions have unit camera-z, so the parameter along a ray *is* the depth.

Functions take one camera and any number of pixels or points `[...]`; batch cameras with `jax.vmap`.
"""

from collections.abc import Sequence

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.geometry.numerics import matmul, safe_divide, safe_norm


class Camera(struct.PyTreeNode):
    """A pinhole camera; stacked cameras have leading axes on both arrays.

    `Camera(camtoworld, intrinsics, height, width)` takes the fields as they are. The constructors
    `from_matrix`, `from_opengl`, `from_fov` and `look_at` convert other descriptions to them.

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
        """Return the camera-to-world rotation `[..., 3, 3]`; its columns are the camera's axes."""
        return self.camtoworld[..., :3]

    @property
    def position(self) -> jax.Array:
        """Return the center of projection `[..., 3]` in world units."""
        return self.camtoworld[..., 3]

    @classmethod
    def from_matrix(
        cls,
        camtoworld: jax.typing.ArrayLike,
        intrinsics: jax.typing.ArrayLike,
        *,
        height: int,
        width: int,
    ) -> "Camera":
        """Return a camera from matrices in OpenCV's convention.

        Args:
          camtoworld: `[..., 4, 4]` or `[..., 3, 4]` camera-to-world pose.
          intrinsics: `[..., 3, 3]` matrix K, which maps to pixels whose top-left center is
            (0.5, 0.5). Add 0.5 to cx and cy of a K that puts this center at (0, 0), as OpenCV's
            own calibration does. Skew is not supported: K[0, 1] is ignored.
          height: image height in pixels.
          width: image width in pixels.
        """
        camtoworld, matrix = _floats(camtoworld), _floats(intrinsics)
        chex.assert_axis_dimension(camtoworld, -1, 4)
        chex.assert_axis_dimension(matrix, -1, 3)
        chex.assert_axis_dimension(matrix, -2, 3)
        focal, center = jnp.diagonal(matrix, axis1=-2, axis2=-1)[..., :2], matrix[..., :2, 2]
        return cls(camtoworld[..., :3, :], jnp.concatenate([focal, center], axis=-1), height, width)

    @classmethod
    def from_opengl(
        cls,
        camtoworld: jax.typing.ArrayLike,
        intrinsics: jax.typing.ArrayLike,
        *,
        height: int,
        width: int,
    ) -> "Camera":
        """Return a camera from a pose in OpenGL's convention: x right, y up, z backward.

        Blender and `transforms*.json` use it. The world stays the same; only the camera's axes y
        and z turn round. Arguments as in `from_matrix`.
        """
        flip = jnp.array([1, -1, -1, 1], _floats(camtoworld).dtype)
        camtoworld = _floats(camtoworld)
        return cls.from_matrix(
            camtoworld * _match(flip, camtoworld), intrinsics, height=height, width=width
        )

    @classmethod
    def from_fov(
        cls,
        camtoworld: jax.typing.ArrayLike,
        fov: jax.typing.ArrayLike,
        *,
        height: int,
        width: int,
        vertical: bool = False,
    ) -> "Camera":
        """Return a camera with square pixels and its principal point at the image's center.

        Args:
          camtoworld: `[4, 4]` or `[3, 4]` camera-to-world pose, OpenCV.
          fov: `[]` angle of view in radians, between the left and right edges of the image
            (`camera_angle_x` of `transforms*.json`).
          height: image height in pixels.
          width: image width in pixels.
          vertical: whether `fov` is the angle between the top and bottom edges instead.
        """
        chex.assert_rank(_floats(camtoworld), 2)
        focal = (height if vertical else width) / (2 * jnp.tan(_floats(fov) / 2))
        center = jnp.array([width / 2, height / 2], focal.dtype)
        intrinsics = jnp.concatenate([jnp.stack([focal, focal]), center])
        return cls(_floats(camtoworld)[:3], intrinsics, height, width)

    @classmethod
    def look_at(
        cls,
        position: jax.typing.ArrayLike | Sequence[float],
        target: jax.typing.ArrayLike | Sequence[float],
        fov: jax.typing.ArrayLike,
        *,
        height: int,
        width: int,
        up: jax.typing.ArrayLike | Sequence[float] = (0.0, 0.0, 1.0),
    ) -> "Camera":
        """Return a camera that shows a target at the center of its image.

        Args:
          position: `[3]` center of projection, world units.
          target: `[3]` point to look at, unlike `position`.
          fov: `[]` horizontal angle of view in radians, see `from_fov`.
          height: image height in pixels.
          width: image width in pixels.
          up: `[3]` world direction that points up in the image. If the camera looks along it, a
            fixed direction across the view takes its place.
        """
        position, target, up = map(_floats, (position, target, up))
        forward = _unit(target - position)
        # The world axis that is most across the view stands in for a parallel `up`.
        across = jnp.eye(3, dtype=forward.dtype)[jnp.argmin(jnp.abs(forward))]
        right = jnp.cross(forward, _unit(up))
        right = jnp.where(safe_norm(right) < 1e-6, jnp.cross(forward, across), right)
        right = _unit(right)
        axes = [right, jnp.cross(forward, right), forward, position]
        return cls.from_fov(jnp.stack(axes, axis=-1), fov, height=height, width=width)


@jax.jit(static_argnames=("height", "width"))
def pixel_grid(height: int, width: int) -> jax.Array:
    """Return the centers of all pixels, `[height, width, 2]` as (x, y)."""
    x, y = jnp.meshgrid(jnp.arange(0.5, width), jnp.arange(0.5, height))
    return jnp.stack([x, y], axis=-1)


def pixels_to_rays(camera: Camera, pixels: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the world rays through pixels.

    Args:
      camera: one camera.
      pixels: `[..., 2]` continuous (x, y).

    Returns:
      `[..., 3]` origins and `[..., 3]` directions, of the camera's type. Directions have unit
      camera-z, not unit length.
    """
    _check_camera(camera)
    chex.assert_axis_dimension(pixels, -1, 2)
    # With 64 bits, `pixel_grid` has them, and a camera of 32 bits has no more to say.
    pixels = jnp.asarray(pixels, camera.intrinsics.dtype)
    focal, center = camera.intrinsics[:2], camera.intrinsics[2:]
    xy = (pixels - _match(center, pixels)) / _match(focal, pixels)
    in_camera = jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)
    directions = matmul(in_camera, camera.rotation.T)
    return jnp.broadcast_to(camera.position, directions.shape), directions


def pixels_to_points(camera: Camera, pixels: jax.Array, depth: jax.Array) -> jax.Array:
    """Return the world points `[..., 3]` seen at `pixels[..., 2]` with z-depth `depth[...]`."""
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
    # Divide by 1 behind the camera: `where` alone would leave NaN in the gradient.
    in_front = depth > jnp.finfo(depth.dtype).eps
    xy = in_camera[..., :2] / jnp.where(in_front, depth, 1)[..., None]
    focal, center = camera.intrinsics[:2], camera.intrinsics[2:]
    return xy * _match(focal, xy) + _match(center, xy), depth


def crop_camera(camera: Camera, corner: jax.Array, *, height: int, width: int) -> Camera:
    """Return the camera of a part of an image; the part may reach beyond the image.

    Args:
      camera: one camera.
      corner: `[2]` (x, y) of the part's top-left corner in pixels of the image.
      height: height of the part in pixels.
      width: width of the part in pixels.
    """
    corner = jnp.asarray(corner, camera.intrinsics.dtype)
    moved = jnp.concatenate([jnp.zeros_like(corner), corner])
    return camera.replace(intrinsics=camera.intrinsics - moved, height=height, width=width)


def mean_focal(intrinsics: jax.Array) -> jax.Array:
    """Return the geometric mean `[...]` of fx and fy in pixels from intrinsics `[..., 4]`."""
    return jnp.sqrt(intrinsics[..., 0] * intrinsics[..., 1])


def _check_camera(camera: Camera) -> None:
    chex.assert_shape(camera.camtoworld, (3, 4))
    chex.assert_shape(camera.intrinsics, (4,))


def _floats(values: jax.typing.ArrayLike | Sequence[float]) -> jax.Array:
    """Return an array of JAX's default floating type."""
    return jnp.asarray(values, jnp.result_type(float))


def _unit(vector: jax.Array) -> jax.Array:
    return safe_divide(vector, jnp.broadcast_to(safe_norm(vector), vector.shape))


def _match(vector: jax.Array, like: jax.Array) -> jax.Array:
    """Reshape a vector to broadcast along the last axis of `like` without rank promotion."""
    return vector.reshape((1,) * (like.ndim - 1) + vector.shape)
