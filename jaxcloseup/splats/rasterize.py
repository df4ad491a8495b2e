"""Planar homographies to images: the part of splatting that knows neither surfels nor cameras.

Every splat is three affine functions of the pixel, a reference pixel and a payload (`Footprints`).
A 3-D Gaussian's ellipse is the special case of a constant inverse depth.
"""

import dataclasses
import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import lax

from jaxcloseup.numerics import safe_divide
from jaxcloseup.splats.kernel import blend_tiles, pack
from jaxcloseup.splats.tiling import tile_lists


@dataclasses.dataclass(frozen=True)
class RasterizeConfig:
    """Static sizes of the rasterizer; none of them changes the image.

    Attributes:
      capacity: how many (tile, splat) pairs fit. What does not fit is counted in `overflow`, the
        farthest splats are left out, and the caller renders again with a larger capacity.
      near: positive z-depth in world units before which nothing is drawn.
      tile: side of a tile in pixels.
      chunk: splats of a tile that are evaluated at once.
      block: tiles that are evaluated at once.
    """

    capacity: int = 2**18
    near: float = 0.01
    tile: int = 8
    chunk: int = 8
    block: int = 128


@struct.dataclass
class Footprints:
    """What is drawn, `N` splats in any order.

    At pixel q, with d = (1, q - anchor), the local coordinates are (u, v) = (rows[0].d, rows[1].d)
    / (rows[2].d) and the z-depth is 1 / (rows[2].d). The opacity falls as exp(-rho / 2) with
    rho = min(u^2 + v^2, low_pass |q - anchor|^2).

    Attributes:
      anchor: `[N, 2]` reference pixel, the projected center wherever the low-pass can be seen.
      rows: `[N, 3, 3]` affine functions: columns multiply 1, x - anchor_x, y - anchor_y.
      opacity: `[N]` in [0, 1]; 0 is never drawn.
      low_pass: `[N]` inverse variance of the screen-space floor; very large is none. No gradient.
      inverse_depth: `[N, 2]` range to which 1/z is held where the low-pass wins. The derivative
        there is that of the depth at the anchor.
      payload: `[N, F]` what is composited: colors, normals, anything.
      order: `[N]` z-depth, positive, by which splats are sorted. No gradient.
      box: `[N, 4]` bounds (x0, y0, x1, y1) in pixels of all that is not fainter than `ALPHA_MIN`;
        empty where x1 < x0. No gradient.
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
        last one; 0 where there is none.
      distortion: `[H, W]` sum over pairs i < j of w_i w_j (1/z_i - 1/z_j)^2.
      overflow: `[]` int32, pairs that did not fit into the capacity.
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
    """SplatImage `footprints` into an image of `height` x `width` pixels.

    Differentiable in anchor, rows, opacity and payload. Deterministic; ties in `order` go to the
    lower index.
    """
    count, features = footprints.payload.shape
    chex.assert_shape(footprints.anchor, (count, 2))
    chex.assert_shape(footprints.homography, (count, 3, 3))
    chex.assert_shape([footprints.opacity, footprints.low_pass, footprints.order], (count,))
    chex.assert_shape(footprints.inverse_depth, (count, 2))
    chex.assert_shape(footprints.box, (count, 4))

    lists = tile_lists(
        lax.stop_gradient(footprints.box),
        lax.stop_gradient(footprints.order),
        height=height,
        width=width,
        tile=config.tile,
        block=config.block,
        capacity=config.capacity,
    )
    table = pack(footprints)
    sums, median = blend_tiles(config, table, lists)
    image = functools.partial(_untile, height=height, width=width, tile=config.tile)
    payload = jnp.moveaxis(jax.vmap(image, in_axes=1)(sums[:, :features]), 0, -1)
    depth, alpha, first, second = (image(sums[:, features + i]) for i in range(4))
    return SplatImage(
        payload=payload,
        alpha=alpha,
        depth=safe_divide(depth, alpha),
        median_depth=image(median),
        # The moments are about the inverse depth of the first contributor, whose weight is at least
        # ALPHA_MIN: without that shift a converged surface would lose every digit of its spread.
        distortion=jnp.maximum(alpha * second - first * first, 0),
        overflow=lists.overflow,
    )


def _untile(tiles: jax.Array, *, height: int, width: int, tile: int) -> jax.Array:
    """Pixels `[T, P]` of all tiles in row-major order to an image `[H, W]`."""
    down, across = -(-height // tile), -(-width // tile)
    image = tiles.reshape(down, across, tile, tile).swapaxes(1, 2)
    return image.reshape(down * tile, across * tile)[:height, :width]
