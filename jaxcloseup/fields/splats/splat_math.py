"""What one splat does to a pixel, and its derivative: the arithmetic of every compositor.

Functions take a `column`: the value of a column of the splat's table row, in whatever shape
broadcasts against the pixels. `loops` has chunks of splats in it, `gpu_kernel` one splat.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxcloseup.geometry.numerics import safe_divide


ALPHA_MIN = 1 / 255  # the kernel skips fainter contributions
ALPHA_MAX = 0.99  # keeps a gradient for splats behind an opaque one
TRANSMITTANCE_MIN = 1e-4  # a pixel is finished before its transmittance falls below this

# First columns of the packed table; the payload comes last.
ANCHOR, HOMOGRAPHY, OPACITY, LOW_PASS, RANGE, PAYLOAD = 0, 2, 11, 12, 13, 15

Column = Callable[[int], jax.Array]


def pack(footprints) -> jax.Array:
    """Pack `Footprints` into one table `[N, C]`, whose rows compositors read."""
    columns = [
        footprints.anchor,
        footprints.homography.reshape(9, -1),
        footprints.opacity[None],
        lax.stop_gradient(footprints.low_pass)[None],
        lax.stop_gradient(footprints.inverse_depth),
        footprints.payload,
    ]
    return jnp.concatenate(columns).T


class Trace(NamedTuple):
    """What the forward pass keeps for the derivative, per pixel of all tiles `[T, P]`."""

    transmittance: jax.Array  # behind the last drawn splat
    stop: jax.Array  # position in the list at which the pixel was finished
    reference: jax.Array  # inverse depth of the first drawn splat


class Shade(NamedTuple):
    """Splats at pixels."""

    alpha: jax.Array  # 0 where not drawn
    inverse_depth: jax.Array
    z: jax.Array
    u_numerator: jax.Array
    v_numerator: jax.Array
    rho: jax.Array
    on_plane: jax.Array  # bool: the disc, not the low-pass, gives rho
    clipped: jax.Array  # bool: the low-pass gives rho and the depth is clipped to the disc's range


def shade(column: Column, x: jax.Array, y: jax.Array, near: float) -> Shade:
    """Evaluate splats, whose anchors are local to the tile, at pixels x, y of the tile."""
    dx, dy = x - column(ANCHOR), y - column(ANCHOR + 1)
    u, v, w = (
        column(i) + column(i + 1) * dx + column(i + 2) * dy
        for i in (HOMOGRAPHY, HOMOGRAPHY + 3, HOMOGRAPHY + 6)
    )
    squared = u * u + v * v
    low_pass = column(LOW_PASS) * (dx * dx + dy * dy)
    # Compare rho without dividing; where w <= 0 the ray misses the plane and the low-pass counts.
    on_plane = (w > 0) & (squared <= low_pass * (w * w))
    low, high = column(RANGE), column(RANGE + 1)
    inverse = jnp.where(on_plane, w, jnp.clip(w, low, high))
    z = 1 / inverse
    rho = jnp.where(on_plane, squared * (z * z), low_pass)
    alpha = jnp.minimum(column(OPACITY) * jnp.exp(-0.5 * rho), ALPHA_MAX)
    alpha = jnp.where((alpha >= ALPHA_MIN) & (w * near <= 1), alpha, 0)
    return Shade(alpha, inverse, z, u, v, rho, on_plane, ~on_plane & ((w < low) | (w > high)))


class Walk(NamedTuple):
    """Where pixels are on their way through a list, front to back.

    Attributes:
      remaining: transmittance behind the last drawn splat.
      stop: position behind it.
      reference: inverse depth of the first drawn splat.
      median: median depth so far.
    """

    remaining: jax.Array
    stop: jax.Array
    reference: jax.Array
    median: jax.Array


def pass_splat(
    walk: Walk,
    alpha: jax.Array,
    inverse_depth: jax.Array,
    z: jax.Array,
    before: jax.Array,
    after: jax.Array,
    position: jax.Array | int,
) -> tuple[jax.Array, Walk]:
    """The weight of the splat at `position`, with the transmittance before and after it."""
    open_ = after >= TRANSMITTANCE_MIN
    drawn = alpha > 0
    return jnp.where(open_, alpha * before, 0), Walk(
        remaining=jnp.where(open_, after, walk.remaining),
        stop=jnp.where(open_, position + 1, walk.stop),
        reference=jnp.where(drawn & (before == 1), inverse_depth, walk.reference),
        median=jnp.where(drawn & (before > 0.5), z, walk.median),
    )


def channels(column: Column, features: int, seen: Shade, reference: jax.Array) -> list[jax.Array]:
    """What the weights of splats multiply: payload, z, 1, and the shifted inverse depth's powers.

    Splats in front of the first drawn one have weight 0, so one reference serves all.
    """
    shifted = seen.inverse_depth - reference
    payload = [column(PAYLOAD + f) for f in range(features)]
    return [*payload, seen.z, jnp.ones_like(seen.z), shifted, shifted * shifted]


def worth(
    column: Column, seen: Shade, reference: jax.Array, sums_bar: Sequence[jax.Array]
) -> jax.Array:
    """Derivative of the loss with respect to splats' weights, by the sums' cotangents."""
    *payload_bar, z_bar, alpha_bar, first_bar, second_bar = sums_bar
    shifted = seen.inverse_depth - reference
    total = sum(column(PAYLOAD + f) * bar for f, bar in enumerate(payload_bar))
    total = total + alpha_bar + seen.z * z_bar
    return total + shifted * (first_bar + shifted * second_bar)


class Pulled(NamedTuple):
    """Cotangents of what splats are at pixels; `u`, `v`, `w` are those of the homography's rows."""

    u: jax.Array
    v: jax.Array
    w: jax.Array
    low_pass: jax.Array  # of -rho / 2 where the low-pass gives it
    clip: jax.Array  # of the depth at the anchor, where the depth is clipped
    scaled: jax.Array  # of log(alpha)


def pull_back(
    seen: Shade,
    alpha: jax.Array,
    before: jax.Array,
    after: jax.Array,
    behind: jax.Array,
    value: jax.Array,
    trace: Trace,
    bars: tuple[jax.Array, ...],
) -> tuple[jax.Array, Pulled]:
    """The weights of splats, and their cotangents.

    Args:
      seen: from `shade`.
      alpha: that of `seen`, but 0 where the pixel was finished.
      before: transmittance in front of each splat.
      after: transmittance behind it.
      behind: sum of weight times worth of all splats behind it.
      value: from `worth`.
      trace: of these pixels.
      bars: cotangents of the sums of z and of the shifted inverse depth's powers, and the median's.
    """
    z_bar, first_bar, second_bar, median_bar = bars
    shifted = seen.inverse_depth - trace.reference
    weight = alpha * before
    # The median splat takes transmittance to 1/2, else it is the last drawn one.
    last = (after <= 0.5) | (after == trace.transmittance)
    median = (alpha > 0) & (before > 0.5) & last
    depth_bar = weight * z_bar + jnp.where(median, median_bar, 0)
    inverse_bar = weight * (first_bar + 2 * shifted * second_bar)
    inverse_bar = inverse_bar - seen.z * seen.z * depth_bar
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


def row_bar(column: Column, middle: float, sums: Pulled, payload: Sequence[Any]) -> list[jax.Array]:
    """Cotangents of the columns of table rows, from sums over a tile's pixels.

    Args:
      column: of the rows.
      middle: x and y about which moments are taken.
      sums: of u, v, w and low_pass, triples of moments: sums of 1, x and y about the middle.
      payload: cotangents of the payload.
    """
    ax, ay = column(ANCHOR) - middle, column(ANCHOR + 1) - middle
    about_anchor = lambda m: (m[0], m[1] - ax * m[0], m[2] - ay * m[0])  # noqa: E731
    u, v, w, low_pass = map(about_anchor, (sums.u, sums.v, sums.w, sums.low_pass))
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
