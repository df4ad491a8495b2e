"""Splats to images: the part of splatting that knows neither surfels nor cameras.

A splat is a planar homography, a reference pixel and a payload, see `Footprints`. The ellipse of a
3-D Gaussian is the special case of a constant inverse depth.
"""

import dataclasses
import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import lax

from jaxcloseup.fields.splats.blending import blend_tiles
from jaxcloseup.fields.splats.config import RasterizeConfig
from jaxcloseup.fields.splats.splat_math import pack
from jaxcloseup.fields.splats.tile_test import reaches
from jaxcloseup.fields.splats.tiling import tile_lists
from jaxcloseup.geometry.numerics import safe_divide


_SMALL = 2**17  # pixels of an image that is best cut into small tiles


def for_image(config: RasterizeConfig, *, height: int, width: int) -> RasterizeConfig:
    """The settings with the sizes that are fastest for an image, where they leave them open.

    Small tiles evaluate fewer splats in vain, but more pairs have to be sorted; docs/speed.md
    has the times on a CPU. Small tiles that are chosen here get three times the `capacity`, since
    splats touch two to three times as many. A GPU evaluates thousands of tiles at once: its sizes
    are a guess.
    """
    on_cpu = jax.default_backend() == "cpu"
    tile, capacity = config.tile, config.capacity
    if tile is None:
        small = on_cpu and height * width <= _SMALL
        tile, capacity = (4, 3 * capacity) if small else (8, capacity)
    return dataclasses.replace(
        config,
        capacity=capacity,
        tile=tile,
        chunk=config.chunk or 8,
        block=config.block or (256 if on_cpu else 4096),
    )


@struct.dataclass
class Footprints:
    """`N` splats in any order, ready to be drawn. Splats are the last axis.

    At pixel q, with d = (1, q - anchor) and the homography H, the local coordinates are
    (u, v) = (H[0].d, H[1].d) / (H[2].d) and the z-depth is 1 / (H[2].d). The opacity falls as
    exp(-rho / 2) with rho = min(u^2 + v^2, low_pass |q - anchor|^2).

    Attributes:
      anchor: `[2, N]` reference pixel: the projected center; of a center far outside the image, the
        nearest pixel of a larger rectangle; any pixel if the splat reaches the near plane and has
        no low-pass.
      homography: `[3, 3, N]` map from pixels to (u, v, 1) / z; its columns multiply 1, x - anchor_x
        and y - anchor_y.
      opacity: `[N]` in [0, 1]; splats of opacity 0 are not drawn.
      low_pass: `[N]` inverse variance, in 1/px^2, of the smallest screen-space Gaussian; a very
        large value has no effect. No gradient.
      inverse_depth: `[2, N]` lower and upper limit of 1/z where the low-pass gives rho. At a limit,
        the derivative is that of the depth at the anchor.
      payload: `[F, N]` values to blend, such as colors and normals.
      order: `[N]` positive z-depth by which splats are sorted. No gradient.
      box: `[4, N]` bounds x0, y0, x1, y1 in pixels outside which the splat is fainter than
        `ALPHA_MIN`; empty where x1 < x0. No gradient.
    """

    anchor: jax.Array
    homography: jax.Array
    opacity: jax.Array
    low_pass: jax.Array
    inverse_depth: jax.Array
    payload: jax.Array
    order: jax.Array
    box: jax.Array


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


def rasterize(
    footprints: Footprints, config: RasterizeConfig, *, height: int, width: int
) -> SplatImage:
    """Blend splats front to back into an image of `height` x `width` pixels.

    Differentiable in anchor, homography, opacity and payload. Deterministic; of two splats with the
    same `order`, the one with the lower index is in front.
    """
    count = footprints.opacity.shape[0]
    chex.assert_shape(footprints.payload, (None, count))
    chex.assert_shape(footprints.anchor, (2, count))
    chex.assert_shape(footprints.homography, (3, 3, count))
    chex.assert_shape([footprints.opacity, footprints.low_pass, footprints.order], (count,))
    chex.assert_shape(footprints.inverse_depth, (2, count))
    table, box, order = pack(footprints), footprints.box.T, footprints.order
    return blend(table, box, order, config, height=height, width=width)


def blend(
    table: jax.Array,
    box: jax.Array,
    order: jax.Array,
    config: RasterizeConfig,
    *,
    height: int,
    width: int,
) -> SplatImage:
    """`rasterize` of splats whose footprints are a table `[N, C]` from `pack`, boxes and order."""
    config = for_image(config, height=height, width=width)
    kept = lax.stop_gradient(table)
    lists = tile_lists(
        lax.stop_gradient(box),
        lax.stop_gradient(order),
        height=height,
        width=width,
        tile=config.tile,
        capacity=config.capacity,
        reaches=functools.partial(reaches, kept, tile=config.tile, near=config.near),
    )
    sums, median = blend_tiles(config, table, lists)
    image = functools.partial(_untile, height=height, width=width, tile=config.tile)
    features = sums.shape[1] - 4
    payload = jnp.moveaxis(jax.vmap(image, in_axes=1)(sums[:, :features]), 0, -1)
    depth, alpha, first, second = (image(sums[:, features + i]) for i in range(4))
    return SplatImage(
        payload=payload,
        alpha=alpha,
        depth=safe_divide(depth, alpha),
        median_depth=image(median),
        # The moments are about the inverse depth of the first drawn splat, whose weight is at least
        # ALPHA_MIN. Without that shift a converged surface would lose every digit of its spread.
        distortion=jnp.maximum(alpha * second - first * first, 0),
        overflow=lists.overflow,
    )


def _untile(tiles: jax.Array, *, height: int, width: int, tile: int) -> jax.Array:
    """Arrange the pixels `[T, P]` of tiles in row-major order as an image `[H, W]`."""
    down, across = -(-height // tile), -(-width // tile)
    image = tiles.reshape(down, across, tile, tile).swapaxes(1, 2)
    return image.reshape(down * tile, across * tile)[:height, :width]
