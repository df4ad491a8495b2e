"""The compositor in `jax.lax`, for every platform.

A step evaluates a chunk of `K` splats of each of `B` tiles at all `P` pixels of these tiles, in
arrays `[B, K, P]`; only the products along a list are sequential. A tile whose list has ended makes
way for the next one, longest lists first, so that nothing waits. The derivative walks the lists
back to front, so memory is linear in pixels and pairs, and all sums have one fixed order.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax

from jaxcloseup.fields.splats.config import RasterPlan
from jaxcloseup.fields.splats.layout import MOMENTS, PAYLOAD, Channels, Trace, pixel_rows
from jaxcloseup.fields.splats.splat_math import (
    TRANSMITTANCE_MIN,
    Moments,
    Shade,
    Walk,
    channels,
    pass_splat,
    pull_back,
    row_bar,
    shade,
    sum_pixels,
    worth,
)
from jaxcloseup.fields.splats.tile_chunks import (
    Chunk,
    Queue,
    States,
    advance,
    along,
    begin,
    chunk_at,
    lanes_of,
    pixels_of,
    with_none,
)
from jaxcloseup.fields.splats.tiling import TileLists


_EXACT = lax.Precision.HIGHEST
_FEWEST = 16  # splats of a chunk of the derivative, which reads more for each chunk


def _pass_chunk(
    walk: Walk, seen: Shade, products: jax.Array, place: jax.Array
) -> tuple[list[jax.Array], Walk]:
    """Return the weights `[B, P]` of each of a chunk's splats, and the walk behind them."""
    weights = []
    for k in range(place.shape[1]):
        weight, walk = pass_splat(
            walk,
            seen.alpha[:, k],
            seen.inverse_depth[:, k],
            seen.z[:, k],
            before=products[:, k],
            after=products[:, k + 1],
            position=place[:, k],
        )
        weights.append(weight)
    return weights, walk


class _ForwardState(struct.PyTreeNode):
    """State of the forward loop."""

    queue: Queue  # tiles at work and waiting
    # `[B, P]` product of 1 - alpha so far, also behind a finished pixel's last splat
    product: jax.Array
    walk: Walk  # position of each pixel of the tiles at work
    sums: Channels  # partial sums of the same pixels
    ended: jax.Array  # `[T + 1, C, P]` pixels of tiles whose lists have ended, see `pixel_rows`


def forward(
    plan: RasterPlan, table: jax.Array, lists: TileLists
) -> tuple[jax.Array, jax.Array, Trace]:
    """Compute the sums and the median of `blend_tiles`, and what `backward` needs besides."""
    features, tiles = table.shape[1] - PAYLOAD, lists.counts.shape[0]
    lanes, rows = lanes_of(plan, tiles), pixel_rows(features)
    x, y = (at[None, None] for at in pixels_of(plan.tile, table.dtype))
    of_tile = with_none(lists)
    ones = jnp.ones((lanes, plan.tile**2), table.dtype)
    zeros = jnp.zeros_like(ones)
    fresh = Walk(ones, jnp.zeros(ones.shape, jnp.int32), zeros, zeros)

    def attenuate(product: States, alpha: States) -> States:
        # It keeps falling once a pixel is finished, so the pixel stays finished.
        return (product[0] - alpha[0] * product[0],)

    def step(state: _ForwardState) -> _ForwardState:
        queue = state.queue
        here = of_tile.at(queue.tile)
        position = queue.step * plan.chunk
        splats = chunk_at(table, lists.splats, here, position, plan.chunk)
        seen = shade(splats.column, x, y, plan.near)
        # A lane whose tile begins has the numbers of the tile before.
        begins = (queue.step == 0)[:, None]
        before = jnp.where(begins, 1, state.product)
        walk = jax.tree.map(lambda new, old: jnp.where(begins, new, old), fresh, state.walk)
        sums = jax.tree.map(lambda total: jnp.where(begins, 0, total), state.sums)
        (product,), (products,) = along(attenuate, (before,), (seen.alpha,))
        weights, walk = _pass_chunk(walk, seen, products, splats.place[..., None])
        # Without the barrier XLA would compute the weights anew for every channel.
        weights = lax.optimization_barrier(weights)
        values = channels(splats.column, features, seen, walk.reference[:, None])
        # One chunk's sum first, then the total: the order is fixed by the chunk's size alone.
        sums = jax.tree.map(
            lambda total, channel: (
                total + sum(weights[k] * channel[:, k] for k in range(plan.chunk))
            ),
            sums,
            values,
        )
        finished = jnp.max(product, axis=-1) < TRANSMITTANCE_MIN
        done = finished | (position + plan.chunk >= here.counts)
        stop = walk.stop.astype(table.dtype)
        rest = jnp.stack([walk.median, walk.remaining, stop, walk.reference], axis=1)
        pixels = jnp.concatenate([jnp.stack(sums.listed(), axis=1), rest], axis=1)
        # Lanes that go on write to the row of no tile.
        ended = state.ended.at[jnp.where(done, queue.tile, tiles)].set(pixels)
        return _ForwardState(advance(queue, done), product, walk, sums, ended)

    # A tile without splats shows nothing, through all of the transmittance.
    ended = jnp.zeros((tiles + 1, rows.total, plan.tile**2), table.dtype)
    ended = ended.at[:, rows.transmittance].set(1)
    sums = Channels.of((zeros,) * (features + MOMENTS))
    state = _ForwardState(begin(lists.counts, lanes), ones, fresh, sums, ended)
    state = lax.while_loop(lambda state: jnp.any(state.queue.tile < tiles), step, state)
    ended = state.ended[:-1]
    median, remaining = ended[:, rows.median], ended[:, rows.transmittance]
    stop, reference = ended[:, rows.stop], ended[:, rows.reference]
    return ended[:, rows.sums], median, Trace(remaining, stop.astype(jnp.int32), reference)


class _BackwardState(struct.PyTreeNode):
    """State of the backward loop."""

    queue: Queue  # tiles at work and waiting; steps count chunks from the back
    behind: jax.Array  # `[B, P]` sum of weight times worth of the splats behind the chunk
    after: jax.Array  # `[B, P]` transmittance behind the chunk
    table_bar: jax.Array  # `[N, C]` partial cotangent of the table


def backward(
    plan: RasterPlan,
    table: jax.Array,
    lists: TileLists,
    trace: Trace,
    cotangents: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """Compute the table's cotangent `[N, C]` from those of the sums and the median."""
    tiles = lists.counts.shape[0]
    lanes, chunk = lanes_of(plan, tiles), max(plan.chunk, _FEWEST)
    grid = _grid(plan.tile, table.dtype)
    of_tile = with_none(lists)
    sums_bar, median_bar = cotangents
    of_pixel = jnp.concatenate(  # see `pixel_rows`
        [
            sums_bar,
            median_bar[:, None],
            trace.transmittance[:, None].astype(table.dtype),
            trace.stop[:, None].astype(table.dtype),
            trace.reference[:, None].astype(table.dtype),
        ],
        axis=1,
    )
    of_pixel = jnp.pad(of_pixel, ((0, 1), (0, 0), (0, 0)))
    # Splats behind the one that finished the last pixel contribute nothing.
    counted = jnp.minimum(trace.stop.max(axis=-1), lists.counts)
    chunks = jnp.pad(-(-counted // chunk), (0, 1))

    def step(state: _BackwardState) -> _BackwardState:
        queue = state.queue
        left = chunks[queue.tile] - 1 - queue.step
        here = of_tile.at(queue.tile)
        position = jnp.maximum(left, 0) * chunk
        splats = chunk_at(table, lists.splats, here, position, chunk)
        update, behind, after = _pull_chunk(plan, grid, splats, of_pixel[queue.tile], state)
        # The scatter adds a step's updates in their order, so gradients repeat to the last bit.
        table_bar = state.table_bar.at[splats.index.reshape(-1)].add(
            update.reshape(-1, table.shape[1])
        )
        return _BackwardState(advance(queue, left <= 0), behind, after, table_bar)

    zeros = jnp.zeros((lanes, plan.tile**2), table.dtype)
    state = _BackwardState(begin(chunks[:-1], lanes), zeros, zeros, jnp.zeros_like(table))
    state = lax.while_loop(lambda state: jnp.any(state.queue.tile < tiles), step, state)
    return state.table_bar


class _Grid(struct.PyTreeNode):
    """Pixels of a tile."""

    x: jax.Array  # `[1, 1, P]` columns of the pixel centers
    y: jax.Array  # `[1, 1, P]` rows of the pixel centers
    basis: jax.Array  # `[P, 3]` factors of the moments: 1, and x and y about the tile's middle


def _grid(tile: int, dtype: jnp.dtype) -> _Grid:
    pixels = pixels_of(tile, dtype)
    x, y = (at[None, None] for at in pixels)
    # Moments about the middle of a tile lose the fewest digits.
    middle = tile / 2
    basis = jnp.stack([jnp.ones_like(pixels[0]), *(at - middle for at in pixels)], axis=1)
    return _Grid(x, y, basis)


def _pull_chunk(
    plan: RasterPlan, grid: _Grid, splats: Chunk, pixels: jax.Array, state: _BackwardState
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Pull cotangents of pixels back to a chunk of splats.

    Args:
      plan: static.
      grid: of a tile's pixels.
      splats: the chunk.
      pixels: `[B, F + MOMENTS + 4, P]` cotangents and traces, see `pixel_rows`.
      state: behind the chunk.

    Returns:
      Cotangents `[B, K, C]` of the splats' rows, and `behind` and `after` of the state in front of
      the chunk.
    """
    features = splats.rows.shape[-1] - PAYLOAD
    rows = pixel_rows(features)
    at = [pixels[:, i, None] for i in range(rows.total)]
    sums_bar, remaining = Channels.of(at[rows.sums]), at[rows.transmittance]
    trace = Trace(remaining, at[rows.stop].astype(jnp.int32), at[rows.reference])
    seen = shade(splats.column, grid.x, grid.y, plan.near)
    alpha = jnp.where(splats.place[..., None] < trace.stop, seen.alpha, 0)
    value = worth(splats.column, seen, trace.reference, sums_bar)

    def recede(state: States, splat: States) -> States:
        behind, after = state
        alpha, passing, value = splat
        before = after * passing
        return behind + alpha * before * value, before

    begins = (state.queue.step == 0)[:, None]
    ends = jnp.where(begins, 0, state.behind), jnp.where(begins, remaining[:, 0], state.after)
    of_splats = alpha, 1 / (1 - alpha), value
    (behind, after), (worths, products) = along(recede, ends, of_splats, reverse=True)
    weight, pulled = pull_back(
        seen,
        alpha,
        before=products[:, :-1],
        after=products[:, 1:],
        behind=worths[:, 1:],
        value=value,
        trace=trace,
        sums_bar=sums_bar,
        median_bar=at[rows.median],
    )

    # Sums over pixels as small matrix products, at full precision: accelerators would round.
    def moments(values: jax.Array) -> Moments:
        sums = jnp.einsum("bkp,pm->bkm", values, grid.basis, precision=_EXACT)
        return jnp.moveaxis(sums, -1, 0)  # a triple in one array

    payload_bar = pixels[:, :features]
    payload = jnp.einsum("bkp,bfp->bkf", weight, payload_bar, precision=_EXACT)
    sums = sum_pixels(pulled, moments, lambda values: values.sum(-1))
    columns = row_bar(lambda i: splats.column(i)[..., 0], plan.tile / 2, sums, [])
    return jnp.concatenate([jnp.stack(columns, axis=-1), payload], axis=-1), behind, after
