"""The compositor in `jax.lax`, for every platform.

A step evaluates a chunk of `K` splats of each of `B` tiles at all `P` pixels of these tiles, in
arrays `[B, K, P]`; only the products along a list are sequential. A tile whose list has ended makes
way for the next one, longest lists first, so that nothing waits. The derivative walks the lists
back to front, so memory is linear in pixels and pairs, and all sums have one fixed order.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxcloseup.fields.splats.splat_math import (
    ANCHOR,
    OPACITY,
    PAYLOAD,
    TRANSMITTANCE_MIN,
    Trace,
    Walk,
    channels,
    pass_splat,
    pull_back,
    row_bar,
    shade,
    worth,
)
from jaxcloseup.fields.splats.tiling import TileLists, longest_first


_EXACT = lax.Precision.HIGHEST
_FEWEST = 16  # splats of a chunk of the derivative, which reads more for each chunk


class _Queue(NamedTuple):
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


def _lanes(config, tiles):
    """How many tiles are at work at once: few enough that short lists fill up behind long ones."""
    return min(config.block, -(-tiles // 4))


def _begin(counts, lanes):
    """The queue of all tiles `[T]` whose lists have entries."""
    tiles = counts.shape[0]
    order = longest_first(counts)
    order = jnp.where(counts[order] > 0, order, tiles)
    waiting = jnp.pad(order, (0, lanes), constant_values=tiles)
    return _Queue(waiting, jnp.int32(lanes), waiting[:lanes], jnp.zeros(lanes, jnp.int32))


def _advance(queue, done):
    """The queue after a step, in which the tiles `done[B]` ended."""
    lanes = jnp.arange(done.shape[0])
    earlier = done[None] & (lanes[None] < lanes[:, None])
    place = queue.next + jnp.sum(earlier, axis=1, dtype=jnp.int32)
    place = jnp.minimum(place, queue.waiting.shape[0] - 1)
    return queue._replace(
        next=queue.next + jnp.sum(done, dtype=jnp.int32),
        tile=jnp.where(done, queue.waiting[place], queue.tile),
        step=jnp.where(done, 0, queue.step + 1),
    )


class _Chunk(NamedTuple):
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
        """A column `[B, K, 1]`; anchors are local to the tiles, and opacity ends with the lists."""
        value = self.rows[:, :, i]
        if i in (ANCHOR, ANCHOR + 1):
            value = value - self.origins[:, None, i - ANCHOR].astype(value.dtype)
        elif i == OPACITY:
            value = jnp.where(self.inside, value, 0)
        return value[..., None]


def _chunk(table, splats, tiles, position, size):
    """The chunk of `size` splats at `position[B]` of each tile's list."""
    starts, counts, origins = tiles
    place = position[:, None] + jnp.arange(size, dtype=jnp.int32)[None]
    inside = place < counts[:, None]
    # Past a list's end, take the splat at its start.
    index = splats[starts[:, None] + jnp.where(inside, place, 0)]
    return _Chunk(table[index], index, place, inside, origins)


def _pixels(tile: int, dtype) -> tuple[jax.Array, jax.Array]:
    """Pixel centers x and y `[P]` of a tile whose first corner is the origin."""
    centers = jnp.arange(tile, dtype=dtype) + 0.5
    return jnp.tile(centers, tile), jnp.repeat(centers, tile)


def _along(step, first, splats, *, reverse=False):
    """The states between the splats of a chunk, one after the other.

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

    def go(i, carry):
        k = count - 1 - i if reverse else i
        state, states = carry
        splat = (lax.dynamic_index_in_dim(each, k, 1, keepdims=False) for each in splats)
        state = step(state, tuple(splat))
        return state, _put(states, state, k if reverse else k + 1)

    shape = splats[0].shape[0], count + 1, splats[0].shape[2]
    states = tuple(jnp.zeros(shape, part.dtype) for part in first)
    return lax.fori_loop(0, count, go, (first, _put(states, first, count if reverse else 0)))


def _put(states, state, k):
    pairs = zip(states, state, strict=True)
    return tuple(lax.dynamic_update_index_in_dim(parts, part, k, 1) for parts, part in pairs)


def _pass_chunk(walk, seen, products, place):
    """Weights `[B, P]` of each of a chunk's splats, and the walk behind them."""
    weights = []
    for k in range(place.shape[1]):
        splat = seen.alpha[:, k], seen.inverse_depth[:, k], seen.z[:, k]
        around = products[:, k], products[:, k + 1]
        weight, walk = pass_splat(walk, *splat, *around, place[:, k])
        weights.append(weight)
    return weights, walk


def _with_none(lists: TileLists):
    """Starts, counts and origins of all tiles, and of none: an empty list."""
    return tuple(
        jnp.pad(leaf, ((0, 1),) + ((0, 0),) * (leaf.ndim - 1))
        for leaf in (lists.starts, lists.counts, lists.origins)
    )


def forward(config, table: jax.Array, lists: TileLists) -> tuple[jax.Array, jax.Array, Trace]:
    """Sums and median of `blend_tiles`, and what `backward` needs besides."""
    features, tiles = table.shape[1] - PAYLOAD, lists.counts.shape[0]
    lanes = _lanes(config, tiles)
    x, y = (at[None, None] for at in _pixels(config.tile, table.dtype))
    of_tile = _with_none(lists)
    ones = jnp.ones((lanes, config.tile**2), table.dtype)
    zeros = jnp.zeros_like(ones)
    fresh = Walk(ones, jnp.zeros(ones.shape, jnp.int32), zeros, zeros)

    def attenuate(product, alpha):
        # It keeps falling once a pixel is finished, so the pixel stays finished.
        return (product[0] - alpha[0] * product[0],)

    def step(state):
        queue, product, walk, sums, ended = state
        here = tuple(leaf[queue.tile] for leaf in of_tile)
        position = queue.step * config.chunk
        splats = _chunk(table, lists.splats, here, position, config.chunk)
        seen = shade(splats.column, x, y, config.near)
        begins = (queue.step == 0)[:, None]
        before = jnp.where(begins, 1, product)
        walk = jax.tree.map(lambda new, old: jnp.where(begins, new, old), fresh, walk)
        sums = tuple(jnp.where(begins, 0, total) for total in sums)
        (product,), (products,) = _along(attenuate, (before,), (seen.alpha,))
        weights, walk = _pass_chunk(walk, seen, products, splats.place[..., None])
        weights = lax.optimization_barrier(weights)
        found = channels(splats.column, features, seen, walk.reference[:, None])
        sums = tuple(
            total + sum(weights[k] * channel[:, k] for k in range(config.chunk))
            for total, channel in zip(sums, found, strict=True)
        )
        finished = jnp.max(product, axis=-1) < TRANSMITTANCE_MIN
        done = finished | (position + config.chunk >= here[1])
        stop = walk.stop.astype(table.dtype)
        rest = jnp.stack([walk.median, walk.remaining, stop, walk.reference], axis=1)
        found = jnp.concatenate([jnp.stack(sums, axis=1), rest], axis=1)
        ended = ended.at[jnp.where(done, queue.tile, tiles)].set(found)
        return _advance(queue, done), product, walk, sums, ended

    # What a tile without splats shows.
    ended = jnp.zeros((tiles + 1, features + 8, config.tile**2), table.dtype)
    ended = ended.at[:, features + 5].set(1)
    sums = (zeros,) * (features + 4)
    state = (_begin(lists.counts, lanes), ones, fresh, sums, ended)
    ended = lax.while_loop(lambda state: jnp.any(state[0].tile < tiles), step, state)[-1][:-1]
    median, remaining, stop, reference = (ended[:, features + 4 + i] for i in range(4))
    return ended[:, : features + 4], median, Trace(remaining, stop.astype(jnp.int32), reference)


def backward(
    config,
    table: jax.Array,
    lists: TileLists,
    trace: Trace,
    cotangents: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """The table's cotangent `[N, C]` from those of the sums and the median."""
    tiles = lists.counts.shape[0]
    lanes, chunk = _lanes(config, tiles), max(config.chunk, _FEWEST)
    pixels = _pixels(config.tile, table.dtype)
    x, y = (at[None, None] for at in pixels)
    # Moments about the middle of a tile lose the fewest digits.
    middle = config.tile / 2
    basis = jnp.stack([jnp.ones_like(pixels[0]), *(at - middle for at in pixels)], axis=1)

    def moments(values):
        sums = jnp.einsum("bkp,pm->bkm", values, basis, precision=_EXACT)
        return jnp.moveaxis(sums, -1, 0)

    def recede(state, splat):
        behind, after = state
        alpha, passing, value = splat
        before = after * passing
        return behind + alpha * before * value, before

    of_tile = _with_none(lists)
    sums_bar, median_bar = cotangents
    of_pixel = jnp.concatenate(
        [sums_bar, median_bar[:, None], *(leaf[:, None].astype(table.dtype) for leaf in trace)],
        axis=1,
    )
    of_pixel = jnp.pad(of_pixel, ((0, 1), (0, 0), (0, 0)))
    # Splats behind the one that finished the last pixel count for nothing.
    counted = jnp.minimum(trace.stop.max(axis=-1), lists.counts)
    chunks = jnp.pad(-(-counted // chunk), (0, 1))

    def step(state):
        queue, behind, after, table_bar = state
        left = chunks[queue.tile] - 1 - queue.step
        here = tuple(leaf[queue.tile] for leaf in of_tile)
        position = jnp.maximum(left, 0) * chunk
        splats = _chunk(table, lists.splats, here, position, chunk)
        found = of_pixel[queue.tile]
        *each_bar, median_bar, remaining, stop, reference = (
            found[:, i, None] for i in range(found.shape[1])
        )
        trace = Trace(remaining, stop.astype(jnp.int32), reference)
        bars = (each_bar[-4], each_bar[-2], each_bar[-1], median_bar)
        seen = shade(splats.column, x, y, config.near)
        alpha = jnp.where(splats.place[..., None] < trace.stop, seen.alpha, 0)
        value = worth(splats.column, seen, reference, each_bar)
        begins = (queue.step == 0)[:, None]
        ends = (jnp.where(begins, 0, behind), jnp.where(begins, remaining[:, 0], after))
        of_splats = alpha, 1 / (1 - alpha), value
        (behind, after), (worths, products) = _along(recede, ends, of_splats, reverse=True)
        around = products[:, :-1], products[:, 1:], worths[:, 1:]
        weight, pulled = pull_back(seen, alpha, *around, value, trace, bars)
        payload = jnp.einsum(
            "bkp,bfp->bkf", weight, found[:, : len(each_bar) - 4], precision=_EXACT
        )
        sums = pulled._replace(
            **{name: moments(getattr(pulled, name)) for name in ("u", "v", "w", "low_pass")},
            clip=pulled.clip.sum(-1),
            scaled=pulled.scaled.sum(-1),
        )
        columns = row_bar(lambda i: splats.column(i)[..., 0], middle, sums, [])
        update = jnp.concatenate([jnp.stack(columns, axis=-1), payload], axis=-1)
        table_bar = table_bar.at[splats.index.reshape(-1)].add(update.reshape(-1, table.shape[1]))
        return _advance(queue, left <= 0), behind, after, table_bar

    zeros = jnp.zeros((lanes, config.tile**2), table.dtype)
    state = (_begin(chunks[:-1], lanes), zeros, zeros, jnp.zeros_like(table))
    return lax.while_loop(lambda state: jnp.any(state[0].tile < tiles), step, state)[-1]
