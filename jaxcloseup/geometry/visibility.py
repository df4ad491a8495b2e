"""What one photograph shows of points and of another view, judged by its own depth map."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.masks import depth_consistent, in_bounds
from jaxcloseup.geometry.warp import backward_warp


class WarpedImage(NamedTuple):
    """A source photograph as seen from a target camera.

    Attributes:
      image: `[H, W, C]` colors read from the source, 0 where not valid.
      valid: `[H, W]` bool, whether the source shows the target's surface.
      pixels: `[H, W, 2]` source pixels (x, y); finite, but without meaning where not valid.
    """

    image: jax.Array
    valid: jax.Array
    pixels: jax.Array


def sample_where_visible(
    camera: Camera,
    depth: jax.Array,
    weight: jax.Array,
    points: jax.Array,
    tolerance: jax.Array | float,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Project points into one view and read the view's weight where it sees them.

    Args:
      camera: camera of the view.
      depth: `[H, W]` z-depth of the view; 0 where undefined.
      weight: `[H, W]` weights of the view's pixels.
      points: `[..., 3]` in world units.
      tolerance: relative; the view sees a point if its depth map confirms the point's z-depth.

    Returns:
      `[..., 2]` pixels, `[...]` z-depths, and `[...]` weights, which are 0 outside the image,
      behind the camera and where the depth map shows another surface.
    """
    chex.assert_rank([depth, weight], 2)
    chex.assert_equal_shape([depth, weight])
    landed, landed_depth = points_to_pixels(camera, points)
    observed, found = (
        backward_warp(array[..., None], landed, order=0)[..., 0] for array in (depth, weight)
    )
    confirmed = depth_consistent(observed, landed_depth, tolerance)
    return landed, landed_depth, jnp.where(confirmed, found, 0)


def warp_to(
    source_image: jax.Array,
    source: Camera,
    target: Camera,
    depth: jax.Array,
    *,
    source_depth: jax.Array | None = None,
    tolerance: jax.Array | float = 0.02,
) -> WarpedImage:
    """Read a source photograph into a target view: the paper's backward warp in one call.

    Each target pixel is lifted with its z-depth, projected into the source and read there
    bilinearly. It is not valid where its depth is undefined, where its point lies behind the source
    camera or outside the source image, or, given `source_depth`, where another surface hides it.

    Args:
      source_image: `[Hs, Ws, C]` float.
      source: camera of the photograph, of size `Hs, Ws`.
      target: camera of the view to fill, of size `H, W`.
      depth: `[H, W]` z-depth of the target view; not positive or not finite is undefined.
      source_depth: `[Hs, Ws]` z-depth of the photograph; None ignores occlusion.
      tolerance: relative; a point is hidden if its z-depth in the source differs by more from
        `source_depth` at the nearest pixel.

    Returns:
      A `WarpedImage`. `image` is differentiable in `source_image`, in `depth` and in the cameras;
      gradients are finite, and 0 where not valid.
    """
    chex.assert_shape(source_image, (source.height, source.width, None))
    chex.assert_type(source_image, float)
    chex.assert_shape(depth, (target.height, target.width))
    defined = (depth > 0) & jnp.isfinite(depth)
    grid = pixel_grid(target.height, target.width)
    points = pixels_to_points(target, grid, jnp.where(defined, depth, 1))
    pixels, landed_depth = points_to_pixels(source, points)
    valid = defined & (landed_depth > 0) & in_bounds(pixels, source.height, source.width)
    if source_depth is not None:
        chex.assert_shape(source_depth, (source.height, source.width))
        observed = backward_warp(source_depth[..., None], pixels, order=0)[..., 0]
        valid &= depth_consistent(observed, landed_depth, tolerance)
    image = jnp.where(valid[..., None], backward_warp(source_image, pixels), 0)
    return WarpedImage(image, valid, pixels)


def sphere_in_view(
    camera: Camera,
    center: jax.Array,
    radius: jax.Array,
    *,
    margin: jax.Array | float = 0.0,
    near: jax.Array | float = 0.0,
) -> jax.Array:
    """Whether spheres meet the part of space that a camera sees: `[...]`, never wrongly no.

    Args:
      camera: one camera.
      center: `[..., 3]` centers in the camera's frame.
      radius: `[...]` radii in world units.
      margin: `[...]` or a number; pixels by which the image is larger on each side.
      near: z-depth before which nothing is seen.
    """
    x, y, z = jnp.moveaxis(center, -1, 0)
    fx, fy, cx, cy = camera.intrinsics
    inside = z > near - radius
    for slope, first, last, across in ((fx, cx, camera.width, x), (fy, cy, camera.height, y)):
        for sign, offset in ((1, first + margin), (-1, last - first + margin)):
            # Signed distance to the plane through an edge of the image, times the normal's length.
            inside &= sign * slope * across + offset * z >= -radius * jnp.hypot(slope, offset)
    return inside
