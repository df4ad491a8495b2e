"""How near photographs come to a view: what both show, how far away, and from which direction."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points
from jaxcloseup.geometry.numerics import safe_divide, safe_norm
from jaxcloseup.geometry.visibility import sample_where_visible
from jaxcloseup.photos.views import Views


class Proximity(NamedTuple):
    """How near each of `V` photographs comes to a view.

    Attributes:
      seen: `[V]` share of the view's surface that the photograph saw, in the view's pixels.
      overlap: `[V]` intersection over union of what the two images show.
      depth_ratio: `[V]` median of z-depth in the photograph over z-depth in the view, over the
        pixels that it saw; NaN without any.
      angle: `[V]` median angle between the two rays to these points, in radians; NaN likewise.
    """

    seen: jax.Array
    overlap: jax.Array
    depth_ratio: jax.Array
    angle: jax.Array


def measure_proximity(
    camera: Camera,
    depth: jax.Array,
    views: Views,
    depths: jax.Array,
    *,
    tolerance: float = 0.02,
    samples: int = 2048,
) -> Proximity:
    """Measure how near photographs come to a view.

    A photograph saw a point as in `find_support`. With the share a of the view's pixels that the
    photograph saw, and the share b of the photograph's pixels that the view sees, both images cover
    the same surface a |view| = b |photograph|, so that intersection over union is
    1 / (1/a + 1/b - 1): 1 of equal images, and 1/16 where the view is four times nearer.

    Args:
      camera: camera of the view.
      depth: `[H, W]` z-depth of the view; pixels of 0 are undefined and count as no surface.
      views: training photographs.
      depths: `[V, H, W]` z-depth of the photographs; 0 is undefined.
      tolerance: relative depth tolerance.
      samples: static; about how many pixels of each image are looked at, on a grid.
    """
    chex.assert_shape(depth, (camera.height, camera.width))
    chex.assert_equal_shape([depths, views.weight])
    ones = jnp.ones_like(depth)
    points, reached = _sample(camera, depth, ones, samples)
    to_view = points - camera.position[None, None]

    def measure(photograph: tuple[Camera, jax.Array, jax.Array]) -> Proximity:
        source, source_depth, weight = photograph
        visible = sample_where_visible(source, source_depth, weight, points, tolerance)
        saw = (reached > 0) & (visible.weight > 0)
        back, counted = _sample(source, source_depth, weight, samples)
        sees = sample_where_visible(camera, depth, ones, back, tolerance).weight > 0
        of_view = safe_divide(jnp.sum(saw), jnp.sum(reached > 0))
        of_source = safe_divide(jnp.sum(sees & (counted > 0)), jnp.sum(counted > 0))
        both = of_view * of_source
        to_source = points - source.position[None, None]
        cosine = safe_divide(
            jnp.sum(to_view * to_source, axis=-1), safe_norm(to_view) * safe_norm(to_source)
        )
        return Proximity(
            seen=of_view,
            overlap=safe_divide(both, of_view + of_source - both),
            depth_ratio=_median(safe_divide(visible.depth, reached), saw),
            angle=_median(jnp.arccos(jnp.clip(cosine, -1, 1)), saw),
        )

    return jax.lax.map(measure, (views.cameras, depths, views.weight))


def _sample(
    camera: Camera, depth: jax.Array, weight: jax.Array, samples: int
) -> tuple[jax.Array, jax.Array]:
    """Return points `[h, w, 3]` of an image on a grid, and their z-depths, 0 where none counts."""
    every = max(1, round((depth.size / samples) ** 0.5))
    # Grids begin half a gap inside, so that no border counts more than the one across.
    chosen = (slice(every // 2, None, every),) * 2
    pixels = pixel_grid(camera.height, camera.width)[chosen].astype(depth.dtype)
    counted = jnp.where(weight[chosen] > 0, depth[chosen], 0)
    return pixels_to_points(camera, pixels, counted), counted


def _median(values: jax.Array, counted: jax.Array) -> jax.Array:
    return jnp.nanmedian(jnp.where(counted, values, jnp.nan))
