"""Front-to-back compositing of planar homographies, tile by tile, with a hand-written derivative.

The kernel knows nothing of surfels, Gaussians or cameras. Every splat is three affine functions of
the pixel, a reference pixel and a payload (`Footprints`); a 3-D Gaussian's ellipse is the special
case of a constant inverse depth. Its work is arranged for vector units: tiles are sorted by the
length of their lists and taken in blocks, a block takes its lists in chunks, and a chunk is one
dense `[tiles, splats, pixels]` evaluation. The derivative walks the same chunks back to front, so
memory is linear in pixels and pairs, and nothing is accumulated in an order that may vary.
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
from jaxcloseup.splats.tiling import TileLists, tile_lists


ALPHA_MIN = 1 / 255  # fainter contributions are not drawn
ALPHA_MAX = 0.99  # nothing is fully opaque, so that what lies behind keeps a gradient
TRANSMITTANCE_MIN = 1e-4  # a pixel is finished before its transmittance would fall below this


@dataclasses.dataclass(frozen=True)
class RasterizeConfig:
    """Static sizes of the rasteriser; none of them changes the image.

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
    block: int = 64


@struct.dataclass
class Footprints:
    """What is drawn, `N` splats in any order.

    At pixel q, with d = (1, q - anchor), the local coordinates are (u, v) = (rows[0].d, rows[1].d)
    / (rows[2].d) and the z-depth is 1 / (rows[2].d). The opacity falls as exp(-rho / 2) with
    rho = min(u^2 + v^2, low_pass |q - anchor|^2).

    Attributes:
      anchor: `[N, 2]` reference pixel, the projected centre wherever the low-pass can be seen.
      rows: `[N, 3, 3]` affine functions: columns multiply 1, x - anchor_x, y - anchor_y.
      opacity: `[N]` in [0, 1]; 0 is never drawn.
      low_pass: `[N]` inverse variance of the screen-space floor; very large is none. No gradient.
      inverse_depth: `[N, 2]` range to which 1/z is held where the low-pass wins. The derivative
        there is that of the depth at the anchor.
      payload: `[N, F]` what is composited: colours, normals, anything.
      order: `[N]` z-depth, positive, by which splats are sorted. No gradient.
      box: `[N, 4]` bounds (x0, y0, x1, y1) in pixels of all that is not fainter than `ALPHA_MIN`;
        empty where x1 < x0. No gradient.
    """

    anchor: jax.Array
    rows: jax.Array
    opacity: jax.Array
    low_pass: jax.Array
    inverse_depth: jax.Array
    payload: jax.Array
    order: jax.Array
    box: jax.Array


class Composite(NamedTuple):
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
) -> Composite:
    """Composite `footprints` into an image of `height` x `width` pixels.

    Differentiable in anchor, rows, opacity and payload. Deterministic; ties in `order` go to the
    lower index.
    """
    count, features = footprints.payload.shape
    chex.assert_shape(footprints.anchor, (count, 2))
    chex.assert_shape(footprints.rows, (count, 3, 3))
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
    table = _pack(footprints)
    sums, median = _composite(config, table, lists)
    image = functools.partial(_untile, height=height, width=width, tile=config.tile)
    payload = jnp.moveaxis(jax.vmap(image, in_axes=1)(sums[:, :features]), 0, -1)
    depth, alpha, first, second = (image(sums[:, features + i]) for i in range(4))
    return Composite(
        payload=payload,
        alpha=alpha,
        depth=safe_divide(depth, alpha),
        median_depth=image(median),
        # The moments are about the inverse depth of the first contributor, whose weight is at least
        # ALPHA_MIN: without that shift a converged surface would lose every digit of its spread.
        distortion=jnp.maximum(alpha * second - first * first, 0),
        overflow=lists.overflow,
    )


# Columns of the packed table that a chunk gathers; the payload follows.
_ANCHOR, _ROWS, _OPACITY, _LOW_PASS, _RANGE, _PAYLOAD = 0, 2, 11, 12, 13, 15
_EXACT = lax.Precision.HIGHEST


def _pack(footprints: Footprints) -> jax.Array:
    count = footprints.opacity.shape[0]
    return jnp.concatenate(
        [
            footprints.anchor,
            footprints.rows.reshape(count, 9),
            footprints.opacity[:, None],
            lax.stop_gradient(footprints.low_pass)[:, None],
            lax.stop_gradient(footprints.inverse_depth),
            footprints.payload,
        ],
        axis=-1,
    )


def _untile(tiles: jax.Array, *, height: int, width: int, tile: int) -> jax.Array:
    """Pixels `[T, P]` of all tiles in row-major order to an image `[H, W]`."""
    down, across = -(-height // tile), -(-width // tile)
    image = tiles.reshape(down, across, tile, tile).swapaxes(1, 2)
    return image.reshape(down * tile, across * tile)[:height, :width]


class _Trace(NamedTuple):
    """What the derivative needs of the forward pass, per pixel of all blocks `[blocks, B, P]`."""

    transmittance: jax.Array  # behind the last drawn splat
    stop: jax.Array  # position in the list where the pixel was finished
    reference: jax.Array  # inverse depth of the first drawn splat


class _Shade(NamedTuple):
    """One chunk's splats at every pixel, `[K, B, P]`."""

    alpha: jax.Array  # 0 where not drawn
    inverse_depth: jax.Array
    z: jax.Array
    u_numerator: jax.Array
    v_numerator: jax.Array
    rho: jax.Array
    on_plane: jax.Array  # where the disc, not the low-pass, gives rho
    clipped: jax.Array  # where the low-pass does and the disc's plane leaves the disc's depths


def _shade(splats: jax.Array, x: jax.Array, y: jax.Array, near: float) -> _Shade:
    """Evaluate gathered table rows `[K, B, C]` (anchors local to the tile) at pixels `[P]`."""
    column = lambda i: splats[:, :, i, None]  # noqa: E731
    dx, dy = x[None, None] - column(_ANCHOR), y[None, None] - column(_ANCHOR + 1)
    u, v, w = (
        column(i) + column(i + 1) * dx + column(i + 2) * dy for i in (_ROWS, _ROWS + 3, _ROWS + 6)
    )
    squared = u * u + v * v
    low_pass = column(_LOW_PASS) * (dx * dx + dy * dy)
    # rho compares without dividing, and w <= 0 (a ray that misses the plane) leaves the low-pass.
    on_plane = (w > 0) & (squared <= low_pass * (w * w))
    low, high = column(_RANGE), column(_RANGE + 1)
    inverse = jnp.where(on_plane, w, jnp.clip(w, low, high))
    z = 1 / inverse
    rho = jnp.where(on_plane, squared * (z * z), low_pass)
    alpha = jnp.minimum(column(_OPACITY) * jnp.exp(-0.5 * rho), ALPHA_MAX)
    alpha = jnp.where((alpha >= ALPHA_MIN) & (w * near <= 1), alpha, 0)
    return _Shade(alpha, inverse, z, u, v, rho, on_plane, ~on_plane & ((w < low) | (w > high)))


def _gather(table, lists: TileLists, tiles, position, chunk):
    """Rows `[K, B, C]` of a chunk of each tile, anchors made local, and their splats `[K, B]`."""
    starts, counts, origins = tiles
    place = position + jnp.arange(chunk, dtype=jnp.int32)[:, None]
    inside = place < counts[None]
    index = lists.splats[jnp.where(inside, starts[None] + place, 0)]
    rows = table[index]
    anchor = rows[..., :_ROWS] - origins[None].astype(table.dtype)
    opacity = jnp.where(inside, rows[..., _OPACITY], 0)[..., None]
    rows = jnp.concatenate(
        [anchor, rows[..., _ROWS:_OPACITY], opacity, rows[..., _OPACITY + 1 :]], axis=-1
    )
    return rows, index


def _pixels(tile: int, dtype) -> tuple[jax.Array, jax.Array]:
    """Pixel centres `[P]` of a tile whose first corner is the origin."""
    centres = jnp.arange(tile, dtype=dtype) + 0.5
    return jnp.tile(centres, tile), jnp.repeat(centres, tile)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _composite(config: RasterizeConfig, table: jax.Array, lists: TileLists):
    """Sums `[T, F + 4, P]` (payload, z, 1 and two moments) and median z `[T, P]` of all tiles."""
    return _composite_forward(config, table, lists)[0]


def _composite_forward(config, table, lists):
    features = table.shape[1] - _PAYLOAD
    x, y = _pixels(config.tile, table.dtype)

    def attenuate(product, alpha):
        # The product keeps falling once a pixel is finished, so that it stays finished.
        product = product - alpha * product
        return product, product

    def block(tiles):
        counts = tiles[1]
        longest = counts.max()

        def unfinished(state):
            position, product = state[:2]
            listed = (position < counts)[:, None]
            return (position < longest) & jnp.any((product >= TRANSMITTANCE_MIN) & listed)

        def step(state):
            position, product, remaining, stop, reference, median, sums = state
            rows, _ = _gather(table, lists, tiles, position, config.chunk)
            shade = _shade(rows, x, y, config.near)
            before = product
            product, afters = lax.scan(attenuate, product, shade.alpha)
            weights = []
            for k in range(config.chunk):
                alpha, after = shade.alpha[k], afters[k]
                open_ = after >= TRANSMITTANCE_MIN
                weights.append(jnp.where(open_, alpha * before, 0))
                remaining = jnp.where(open_, after, remaining)
                stop = jnp.where(open_, position + (k + 1), stop)
                drawn = alpha > 0
                reference = jnp.where(drawn & (before == 1), shade.inverse_depth[k], reference)
                median = jnp.where(drawn & (before > 0.5), shade.z[k], median)
                before = after
            # A splat in front of the first one drawn weighs nothing, so one reference serves all.
            shifted = shade.inverse_depth - reference[None]
            channels = [rows[:, :, _PAYLOAD + f, None] for f in range(features)]
            channels += [shade.z, jnp.ones_like(shade.z), shifted, shifted * shifted]
            sums = tuple(
                total + sum(weights[k] * channel[k] for k in range(config.chunk))
                for total, channel in zip(sums, channels, strict=True)
            )
            return position + config.chunk, product, remaining, stop, reference, median, sums

        shape = (config.block, config.tile**2)
        ones, zeros = jnp.ones(shape, table.dtype), jnp.zeros(shape, table.dtype)
        stop = jnp.zeros(shape, jnp.int32)
        state = (jnp.int32(0), ones, ones, stop, zeros, zeros, (zeros,) * (features + 4))
        _, _, *trace, median, sums = lax.while_loop(unfinished, step, state)
        return jnp.stack(sums, axis=1), median, _Trace(*trace)

    sums, median, trace = lax.map(block, (lists.starts, lists.counts, lists.origins))
    in_order = lambda tiles: tiles.reshape((-1, *tiles.shape[2:]))[lists.slot]  # noqa: E731
    return (in_order(sums), in_order(median)), (table, lists, trace)


def _composite_backward(config, residuals, cotangents):
    table, lists, trace = residuals
    columns = table.shape[1]
    features = columns - _PAYLOAD
    x, y = _pixels(config.tile, table.dtype)
    # About the middle of a tile, where sums over its pixels keep most digits.
    middle = config.tile / 2
    basis = jnp.stack([jnp.ones_like(x), x - middle, y - middle], axis=1)

    def moments(values):
        sums = jnp.einsum("kbp,pm->kbm", values, basis, precision=_EXACT)
        return jnp.moveaxis(sums, -1, 0)

    cotangents = tuple(bar[lists.tile] for bar in cotangents)

    def recede(carry, splat):
        behind, after = carry
        alpha, passing, worth = splat
        before = after * passing
        behind = behind + alpha * before * worth
        return (behind, before), (behind, before)

    def block(table_bar, tiles):
        *tiles, (sums_bar, median_bar), trace = tiles
        z_bar, alpha_bar, first_bar, second_bar = (
            sums_bar[None, :, features + i] for i in range(4)
        )

        def step(state):
            position, behind, after, table_bar = state
            rows, index = _gather(table, lists, tiles, position, config.chunk)
            shade = _shade(rows, x, y, config.near)
            place = position + jnp.arange(config.chunk, dtype=jnp.int32)[:, None, None]
            alpha = jnp.where(place < trace.stop[None], shade.alpha, 0)
            shifted = shade.inverse_depth - trace.reference[None]
            # What a unit of weight of each splat is worth to the loss.
            worth = sum(
                rows[:, :, _PAYLOAD + f, None] * sums_bar[None, :, f] for f in range(features)
            )
            worth = worth + alpha_bar + shade.z * z_bar
            worth = worth + shifted * (first_bar + shifted * second_bar)
            passing = 1 / (1 - alpha)
            ends = (behind, after)
            (behind, after), (behinds, before) = lax.scan(
                recede, ends, (alpha, passing, worth), reverse=True
            )
            # What a splat finds behind it is what the next one leaves, up to the chunk's end.
            behinds = jnp.concatenate([behinds[1:], ends[0][None]])
            afters = jnp.concatenate([before[1:], ends[1][None]])
            weight = alpha * before
            # The splat in which half of the light is lost, or else the last one that is drawn.
            last = (afters <= 0.5) | (afters == trace.transmittance[None])
            median = (alpha > 0) & (before > 0.5) & last
            depth_bar = weight * z_bar + jnp.where(median, median_bar[None], 0)
            inverse_bar = weight * (first_bar + 2 * shifted * second_bar)
            inverse_bar = inverse_bar - shade.z * shade.z * depth_bar
            scaled = alpha * (before * worth - behinds * passing)  # d loss / d log(alpha)
            scaled = jnp.where(alpha < ALPHA_MAX, scaled, 0)
            plane = jnp.where(shade.on_plane, scaled * shade.z, 0)
            update = _assemble(
                rows,
                middle,
                u=moments(-plane * shade.z * shade.u_numerator),
                v=moments(-plane * shade.z * shade.v_numerator),
                w=moments(jnp.where(shade.clipped, 0, inverse_bar) + plane * shade.rho),
                low_pass=moments(jnp.where(shade.on_plane, 0, scaled)),
                clip=jnp.where(shade.clipped, inverse_bar * shade.inverse_depth**2, 0).sum(-1),
                scaled=scaled.sum(-1),
                payload=jnp.einsum(
                    "kbp,bfp->kbf", weight, sums_bar[:, :features], precision=_EXACT
                ),
            )
            table_bar = table_bar.at[index.reshape(-1)].add(update.reshape(-1, columns))
            return position - config.chunk, behind, after, table_bar

        longest = jnp.minimum(trace.stop.max(), tiles[1].max())
        position = (longest - 1) // config.chunk * config.chunk
        state = (position, jnp.zeros_like(median_bar), trace.transmittance, table_bar)
        return lax.while_loop(lambda state: state[0] >= 0, step, state)[-1], None

    tiles = (lists.starts, lists.counts, lists.origins, cotangents, trace)
    return lax.scan(block, jnp.zeros_like(table), tiles)[0], None


def _assemble(rows, middle, *, u, v, w, low_pass, clip, scaled, payload):
    """Cotangents `[K, B, C]` of gathered rows from sums over the tile's pixels.

    u, v, w (of the rows) and low_pass are moments `[3, K, B]`: sums of 1, x and y about `middle`.
    """
    ax, ay = rows[..., 0] - middle, rows[..., 1] - middle
    about_anchor = lambda m: (m[0], m[1] - ax * m[0], m[2] - ay * m[0])  # noqa: E731
    u, v, w, low_pass = map(about_anchor, (u, v, w, low_pass))
    slopes = rows[..., _ROWS:_OPACITY].reshape(*rows.shape[:2], 3, 3)[..., 1:]
    anchor_bar = [
        rows[..., _LOW_PASS] * low_pass[1 + axis]
        - sum(bar[0] * slopes[..., i, axis] for i, bar in enumerate((u, v, w)))
        for axis in range(2)
    ]
    # A clipped depth moves with the depth of the anchor, 1 / rows[2, 0].
    constant_bar = w[0] + safe_divide(clip, rows[..., _ROWS + 6] ** 2)
    opacity_bar = safe_divide(scaled, rows[..., _OPACITY])
    constants = [jnp.zeros_like(ax)] * (_PAYLOAD - _LOW_PASS)
    columns = [*anchor_bar, *u, *v, constant_bar, *w[1:], opacity_bar, *constants]
    return jnp.concatenate([jnp.stack(columns, axis=-1), payload], axis=-1)


_composite.defvjp(_composite_forward, _composite_backward)
