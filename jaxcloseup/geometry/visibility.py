"""Which points a view sees: inside its image and, by its own depth map, not occluded."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, points_to_pixels
from jaxcloseup.geometry.masks import depth_consistent
from jaxcloseup.geometry.warp import backward_warp


class VisiblePoints(NamedTuple):
    """Where points fall in a view, and what the view weighs there.

    Attributes:
      pixels: `[..., 2]` pixels (x, y) of the view; finite, but without meaning behind the camera.
      depth: `[...]` z-depths in the view.
      weight: `[...]` weights of these pixels; 0 outside the image, behind the camera and where the
        depth map shows another surface.
    """

    pixels: jax.Array
    depth: jax.Array
    weight: jax.Array


def sample_where_visible(
    camera: Camera,
    depth: jax.Array,
    weight: jax.Array,
    points: jax.Array,
    tolerance: jax.Array | float,
) -> VisiblePoints:
    """Project points into one view and read the view's weight where it sees them.

    Args:
      camera: camera of the view.
      depth: `[H, W]` z-depth of the view; 0 where undefined.
      weight: `[H, W]` weights of the view's pixels.
      points: `[..., 3]` in world units.
      tolerance: relative; the view sees a point if its depth map confirms the point's z-depth.
    """
    chex.assert_rank([depth, weight], 2)
    chex.assert_equal_shape([depth, weight])
    pixels, point_depth = points_to_pixels(camera, points)
    observed, pixel_weight = (
        backward_warp(array[..., None], pixels, order=0)[..., 0] for array in (depth, weight)
    )
    confirmed = depth_consistent(observed, point_depth, tolerance)
    return VisiblePoints(pixels, point_depth, jnp.where(confirmed, pixel_weight, 0))


def sphere_in_view(
    camera: Camera,
    center: jax.Array,
    radius: jax.Array,
    *,
    margin: jax.Array | float = 0.0,
    near: jax.Array | float = 0.0,
) -> jax.Array:
    """Return whether spheres `[...]` may reach into a camera's field of view; never a false no.

    Args:
      camera: one camera.
      center: `[..., 3]` centers in the camera's frame.
      radius: `[...]` radii in world units.
      margin: `[...]` or a number; pixels by which the image grows on each side.
      near: z-depth of the near plane.
    """
    x, y, z = jnp.moveaxis(center, -1, 0)
    fx, fy, cx, cy = camera.intrinsics
    inside = z > near - radius
    for slope, first, last, across in ((fx, cx, camera.width, x), (fy, cy, camera.height, y)):
        for sign, offset in ((1, first + margin), (-1, last - first + margin)):
            # Signed distance to the plane through an edge of the image, times the normal's length;
            # multiplying the radius instead of dividing the distance saves four divisions.
            inside &= sign * slope * across + offset * z >= -radius * jnp.hypot(slope, offset)
    return inside
