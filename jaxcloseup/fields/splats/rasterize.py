"""Splats to images: the part of splatting that knows neither surfels nor cameras.

A splat is a planar homography, a reference pixel and a payload, see `Footprints`. The ellipse of a
3-D Gaussian is the special case of a constant inverse depth.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxcloseup.fields.splats import blend_native
from jaxcloseup.fields.splats.blending import blend_tiles
from jaxcloseup.fields.splats.config import RasterizeConfig
from jaxcloseup.fields.splats.layout import MOMENTS
from jaxcloseup.fields.splats.raster_plan import plan_raster
from jaxcloseup.fields.splats.tile_test import reaches
from jaxcloseup.fields.splats.tiling import tile_lists
from jaxcloseup.geometry.numerics import safe_divide


class SplatImage(NamedTuple):
    """An image of footprints, before any background.

    Attributes:
      payload: `[H, W, F]` sum of w_i payload_i.
      alpha: `[H, W]` sum of w_i.
      depth: `[H, W]` expected z-depth, sum of w_i z_i / alpha; 0 where alpha is 0.
      median_depth: `[H, W]` z-depth of the splat that takes the transmittance to 1/2, else of the
        last drawn splat; 0 where no splat is drawn.
      distortion: `[H, W]` sum over pairs i < j of w_i w_j (1/z_i - 1/z_j)^2.
      overflow: `[]` int32 number of (tile, splat) pairs that did not fit into the capacity.
    """

    payload: jax.Array
    alpha: jax.Array
    depth: jax.Array
    median_depth: jax.Array
    distortion: jax.Array
    overflow: jax.Array


def blend(
    table: jax.Array,
    box: jax.Array,
    order: jax.Array,
    config: RasterizeConfig,
    *,
    height: int,
    width: int,
) -> SplatImage:
    """Blend splats front to back into an image of `height` x `width` pixels.

    Differentiable in the table. Deterministic; of two splats with the same order, the one with the
    lower index is in front.

    Args:
      table: `[N, C]` from `pack`.
      box: `[N, 4]` `Footprints.box`, transposed.
      order: `[N]` `Footprints.order`.
      config: static.
      height: in pixels; static.
      width: in pixels; static.
    """
    plan = plan_raster(config, height=height, width=width)
    # Which splats a tile lists has no derivative: outside of their lists they draw nothing.
    shape = lax.stop_gradient(box), lax.stop_gradient(order)
    if plan.compositor == "native":
        if blend_native.can_blend(table):
            sums, median = blend_native.blend_image(plan, height, width, table, *shape)
            return image_of(sums, median, jnp.zeros((), jnp.int32))
        plan = dataclasses.replace(plan, compositor="loops")
    lists = tile_lists(
        *shape,
        height=height,
        width=width,
        tile=plan.tile,
        capacity=plan.capacity,
        at_once=plan.pairs_at_once,
        reaches=functools.partial(
            reaches, lax.stop_gradient(table), tile=plan.tile, near=plan.near
        ),
    )
    sums, median = blend_tiles(plan, table, lists)
    untile = functools.partial(_untile, height=height, width=width, tile=plan.tile)
    return image_of(jax.vmap(untile, in_axes=1)(sums), untile(median), lists.overflow)


def image_of(sums: jax.Array, median: jax.Array, overflow: jax.Array) -> SplatImage:
    """Return the image of sums `[F + MOMENTS, H, W]` over splats, see `blend_tiles`."""
    depth, alpha, first, second = sums[-MOMENTS:]
    return SplatImage(
        payload=jnp.moveaxis(sums[:-MOMENTS], 0, -1),
        alpha=alpha,
        depth=safe_divide(depth, alpha),
        median_depth=median,
        # sum_{i<j} w_i w_j (m_i - m_j)^2 (2DGS, equation 13), by moments about the inverse depth of
        # the first drawn splat, whose weight is at least ALPHA_MIN. Without that shift float32
        # would lose every digit of the spread of a converged surface.
        distortion=jnp.maximum(alpha * second - first * first, 0),
        overflow=overflow,
    )


def _untile(tiles: jax.Array, *, height: int, width: int, tile: int) -> jax.Array:
    """Return the pixels `[T, P]` of tiles in row-major order, arranged as an image `[H, W]`."""
    down, across = -(-height // tile), -(-width // tile)
    image = tiles.reshape(down, across, tile, tile).swapaxes(1, 2)
    return image.reshape(down * tile, across * tile)[:height, :width]
