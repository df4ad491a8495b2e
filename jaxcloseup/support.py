"""Support: what the training photographs saw of each rendered pixel, and how sharply."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, pixels_to_points
from jaxcloseup.geometry.visibility import sample_where_visible
from jaxcloseup.numerics import safe_divide
from jaxcloseup.photographs import Views


class Support(NamedTuple):
    """What photographs saw behind pixels.

    Attributes:
      count: `[...]` int32 training photographs that saw the surface there.
      footprint: `[...]` side of the smallest of their pixels there, in pixels of the rendered view:
        1 is as sharp as the render, 4 is four times coarser; infinity where none saw it.
    """

    count: jax.Array
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
    """How many training photographs saw the surface behind each pixel, and the finest at what size.

    A view saw a point that lands on a pixel of its photograph, of weight above 0, at a depth
    confirmed by its own depth map to a relative `tolerance`. At z-depth z a pixel covers z / f of a
    surface that is parallel to the image, f the geometric mean of fx and fy; the footprint is the
    ratio of that in the photograph to that in the rendered view.

    Not covered: a surface seen at a grazing angle is less sharp than the footprint says; nor are
    lens blur, motion blur, focus and compression, of which the arrays say nothing. All rests on
    rendered depth: where it is wrong in both views alike, so is what is counted. A photograph that
    was reduced for training counts with its reduced pixels.

    Args:
      camera: of the rendered view.
      pixels: `[..., 2]` pixel centers of it.
      depth: `[...]` their z-depth; 0 is undefined, and then nobody saw it.
      views: the training photographs.
      depths: `[V, H, W]` their z-depth; 0 is undefined.
      tolerance: relative.
    """
    chex.assert_equal_shape_prefix([pixels, depth], depth.ndim)
    points = pixels_to_points(camera, pixels, depth)
    own_side = safe_divide(depth, _focal(camera))

    def add_view(found, view):
        source, view_depth, weight = view
        _, landed_depth, weight = sample_where_visible(
            source, view_depth, weight, points, tolerance
        )
        saw = (depth > 0) & (weight > 0)
        footprint = safe_divide(landed_depth / _focal(source), own_side)
        finest = jnp.where(saw, jnp.minimum(found.footprint, footprint), found.footprint)
        return Support(found.count + saw.astype(jnp.int32), finest), None

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
    """The `count` of `find_support` alone, `[...]` int32."""
    return find_support(camera, pixels, depth, views, depths, tolerance=tolerance).count


def _focal(camera):
    """Geometric mean of fx and fy, `[]` pixels."""
    return jnp.sqrt(camera.intrinsics[0] * camera.intrinsics[1])
