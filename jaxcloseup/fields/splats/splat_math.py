"""What one splat does to a pixel, and its derivative: the arithmetic of every compositor.

Functions take a `column`: the value of a column of the splat's table row (see `layout`), in
whatever shape broadcasts against the pixels. `blend_lax` has chunks of splats in it, `blend_pallas`
one splat.

The derivative must test the same thresholds on the same bits as the forward pass, so both call
`shade`. Names in formulas are those of 2D Gaussian splatting (Huang et al. 2024), written in terms
of 1 / z, which is affine in the pixel.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.fields.splats.layout import (
    ANCHOR,
    HOMOGRAPHY,
    INVERSE_DEPTH,
    LOW_PASS,
    OPACITY,
    PAYLOAD,
    Channels,
    Column,
    Trace,
)
from jaxcloseup.geometry.numerics import safe_divide


# As published for 3-D Gaussian splatting (Kerbl et al. 2023), appendix C.
ALPHA_MIN = 1 / 255  # fainter contributions are skipped
ALPHA_MAX = 0.99  # keeps a gradient for splats behind an opaque one
TRANSMITTANCE_MIN = 1e-4  # a pixel is finished before its transmittance falls below this


class Shade(struct.PyTreeNode):
    """Splats at pixels."""

    alpha: jax.Array  # opacity, 0 where not drawn
    inverse_depth: jax.Array  # 1 / z, clipped to the disc's range where the low-pass determines rho
    z: jax.Array  # z-depth, the inverse of `inverse_depth`
    u_numerator: jax.Array  # u / z
    v_numerator: jax.Array  # v / z
    rho: jax.Array  # squared distance from the center in standard deviations
    on_plane: jax.Array  # bool, True where the disc, not the low-pass, determines rho
    clipped: jax.Array  # bool, True where `inverse_depth` is a limit of the disc's range


def shade(column: Column, x: jax.Array, y: jax.Array, near: float) -> Shade:
    """Evaluate splats, whose anchors are local to the tile, at pixels x, y of the tile."""
    dx, dy = x - column(ANCHOR), y - column(ANCHOR + 1)
    u, v, w = (
        column(i) + column(i + 1) * dx + column(i + 2) * dy
        for i in (HOMOGRAPHY, HOMOGRAPHY + 3, HOMOGRAPHY + 6)
    )
    squared = u * u + v * v
    # The object-space low-pass of 2DGS (equation 11): no splat is narrower than a pixel.
    low_pass = column(LOW_PASS) * (dx * dx + dy * dy)
    # Compare rho without dividing; where w <= 0 the ray misses the plane and the low-pass counts.
    on_plane = (w > 0) & (squared <= low_pass * (w * w))
    low, high = column(INVERSE_DEPTH), column(INVERSE_DEPTH + 1)
    # Beside a nearly edge-on disc, the plane's own depth has no bound.
    inverse = jnp.where(on_plane, w, jnp.clip(w, low, high))
    z = 1 / inverse
    rho = jnp.where(on_plane, squared * (z * z), low_pass)
    alpha = jnp.minimum(column(OPACITY) * jnp.exp(-0.5 * rho), ALPHA_MAX)
    # The near plane cuts each intersection, not each splat; w <= 0 passes, for the low-pass.
    alpha = jnp.where((alpha >= ALPHA_MIN) & (w * near <= 1), alpha, 0)
    clipped = ~on_plane & ((w < low) | (w > high))
    return Shade(alpha, inverse, z, u, v, rho, on_plane, clipped)


class Walk(struct.PyTreeNode):
    """State of pixels after part of a list of splats, front to back."""

    remaining: jax.Array  # transmittance behind the last drawn splat
    stop: jax.Array  # list position behind the last drawn splat
    reference: jax.Array  # inverse depth of the first drawn splat
    median: jax.Array  # median depth so far


def pass_splat(
    walk: Walk,
    alpha: jax.Array,
    inverse_depth: jax.Array,
    z: jax.Array,
    before: jax.Array,
    after: jax.Array,
    position: jax.Array | int,
) -> tuple[jax.Array, Walk]:
    """Return the weight of the splat at `position`, and the walk behind it.

    Args:
      walk: in front of the splat.
      alpha: from `shade`.
      inverse_depth: from `shade`.
      z: from `shade`.
      before: product of 1 - alpha of all splats in front, which keeps falling when the pixel is
        finished, unlike `walk.remaining`.
      after: the same behind the splat.
      position: in the tile's list.
    """
    # The splat that would take the transmittance below the limit is not drawn itself.
    unfinished = after >= TRANSMITTANCE_MIN
    drawn = alpha > 0
    return jnp.where(unfinished, alpha * before, 0), Walk(
        remaining=jnp.where(unfinished, after, walk.remaining),
        stop=jnp.where(unfinished, position + 1, walk.stop),
        # Only in front of the first drawn splat is the product exactly 1.
        reference=jnp.where(drawn & (before == 1), inverse_depth, walk.reference),
        median=jnp.where(drawn & (before > 0.5), z, walk.median),
    )


def channels(column: Column, features: int, seen: Shade, reference: jax.Array) -> Channels:
    """Return what the weights of splats multiply.

    Splats in front of the first drawn one have weight 0, so one reference serves all.
    """
    shifted = seen.inverse_depth - reference
    return Channels(
        payload=tuple(column(PAYLOAD + f) for f in range(features)),
        depth=seen.z,
        alpha=jnp.ones_like(seen.z),
        first=shifted,
        second=shifted * shifted,
    )


def worth(column: Column, seen: Shade, reference: jax.Array, sums_bar: Channels) -> jax.Array:
    """Return the derivative of the loss with respect to splats' weights.

    Args:
      column: of the splats.
      seen: from `shade`.
      reference: of the pixels' trace.
      sums_bar: cotangents of the sums.
    """
    shifted = seen.inverse_depth - reference
    total = sum(column(PAYLOAD + f) * bar for f, bar in enumerate(sums_bar.payload))
    total = total + sums_bar.alpha + seen.z * sums_bar.depth
    return total + shifted * (sums_bar.first + shifted * sums_bar.second)


class Pulled(struct.PyTreeNode):
    """Cotangents of splats at pixels."""

    u: jax.Array  # cotangent of the homography's first row, the numerator of u
    v: jax.Array  # cotangent of its second row, the numerator of v
    w: jax.Array  # cotangent of its third row, 1 / z
    low_pass: jax.Array  # cotangent of -rho / 2 where the low-pass determines rho
    clip: jax.Array  # cotangent of the depth at the anchor, where the depth is clipped
    scaled: jax.Array  # cotangent of log(alpha)


# Sums over pixels of values times 1, x and y: three arrays, or one of them stacked.
Moments = Sequence[jax.Array] | jax.Array


class PulledSums(struct.PyTreeNode):
    """Sums of `Pulled` over the pixels of a tile.

    The homography and the low-pass are affine in the pixel, or a circle about the anchor, so
    moments are all that their parameters' cotangents need.
    """

    u: Moments
    v: Moments
    w: Moments
    low_pass: Moments
    clip: jax.Array
    scaled: jax.Array


def pull_back(
    seen: Shade,
    alpha: jax.Array,
    before: jax.Array,
    after: jax.Array,
    behind: jax.Array,
    value: jax.Array,
    trace: Trace,
    sums_bar: Channels,
    median_bar: jax.Array,
) -> tuple[jax.Array, Pulled]:
    """Return the weights of splats, and their cotangents.

    Args:
      seen: from `shade`.
      alpha: that of `seen`, but 0 where the pixel was finished.
      before: transmittance in front of each splat.
      after: transmittance behind it.
      behind: sum of weight times worth of all splats behind it.
      value: from `worth`.
      trace: of these pixels.
      sums_bar: cotangents of the sums.
      median_bar: cotangent of the median depth.
    """
    shifted = seen.inverse_depth - trace.reference
    weight = alpha * before
    # The median splat takes transmittance to 1/2, else it is the last drawn one.
    last = (after <= 0.5) | (after == trace.transmittance)
    median = (alpha > 0) & (before > 0.5) & last
    depth_bar = weight * sums_bar.depth + jnp.where(median, median_bar, 0)
    inverse_bar = weight * (sums_bar.first + 2 * shifted * sums_bar.second)
    inverse_bar = inverse_bar - seen.z * seen.z * depth_bar  # dz = -z^2 d(1 / z)
    # A splat adds its own worth and dims all splats behind it by 1 / (1 - alpha). `behind` is a sum
    # from the back: a total minus a prefix would cancel where many faint splats lie in a row.
    scaled = alpha * (before * value - behind * (1 / (1 - alpha)))
    scaled = jnp.where(alpha < ALPHA_MAX, scaled, 0)
    plane = jnp.where(seen.on_plane, scaled * seen.z, 0)
    return weight, Pulled(
        u=-plane * seen.z * seen.u_numerator,
        v=-plane * seen.z * seen.v_numerator,
        w=jnp.where(seen.clipped, 0, inverse_bar) + plane * seen.rho,
        low_pass=jnp.where(seen.on_plane, 0, scaled),
        clip=jnp.where(seen.clipped, inverse_bar * seen.inverse_depth**2, 0),
        scaled=scaled,
    )


def sum_pixels(
    pulled: Pulled, moments: Callable[[jax.Array], Moments], total: Callable[[jax.Array], jax.Array]
) -> PulledSums:
    """Sum cotangents over the pixels of a tile, by functions for moments and for plain sums."""
    return PulledSums(
        u=moments(pulled.u),
        v=moments(pulled.v),
        w=moments(pulled.w),
        low_pass=moments(pulled.low_pass),
        clip=total(pulled.clip),
        scaled=total(pulled.scaled),
    )


def row_bar(
    column: Column, middle: float, sums: PulledSums, payload: Sequence[jax.Array]
) -> list[jax.Array]:
    """Return the cotangents of the columns of table rows, from sums over a tile's pixels.

    Args:
      column: of the rows.
      middle: x and y about which moments are taken.
      sums: from `sum_pixels`.
      payload: cotangents of the payload.
    """
    ax, ay = column(ANCHOR) - middle, column(ANCHOR + 1) - middle

    def about_anchor(m: Moments) -> tuple[jax.Array, jax.Array, jax.Array]:
        return m[0], m[1] - ax * m[0], m[2] - ay * m[0]

    u, v, w, low_pass = map(about_anchor, (sums.u, sums.v, sums.w, sums.low_pass))
    # The numerators depend on the pixel minus the anchor: the anchor's cotangent is minus the
    # homography's slopes times theirs. The low-pass circle moves with the anchor too.
    anchor_bar = [
        column(LOW_PASS) * low_pass[1 + axis]
        - sum(bar[0] * column(HOMOGRAPHY + 3 * i + 1 + axis) for i, bar in enumerate((u, v, w)))
        for axis in range(2)
    ]
    # A clipped depth moves with the anchor's depth, 1 / homography[2, 0].
    constant_bar = w[0] + safe_divide(sums.clip, column(HOMOGRAPHY + 6) ** 2)
    opacity_bar = safe_divide(sums.scaled, column(OPACITY))
    constants = [jnp.zeros_like(ax)] * (PAYLOAD - LOW_PASS)
    return [*anchor_bar, *u, *v, constant_bar, *w[1:], opacity_bar, *constants, *payload]
