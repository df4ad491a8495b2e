"""Layouts of the arrays that all compositors share.

Splats come as rows of one table, so that a gather reads all of a splat at once; pixels leave as
rows of one array, so that a scatter writes all of a tile at once.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax


# First columns of the table `[N, PAYLOAD + F]`; see `Footprints` for what they mean.
ANCHOR = 0  # x, y
HOMOGRAPHY = 2  # 3 x 3, row by row
OPACITY = 11
LOW_PASS = 12
INVERSE_DEPTH = 13  # lower limit, upper limit
PAYLOAD = 15  # F columns

MOMENTS = 4  # channels that follow the payload, see `Channels`

Column = Callable[[int], jax.Array]


class Footprints(struct.PyTreeNode):
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
      inverse_depth: `[2, N]` lower and upper limit of 1/z where the low-pass determines rho. At a
        limit, the derivative is that of the depth at the anchor.
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


def pack(footprints: Footprints) -> jax.Array:
    """Pack footprints into one table `[N, PAYLOAD + F]`, whose rows compositors read."""
    columns = [
        footprints.anchor,
        footprints.homography.reshape(9, -1),
        footprints.opacity[None],
        lax.stop_gradient(footprints.low_pass)[None],
        lax.stop_gradient(footprints.inverse_depth),
        footprints.payload,
    ]
    return jnp.concatenate(columns).T


class Channels(struct.PyTreeNode):
    """Values that splat weights multiply, their sums over a pixel, or the cotangents of these.

    The fields come in the order of the channels of every array of sums `[..., F + MOMENTS, P]`.
    """

    payload: tuple[jax.Array, ...]  # F arrays, such as colors and normals
    depth: jax.Array  # z-depth
    alpha: jax.Array  # 1, so that its sum is the accumulated opacity
    first: jax.Array  # 1 / z minus that of the pixel's first drawn splat
    second: jax.Array  # the square of `first`

    @classmethod
    def of(cls, channels: Sequence[jax.Array]) -> "Channels":
        """Name the `F + MOMENTS` channels of an array."""
        *payload, depth, alpha, first, second = channels
        return cls(tuple(payload), depth, alpha, first, second)

    def listed(self) -> list[jax.Array]:
        """Return all channels in order."""
        return [*self.payload, self.depth, self.alpha, self.first, self.second]


class PixelRows(NamedTuple):
    """Row numbers of the array `[T, F + MOMENTS + 4, P]` that stores the pixels of tiles."""

    sums: slice  # rows of `Channels`
    median: int  # row of the median depth
    transmittance: int  # row of `Trace.transmittance`
    stop: int  # row of `Trace.stop`, which a float holds exactly
    reference: int  # row of `Trace.reference`
    total: int  # number of rows


def pixel_rows(features: int) -> PixelRows:
    """Return the layout of pixels for payloads of `features` values."""
    sums = features + MOMENTS
    return PixelRows(slice(sums), sums, sums + 1, sums + 2, sums + 3, total=sums + 4)


class Trace(struct.PyTreeNode):
    """Residuals of the forward pass for the derivative, per pixel of all tiles `[T, P]`."""

    transmittance: jax.Array  # transmittance behind the last drawn splat
    stop: jax.Array  # int32 position in the list at which the pixel was finished
    reference: jax.Array  # inverse depth of the first drawn splat
