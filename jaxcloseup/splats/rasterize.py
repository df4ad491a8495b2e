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
      near: z-depth in world units before which nothing is drawn.
      tile: side of a tile in pixels.
      chunk: splats of a tile that are evaluated at once.
      block: tiles that are evaluated at once.
    """

    capacity: int = 2**18
    near: float = 0.01
    tile: int = 8
    chunk: int = 16
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
      box: `[N, 4]` x and y of the first, then of the last pixel edge that may be touched; empty
        where last <= first. No gradient.
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
    median: jax.Array  # position of the median splat, -1 if none
    reference: jax.Array  # inverse depth of the first drawn splat


class _Shade(NamedTuple):
    """One chunk's splats at every pixel, `[B, K, P]`."""

    alpha: jax.Array  # 0 where not drawn
    inverse_depth: jax.Array
    z: jax.Array
    u_numerator: jax.Array
    v_numerator: jax.Array
    w: jax.Array
    on_plane: jax.Array  # where the disc, not the low-pass, gives rho
    rho: jax.Array


def _shade(splats: jax.Array, x: jax.Array, y: jax.Array, near: float) -> _Shade:
    """Evaluate gathered table rows `[B, K, C]` (anchors local to the tile) at pixels `[P]`."""
    column = lambda i: splats[:, :, i, None]  # noqa: E731
    dx, dy = x[None, None] - column(_ANCHOR), y[None, None] - column(_ANCHOR + 1)
    u, v, w = (
        column(i) + column(i + 1) * dx + column(i + 2) * dy for i in (_ROWS, _ROWS + 3, _ROWS + 6)
    )
    squared = u * u + v * v
    low_pass = column(_LOW_PASS) * (dx * dx + dy * dy)
    # rho compares without dividing, and w <= 0 (a ray that misses the plane) leaves the low-pass.
    on_plane = (w > 0) & (squared <= low_pass * (w * w))
    inverse = jnp.where(on_plane, w, jnp.clip(w, column(_RANGE), column(_RANGE + 1)))
    z = 1 / inverse
    rho = jnp.where(on_plane, squared * (z * z), low_pass)
    alpha = jnp.minimum(column(_OPACITY) * jnp.exp(-0.5 * rho), ALPHA_MAX)
    alpha = jnp.where((alpha >= ALPHA_MIN) & (w * near <= 1), alpha, 0)
    return _Shade(alpha, inverse, z, u, v, w, on_plane, rho)


def _gather(table, lists: TileLists, starts, counts, origins, position, chunk):
    """Rows `[B, K, C]` of one chunk of each tile, anchors made local; index `[B, K]`."""
    place = position + jnp.arange(chunk, dtype=jnp.int32)[None]
    inside = place < counts[:, None]
    index = lists.splats[jnp.where(inside, starts[:, None] + place, 0)]
    rows = table[index]
    anchor = rows[..., :2] - origins[:, None]
    opacity = jnp.where(inside, rows[..., _OPACITY], 0)[..., None]
    rows = jnp.concatenate(
        [anchor, rows[..., _ROWS:_OPACITY], opacity, rows[..., _LOW_PASS:]], axis=-1
    )
    return rows, index


def _pixels(tile: int, dtype) -> tuple[jax.Array, jax.Array]:
    """Pixel centres `[P]` of a tile whose first corner is the origin."""
    centres = jnp.arange(tile, dtype=dtype) + 0.5
    return jnp.tile(centres, tile), jnp.repeat(centres, tile)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _composite(config: RasterizeConfig, table: jax.Array, lists: TileLists):
    """Sums `[T, F + 4, P]` (payload, depth, 1, two moments) and median depth `[T, P]` of all tiles."""
    return _composite_forward(config, table, lists)[0]


def _composite_forward(config, table, lists):
    features = table.shape[1] - _PAYLOAD
    x, y = _pixels(config.tile, table.dtype)

    def block(tiles):
        starts, counts, origins = tiles
        origins = origins.astype(table.dtype)
        shape = (config.block, config.tile**2)
        longest = counts.max()

        def unfinished(state):
            position, transmittance = state[:2]
            return (position < longest) & jnp.any(
                (transmittance >= TRANSMITTANCE_MIN) & (position < counts)[:, None]
            )

        def step(state):
            position, product, remaining, stop, median_at, reference, median, sums = state
            rows, _ = _gather(table, lists, starts, counts, origins, position, config.chunk)
            shade = _shade(rows, x, y, config.near)
            alphas, inverses, zs = lax.optimization_barrier(
                (shade.alpha, shade.inverse_depth, shade.z)
            )
            sums = list(sums)
            for k in range(config.chunk):
                alpha, inverse, z = alphas[:, k], inverses[:, k], zs[:, k]
                weight = alpha * product
                # The product keeps falling once a pixel is finished, so it stays finished.
                after = product - weight
                open_ = after >= TRANSMITTANCE_MIN
                drawn = alpha > 0
                weight = jnp.where(open_, weight, 0)
                reference = jnp.where(drawn & (product == 1), inverse, reference)
                half = drawn & (product > 0.5)
                median = jnp.where(half, z, median)
                median_at = jnp.where(half, position + k, median_at)
                remaining = jnp.where(open_, after, remaining)
                stop = jnp.where(open_, position + (k + 1), stop)
                shifted = inverse - reference
                first = weight * shifted
                for f in range(features):
                    sums[f] = sums[f] + weight * rows[:, k, _PAYLOAD + f, None]
                sums[features] = sums[features] + weight * z
                sums[features + 1] = sums[features + 1] + first
                sums[features + 2] = sums[features + 2] + first * shifted
                product = after
            position = position + config.chunk
            return position, product, remaining, stop, median_at, reference, median, tuple(sums)

        ones, zeros = jnp.ones(shape, table.dtype), jnp.zeros(shape, table.dtype)
        whole = jnp.zeros(shape, jnp.int32)
        state = (
            jnp.int32(0),
            ones,
            ones,
            whole,
            whole - 1,
            zeros,
            zeros,
            (zeros,) * (features + 3),
        )
        _, _, remaining, stop, median_at, reference, median, sums = lax.while_loop(
            unfinished, step, state
        )
        sums = jnp.stack([*sums[: features + 1], 1 - remaining, *sums[features + 1 :]], axis=1)
        return sums, median, _Trace(remaining, stop, median_at, reference)

    sums, median, trace = lax.map(block, (lists.starts, lists.counts, lists.origins))
    unsort = lambda a: a.reshape((-1, *a.shape[2:]))[lists.slot]  # noqa: E731
    return (unsort(sums), unsort(median)), (table, lists, trace)


def _composite_backward(config, residuals, cotangents):
    table, lists, trace = residuals
    columns = table.shape[1]
    features = columns - _PAYLOAD
    x, y = _pixels(config.tile, table.dtype)
    basis = jnp.stack([jnp.ones_like(x), x, y], axis=1)
    sums_bar, median_bar = (bar[lists.tile] for bar in cotangents)

    def block(table_bar, tiles):
        starts, counts, origins, sums_bar, median_bar, trace = tiles
        origins = origins.astype(table.dtype)
        bars = [sums_bar[:, i] for i in range(features + 4)]
        depth_bar, alpha_bar, first_bar, second_bar = bars[features:]

        def step(state):
            position, behind, transmittance, table_bar = state
            rows, index = _gather(table, lists, starts, counts, origins, position, config.chunk)
            shade = _shade(rows, x, y, config.near)
            place = position + jnp.arange(config.chunk, dtype=jnp.int32)[None, :, None]
            alphas = jnp.where(place < trace.stop[:, None], shade.alpha, 0)
            shifted = shade.inverse_depth - trace.reference[:, None]
            # What a unit of weight of each splat is worth to the loss.
            worth = alpha_bar[:, None] + shade.z * depth_bar[:, None]
            worth = worth + shifted * (first_bar[:, None] + shifted * second_bar[:, None])
            for f in range(features):
                worth = worth + rows[:, :, _PAYLOAD + f, None] * bars[f][:, None]
            inverse = 1 / (1 - alphas)
            alphas, worth, inverse = lax.optimization_barrier((alphas, worth, inverse))
            weights, alphas_bar = [], []
            for k in reversed(range(config.chunk)):
                transmittance = transmittance * inverse[:, k]
                weight = alphas[:, k] * transmittance
                alphas_bar.append(transmittance * worth[:, k] - behind * inverse[:, k])
                behind = behind + weight * worth[:, k]
                weights.append(weight)
            weights, alphas_bar = lax.optimization_barrier(
                (jnp.stack(weights[::-1], 1), jnp.stack(alphas_bar[::-1], 1))
            )
            z_bar = weights * depth_bar[:, None]
            z_bar = z_bar + jnp.where(place == trace.median[:, None], median_bar[:, None], 0)
            inverse_bar = weights * (first_bar[:, None] + 2 * shifted * second_bar[:, None])
            inverse_bar = inverse_bar - shade.z * shade.z * z_bar
            scaled = alphas * alphas_bar
            scaled = jnp.where(alphas < ALPHA_MAX, scaled, 0)
            plane_bar = jnp.where(shade.on_plane, -scaled * shade.z, 0)  # -2 rho_bar z
            u_bar = plane_bar * shade.z * shade.u_numerator
            v_bar = plane_bar * shade.z * shade.v_numerator
            clipped = ~shade.on_plane & (shade.inverse_depth != shade.w)
            w_bar = jnp.where(clipped, 0, inverse_bar) - plane_bar * shade.rho
            clip_bar = jnp.where(clipped, inverse_bar * shade.inverse_depth**2, 0)
            pass_bar = jnp.where(shade.on_plane, 0, scaled)
            maps = lax.optimization_barrier((u_bar, v_bar, w_bar, pass_bar, clip_bar, scaled))
            moments = [_reduce(m, basis) for m in maps[:4]]
            clip_sum, scaled_sum = (m.sum(-1, keepdims=True) for m in maps[4:])
            payload_bar = jnp.einsum("bkp,bfp->bkf", weights, sums_bar[:, :features])
            update = _assemble(rows, moments, clip_sum, scaled_sum, payload_bar)
            table_bar = table_bar.at[index.reshape(-1)].add(update.reshape(-1, columns))
            return position - config.chunk, behind, transmittance, table_bar

        last = jnp.minimum(trace.stop.max(), counts.max()) - 1
        state = (
            jnp.maximum(last, -1) // config.chunk * config.chunk,
            jnp.zeros_like(median_bar),
            trace.transmittance,
            table_bar,
        )
        return lax.while_loop(lambda state: state[0] >= 0, step, state)[-1], None

    tiles = (lists.starts, lists.counts, lists.origins, sums_bar, median_bar, trace)
    return lax.scan(block, jnp.zeros_like(table), tiles)[0], None


def _reduce(values: jax.Array, basis: jax.Array) -> jax.Array:
    return jnp.einsum("bkp,pm->bkm", values, basis, precision=lax.Precision.HIGHEST)


def _assemble(rows, moments, clip_sum, scaled_sum, payload_bar):
    anchor = rows[..., :2]
    about = [
        jnp.concatenate([m[..., :1], m[..., 1:] - m[..., :1] * anchor], axis=-1) for m in moments
    ]
    anchor_bar = rows[..., _LOW_PASS : _LOW_PASS + 1] * about[3][..., 1:]
    for i in range(3):
        slope = rows[..., _ROWS + 3 * i + 1 : _ROWS + 3 * i + 3]
        anchor_bar = anchor_bar - about[i][..., :1] * slope
    # A clipped depth moves with the depth of the centre, 1 / rows[2, 0].
    clip_sum = safe_divide(clip_sum, rows[..., _ROWS + 6 : _ROWS + 7] ** 2)
    constant = jnp.concatenate([clip_sum, jnp.zeros_like(anchor)], axis=-1)
    opacity = rows[..., _OPACITY : _OPACITY + 1]
    zeros = jnp.zeros_like(rows[..., _LOW_PASS:_PAYLOAD])
    return jnp.concatenate(
        [
            anchor_bar,
            about[0],
            about[1],
            about[2] + constant,
            safe_divide(scaled_sum, opacity),
            zeros,
            payload_bar,
        ],
        axis=-1,
    )


_composite.defvjp(_composite_forward, _composite_backward)
