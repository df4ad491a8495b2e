"""Whether a splat draws anything in a tile: fewer pairs than those of its bounding box.

The exact test of tiles against ellipses of Speedy-Splat (Hanson et al. 2025), for discs seen in
perspective.
"""

import jax
import jax.numpy as jnp

from jaxcloseup.fields.splats.layout import (
    ANCHOR,
    HOMOGRAPHY,
    INVERSE_DEPTH,
    LOW_PASS,
    OPACITY,
    PAYLOAD,
)
from jaxcloseup.fields.splats.splat_math import ALPHA_MIN


_MARGIN = 0.01  # pixels, and with the factor below more than rounding
_WIDER = 1.001


def reaches(
    table: jax.Array, splat: jax.Array, corner: jax.Array, *, tile: int, near: float
) -> jax.Array:
    """Return whether splats are at least `ALPHA_MIN` anywhere in a tile, `[P]`; never wrongly no.

    With `Footprints.homography` H, cutoff c and d = (1, q - anchor), a splat is where
    |(H[0].d, H[1].d)| <= c H[2].d: a convex set. Seen from its center, it enters a tile through an
    edge that faces the center. So it is enough to find the least of a quadratic along two segments.
    That is the answer as long as the depth is positive all over the splat; one that reaches `near`
    is kept. Where the center is so far outside the image that the anchor is not the center, it is
    the nearest pixel of a larger rectangle, and the same edges face both.

    Args:
      table: `[N, C]` from `pack`.
      splat: `[P]` index of a splat.
      corner: `[P, 2]` x and y of the tile's first pixel.
      tile: side of a tile in pixels; static.
      near: z-depth before which nothing is drawn.
    """
    rows = table[:, :PAYLOAD][splat]

    def column(i: int) -> jax.Array:
        return rows[:, i]

    # Where alpha falls to ALPHA_MIN, in standard deviations, and a little farther.
    opacity = jnp.maximum(column(OPACITY) / ALPHA_MIN, 1)
    cutoff = _WIDER * jnp.sqrt(2 * jnp.log(opacity))
    # Pixel centers of the tile about the anchor, and the one that is nearest to the anchor.
    first = corner.astype(table.dtype) + 0.5 - rows[:, ANCHOR:HOMOGRAPHY]
    low, high = first - _MARGIN, first + (tile - 1 + _MARGIN)
    x, y = (jnp.clip(0, low[:, i], high[:, i]) for i in (0, 1))
    side = tile - 1 + 2 * _MARGIN

    def meets(x: jax.Array, y: jax.Array, axis: int) -> jax.Array:
        """Return whether the splat meets the side's segment from (x, y) along `axis`."""
        scales: tuple[jax.Array | int, ...] = (1, 1, cutoff)
        start: list[jax.Array] = []
        along: list[jax.Array] = []
        for i, scale in zip(range(HOMOGRAPHY, OPACITY, 3), scales, strict=True):
            start.append(scale * (column(i) + column(i + 1) * x + column(i + 2) * y))
            along.append(scale * (side * column(i + 1 + axis)))

        def form(a: list[jax.Array], b: list[jax.Array]) -> jax.Array:
            return a[0] * b[0] + a[1] * b[1] - a[2] * b[2]

        # The cone u^2 + v^2 - (c w)^2 along the segment is a parabola; its least value is at an
        # end or its vertex. Where it opens downwards the splat may reach past infinity: keep it.
        curvature = form(along, along)
        convex = curvature > 0
        step = jnp.clip(-form(start, along) / jnp.where(convex, curvature, 1), 0, 1)
        least = [a + step * b for a, b in zip(start, along, strict=True)]
        return ~convex | (form(least, least) <= 0)

    # Only the two edges through the tile's nearest point to the anchor are tested.
    disc = meets(x, low[:, 1], 1) | meets(low[:, 0], y, 0)
    low_pass = column(LOW_PASS) * (x * x + y * y) <= cutoff * cutoff
    return disc | low_pass | (column(INVERSE_DEPTH + 1) * near >= 1 / _WIDER)
