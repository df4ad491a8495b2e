"""The compositor in `jax.lax`, for every platform.

A step evaluates a chunk of `K` splats of each of `B` tiles at all `P` pixels of these tiles, in
arrays `[B, K, P]`; only the products along a list are sequential. A tile whose list has ended makes
way for the next one, longest lists first, so that nothing waits. The derivative walks the lists
back to front, so memory is linear in pixels and pairs, and all sums have one fixed order.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax

from jaxcloseup.fields.splats.config import RasterPlan
from jaxcloseup.fields.splats.layout import (
    ANCHOR,
    MOMENTS,
    OPACITY,
    PAYLOAD,
    Channels,
    Trace,
    pixel_rows,
)
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
from jaxcloseup.fields.splats.tiling import TileLists, longest_first


_EXACT = lax.Precision.HIGHEST
_FEWEST = 16  # splats of a chunk of the derivative, which reads more for each chunk

# Quantities of a splat at the pixels of tiles `[B, P]`, in tuples.
_States = tuple[jax.Array, ...]


class _Queue(struct.PyTreeNode):
    """Which tiles are at work, and which come next.

    Attributes:
      waiting: `[T + B]` tiles in the order in which they begin; `T` ends them.
      next: `[]` place of the next one.
      tile: `[B]` tiles at work, `T` where there is none.
      step: `[B]` chunks that they have behind them.
    """

    waiting: jax.Array
    next: jax.Array
    tile: jax.Array
    step: jax.Array


def _lanes(plan: RasterPlan, tiles: int) -> int:
    """Return how many tiles are at work at once."""
    # Few enough that short lists fill up behind long ones.
    return min(plan.block, -(-tiles // 4))


def _begin(counts: jax.Array, lanes: int) -> _Queue:
    """Return the queue of all tiles `[T]` whose lists have entries."""
    tiles = counts.shape[0]
    order = longest_first(counts)
    order = jnp.where(counts[order] > 0, order, tiles)
    waiting = jnp.pad(order, (0, lanes), constant_values=tiles)
    return _Queue(waiting, jnp.int32(lanes), waiting[:lanes], jnp.zeros(lanes, jnp.int32))


def _advance(queue: _Queue, done: jax.Array) -> _Queue:
    """Return the queue after a step, in which the tiles `done[B]` ended."""
    lanes = jnp.arange(done.shape[0])
    # Lanes that end in one step take the next tiles in the order of lanes.
    earlier = done[None] & (lanes[None] < lanes[:, None])
    place = queue.next + jnp.sum(earlier, axis=1, dtype=jnp.int32)
    place = jnp.minimum(place, queue.waiting.shape[0] - 1)
    return queue.replace(
        next=queue.next + jnp.sum(done, dtype=jnp.int32),
        tile=jnp.where(done, queue.waiting[place], queue.tile),
        step=jnp.where(done, 0, queue.step + 1),
    )


class _Tiles(struct.PyTreeNode):
    """Where the lists of tiles lie, and where the tiles: of `T` tiles and none, or `B` at work."""

    starts: jax.Array
    counts: jax.Array
    origins: jax.Array

    def at(self, tile: jax.Array) -> "_Tiles":
        """Return these of the tiles `[B]`."""
        return _Tiles(self.starts[tile], self.counts[tile], self.origins[tile])


def _with_none(lists: TileLists) -> _Tiles:
    """Return all tiles and, last, none: an empty list, which idle lanes walk."""
    return _Tiles(
        starts=jnp.pad(lists.starts, (0, 1)),
        counts=jnp.pad(lists.counts, (0, 1)),
        origins=jnp.pad(lists.origins, ((0, 1), (0, 0))),
    )


class _Chunk(struct.PyTreeNode):
    """Splats `[B, K]` at the places of a chunk in their tiles' lists.

    Attributes:
      rows: `[B, K, C]` of the table.
      index: which splats they are.
      place: in the lists.
      inside: bool; False past a list's end.
      origins: `[B, 2]` first pixels of the tiles.
    """

    rows: jax.Array
    index: jax.Array
    place: jax.Array
    inside: jax.Array
    origins: jax.Array

    def column(self, i: int) -> jax.Array:
        """Return a column `[B, K, 1]`; anchors are local to tiles, and opacity ends with lists."""
        value = self.rows[:, :, i]
        if i in (ANCHOR, ANCHOR + 1):
            # Small differences from here on: pixels of a large image would cost float32 its digits.
            value = value - self.origins[:, None, i - ANCHOR].astype(value.dtype)
        elif i == OPACITY:
            value = jnp.where(self.inside, value, 0)
        return value[..., None]


def _chunk(
    table: jax.Array, splats: jax.Array, tiles: _Tiles, position: jax.Array, size: int
) -> _Chunk:
    """Return the chunk of `size` splats at `position[B]` of each tile's list."""
    place = position[:, None] + jnp.arange(size, dtype=jnp.int32)[None]
    inside = place < tiles.counts[:, None]
    # Past a list's end, take the splat at its start.
    index = splats[tiles.starts[:, None] + jnp.where(inside, place, 0)]
    return _Chunk(table[index], index, place, inside, tiles.origins)


def _pixels(tile: int, dtype: jnp.dtype) -> tuple[jax.Array, jax.Array]:
    """Return pixel centers x and y `[P]` of a tile whose first corner is the origin."""
    centers = jnp.arange(tile, dtype=dtype) + 0.5
    return jnp.tile(centers, tile), jnp.repeat(centers, tile)


def _along(
    step: Callable[[_States, _States], _States],
    first: _States,
    splats: _States,
    *,
    reverse: bool = False,
) -> tuple[_States, _States]:
    """Compute the states between the splats of a chunk, one after the other.

    A loop, not `lax.associative_scan`: the order of its products and sums does not depend on where
    a chunk begins, and the compositors agree on it.

    Args:
      step: the next state from the one before and from a splat; all are tuples of `[B, P]`.
      first: the state in front of the first splat, or with `reverse` behind the last one.
      splats: tuple of arrays `[B, K, P]`.
      reverse: whether to go from the last splat to the first.

    Returns:
      The state after all splats, and arrays `[B, K + 1, P]` of the states in front of each splat
      and behind the last one.
    """
    count = splats[0].shape[1]

    def go(i: jax.Array, carry: tuple[_States, _States]) -> tuple[_States, _States]:
        k = count - 1 - i if reverse else i
        state, states = carry
        splat = (lax.dynamic_index_in_dim(each, k, 1, keepdims=False) for each in splats)
        state = step(state, tuple(splat))
        return state, _put(states, state, k if reverse else k + 1)

    shape = splats[0].shape[0], count + 1, splats[0].shape[2]
    states = tuple(jnp.zeros(shape, part.dtype) for part in first)
    return lax.fori_loop(0, count, go, (first, _put(states, first, count if reverse else 0)))


def _put(states: _States, state: _States, k: jax.Array | int) -> _States:
    """Write a state into the arrays of states, at splat `k`."""
    pairs = zip(states, state, strict=True)
    return tuple(lax.dynamic_update_index_in_dim(parts, part, k, 1) for parts, part in pairs)


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
    """State of the forward loop.

    Attributes:
      queue: of tiles.
      product: `[B, P]` product of 1 - alpha so far, also behind a finished pixel's last splat.
      walk: of the pixels of tiles at work.
      sums: so far, of the same pixels.
      ended: `[T + 1, C, P]` pixels of tiles whose lists have ended, see `pixel_rows`.
    """

    queue: _Queue
    product: jax.Array
    walk: Walk
    sums: Channels
    ended: jax.Array


def forward(
    plan: RasterPlan, table: jax.Array, lists: TileLists
) -> tuple[jax.Array, jax.Array, Trace]:
    """Compute the sums and the median of `blend_tiles`, and what `backward` needs besides."""
    features, tiles = table.shape[1] - PAYLOAD, lists.counts.shape[0]
    lanes, rows = _lanes(plan, tiles), pixel_rows(features)
    x, y = (at[None, None] for at in _pixels(plan.tile, table.dtype))
    of_tile = _with_none(lists)
    ones = jnp.ones((lanes, plan.tile**2), table.dtype)
    zeros = jnp.zeros_like(ones)
    fresh = Walk(ones, jnp.zeros(ones.shape, jnp.int32), zeros, zeros)

    def attenuate(product: _States, alpha: _States) -> _States:
        # It keeps falling once a pixel is finished, so the pixel stays finished.
        return (product[0] - alpha[0] * product[0],)

    def step(state: _ForwardState) -> _ForwardState:
        queue = state.queue
        here = of_tile.at(queue.tile)
        position = queue.step * plan.chunk
        splats = _chunk(table, lists.splats, here, position, plan.chunk)
        seen = shade(splats.column, x, y, plan.near)
        # A lane whose tile begins has the numbers of the tile before.
        begins = (queue.step == 0)[:, None]
        before = jnp.where(begins, 1, state.product)
        walk = jax.tree.map(lambda new, old: jnp.where(begins, new, old), fresh, state.walk)
        sums = jax.tree.map(lambda total: jnp.where(begins, 0, total), state.sums)
        (product,), (products,) = _along(attenuate, (before,), (seen.alpha,))
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
        return _ForwardState(_advance(queue, done), product, walk, sums, ended)

    # A tile without splats shows nothing, through all of the transmittance.
    ended = jnp.zeros((tiles + 1, rows.total, plan.tile**2), table.dtype)
    ended = ended.at[:, rows.transmittance].set(1)
    sums = Channels.of((zeros,) * (features + MOMENTS))
    state = _ForwardState(_begin(lists.counts, lanes), ones, fresh, sums, ended)
    state = lax.while_loop(lambda state: jnp.any(state.queue.tile < tiles), step, state)
    ended = state.ended[:-1]
    median, remaining = ended[:, rows.median], ended[:, rows.transmittance]
    stop, reference = ended[:, rows.stop], ended[:, rows.reference]
    return ended[:, rows.sums], median, Trace(remaining, stop.astype(jnp.int32), reference)


class _BackwardState(struct.PyTreeNode):
    """State of the backward loop.

    Attributes:
      queue: of tiles; its steps count chunks from the back.
      behind: `[B, P]` sum of weight times worth of the splats behind the chunk.
      after: `[B, P]` transmittance behind the chunk.
      table_bar: `[N, C]` cotangent so far.
    """

    queue: _Queue
    behind: jax.Array
    after: jax.Array
    table_bar: jax.Array


def backward(
    plan: RasterPlan,
    table: jax.Array,
    lists: TileLists,
    trace: Trace,
    cotangents: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """Compute the table's cotangent `[N, C]` from those of the sums and the median."""
    tiles = lists.counts.shape[0]
    lanes, chunk = _lanes(plan, tiles), max(plan.chunk, _FEWEST)
    grid = _grid(plan.tile, table.dtype)
    of_tile = _with_none(lists)
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
    # Splats behind the one that finished the last pixel count for nothing.
    counted = jnp.minimum(trace.stop.max(axis=-1), lists.counts)
    chunks = jnp.pad(-(-counted // chunk), (0, 1))

    def step(state: _BackwardState) -> _BackwardState:
        queue = state.queue
        left = chunks[queue.tile] - 1 - queue.step
        here = of_tile.at(queue.tile)
        position = jnp.maximum(left, 0) * chunk
        splats = _chunk(table, lists.splats, here, position, chunk)
        update, behind, after = _pull_chunk(plan, grid, splats, of_pixel[queue.tile], state)
        # The scatter adds a step's updates in their order, so gradients repeat to the last bit.
        table_bar = state.table_bar.at[splats.index.reshape(-1)].add(
            update.reshape(-1, table.shape[1])
        )
        return _BackwardState(_advance(queue, left <= 0), behind, after, table_bar)

    zeros = jnp.zeros((lanes, plan.tile**2), table.dtype)
    state = _BackwardState(_begin(chunks[:-1], lanes), zeros, zeros, jnp.zeros_like(table))
    state = lax.while_loop(lambda state: jnp.any(state.queue.tile < tiles), step, state)
    return state.table_bar


class _Grid(struct.PyTreeNode):
    """Pixels of a tile.

    Attributes:
      x: `[1, 1, P]` centers.
      y: the same.
      basis: `[P, 3]` of moments: 1, x and y about the middle of the tile.
    """

    x: jax.Array
    y: jax.Array
    basis: jax.Array


def _grid(tile: int, dtype: jnp.dtype) -> _Grid:
    pixels = _pixels(tile, dtype)
    x, y = (at[None, None] for at in pixels)
    # Moments about the middle of a tile lose the fewest digits.
    middle = tile / 2
    basis = jnp.stack([jnp.ones_like(pixels[0]), *(at - middle for at in pixels)], axis=1)
    return _Grid(x, y, basis)


def _pull_chunk(
    plan: RasterPlan, grid: _Grid, splats: _Chunk, pixels: jax.Array, state: _BackwardState
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

    def recede(state: _States, splat: _States) -> _States:
        behind, after = state
        alpha, passing, value = splat
        before = after * passing
        return behind + alpha * before * value, before

    begins = (state.queue.step == 0)[:, None]
    ends = jnp.where(begins, 0, state.behind), jnp.where(begins, remaining[:, 0], state.after)
    of_splats = alpha, 1 / (1 - alpha), value
    (behind, after), (worths, products) = _along(recede, ends, of_splats, reverse=True)
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
