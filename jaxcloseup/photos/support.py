"""Support: how many training photographs saw each rendered pixel, and how sharply."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, mean_focal, pixels_to_points
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.geometry.visibility import sample_where_visible
from jaxcloseup.photos.views import Views


class Support(NamedTuple):
    """How well photographs saw the surface at each pixel of a rendered view.

    Attributes:
      count: `[...]` int32 number of training photographs that saw the surface.
      footprint: `[...]` side of their smallest pixel on it, in pixels of the rendered view: 1 is as
        sharp as the render, 4 is four times coarser; infinity where no photograph saw it.
    """

    count: jax.Array  # type: ignore[assignment]  # hides a method of tuples
    footprint: jax.Array


def find_support(
    camera: Camera,
    pixels: jax.Array,
    depth: jax.Array,
    views: Views,
    depths: jax.Array,
    *,
    tolerance: float = 0.02,
) -> Support:
    """Count the training photographs that saw the surface at each pixel, and find the finest.

    A photograph saw a point if the point lands on one of its pixels of weight above 0 and its own
    depth map confirms the point's z-depth to a relative `tolerance`. At z-depth z, a pixel covers
    z / f of a surface that is parallel to the image, where f is the geometric mean of fx and fy.
    The footprint is that size in the photograph divided by that size in the rendered view.

    The footprint overstates the sharpness of a surface seen at a grazing angle, and it ignores lens
    blur, motion blur, focus and compression. It relies on rendered depth: where that is wrong in
    both views alike, the count is wrong too. A photograph that was reduced for training counts with
    its reduced pixels.

    Args:
      camera: camera of the rendered view.
      pixels: `[..., 2]` pixel centers of the rendered view.
      depth: `[...]` z-depth of these pixels; 0 is undefined and counts as unseen.
      views: training photographs.
      depths: `[V, H, W]` z-depth of the photographs; 0 is undefined.
      tolerance: relative depth tolerance.

    Returns:
      `Support` of the pixels `[...]`.
    """
    chex.assert_equal_shape_prefix([pixels, depth], depth.ndim)
    points = pixels_to_points(camera, pixels, depth)
    side = safe_divide(depth, mean_focal(camera.intrinsics))

    def add_view(
        support: Support, view: tuple[Camera, jax.Array, jax.Array]
    ) -> tuple[Support, None]:
        source, view_depth, weight = view
        _, landed_depth, weight = sample_where_visible(
            source, view_depth, weight, points, tolerance
        )
        saw = (depth > 0) & (weight > 0)
        footprint = safe_divide(landed_depth / mean_focal(source.intrinsics), side)
        finest = jnp.where(saw, jnp.minimum(support.footprint, footprint), support.footprint)
        return Support(support.count + saw.astype(jnp.int32), finest), None

    none = Support(jnp.zeros(depth.shape, jnp.int32), jnp.full(depth.shape, jnp.inf, depth.dtype))
    return jax.lax.scan(add_view, none, (views.cameras, depths, views.weight))[0]


def count_seen(
    camera: Camera,
    pixels: jax.Array,
    depth: jax.Array,
    views: Views,
    depths: jax.Array,
    *,
    tolerance: float = 0.02,
) -> jax.Array:
    """Return the `count` of `find_support` alone, `[...]` int32."""
    return find_support(camera, pixels, depth, views, depths, tolerance=tolerance).count
