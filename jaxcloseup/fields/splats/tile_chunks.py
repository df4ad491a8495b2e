"""Tiles at work side by side, and chunks of their lists: what `blend_lax` computes, and when."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax

from jaxcloseup.fields.splats.config import RasterPlan
from jaxcloseup.fields.splats.layout import ANCHOR, OPACITY
from jaxcloseup.fields.splats.tiling import TileLists, longest_first


# Quantities of a splat at the pixels of tiles `[B, P]`, in tuples.
States = tuple[jax.Array, ...]


class Queue(struct.PyTreeNode):
    """The tiles at work, and the tiles that wait."""

    waiting: jax.Array  # `[T + B]` tiles in the order in which they begin; `T` ends them
    next: jax.Array  # `[]` index into `waiting` of the next tile
    tile: jax.Array  # `[B]` tiles at work, `T` where there is none
    step: jax.Array  # `[B]` chunks that each of these tiles has finished


def lanes_of(plan: RasterPlan, tiles: int) -> int:
    """Return how many tiles are at work at once."""
    # Few enough that short lists fill up behind long ones.
    return min(plan.block, -(-tiles // 4))


def begin(counts: jax.Array, lanes: int) -> Queue:
    """Return the queue of all tiles `[T]` whose lists have entries."""
    tiles = counts.shape[0]
    order = longest_first(counts)
    order = jnp.where(counts[order] > 0, order, tiles)
    waiting = jnp.pad(order, (0, lanes), constant_values=tiles)
    return Queue(waiting, jnp.int32(lanes), waiting[:lanes], jnp.zeros(lanes, jnp.int32))


def advance(queue: Queue, done: jax.Array) -> Queue:
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


class Tiles(struct.PyTreeNode):
    """Where the lists of tiles lie, and where the tiles: of `T` tiles and none, or `B` at work."""

    starts: jax.Array
    counts: jax.Array
    origins: jax.Array

    def at(self, tile: jax.Array) -> "Tiles":
        """Return these of the tiles `[B]`."""
        return Tiles(self.starts[tile], self.counts[tile], self.origins[tile])


def with_none(lists: TileLists) -> Tiles:
    """Return all tiles and, last, none: an empty list, which idle lanes walk."""
    return Tiles(
        starts=jnp.pad(lists.starts, (0, 1)),
        counts=jnp.pad(lists.counts, (0, 1)),
        origins=jnp.pad(lists.origins, ((0, 1), (0, 0))),
    )


class Chunk(struct.PyTreeNode):
    """Splats `[B, K]` at the places of a chunk in their tiles' lists."""

    rows: jax.Array  # `[B, K, C]` rows of the table
    index: jax.Array  # `[B, K]` indices of the splats in the table
    place: jax.Array  # `[B, K]` positions in the tiles' lists
    inside: jax.Array  # `[B, K]` bool, False past a list's end
    origins: jax.Array  # `[B, 2]` first pixels of the tiles

    def column(self, i: int) -> jax.Array:
        """Return a column `[B, K, 1]`; anchors are local to tiles, and opacity ends with lists."""
        value = self.rows[:, :, i]
        if i in (ANCHOR, ANCHOR + 1):
            # Small differences from here on: pixels of a large image would cost float32 its digits.
            value = value - self.origins[:, None, i - ANCHOR].astype(value.dtype)
        elif i == OPACITY:
            value = jnp.where(self.inside, value, 0)
        return value[..., None]


def chunk_at(
    table: jax.Array, splats: jax.Array, tiles: Tiles, position: jax.Array, size: int
) -> Chunk:
    """Return the chunk of `size` splats at `position[B]` of each tile's list."""
    place = position[:, None] + jnp.arange(size, dtype=jnp.int32)[None]
    inside = place < tiles.counts[:, None]
    # Past a list's end, take the splat at its start.
    index = splats[tiles.starts[:, None] + jnp.where(inside, place, 0)]
    return Chunk(table[index], index, place, inside, tiles.origins)


def pixels_of(tile: int, dtype: jnp.dtype) -> tuple[jax.Array, jax.Array]:
    """Return pixel centers x and y `[P]` of a tile whose first corner is the origin."""
    centers = jnp.arange(tile, dtype=dtype) + 0.5
    return jnp.tile(centers, tile), jnp.repeat(centers, tile)


def along(
    step: Callable[[States, States], States],
    first: States,
    splats: States,
    *,
    reverse: bool = False,
) -> tuple[States, States]:
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

    def go(i: jax.Array, carry: tuple[States, States]) -> tuple[States, States]:
        k = count - 1 - i if reverse else i
        state, states = carry
        splat = (lax.dynamic_index_in_dim(each, k, 1, keepdims=False) for each in splats)
        state = step(state, tuple(splat))
        return state, _put(states, state, k if reverse else k + 1)

    shape = splats[0].shape[0], count + 1, splats[0].shape[2]
    states = tuple(jnp.zeros(shape, part.dtype) for part in first)
    return lax.fori_loop(0, count, go, (first, _put(states, first, count if reverse else 0)))


def _put(states: States, state: States, k: jax.Array | int) -> States:
    """Write a state into the arrays of states, at splat `k`."""
    pairs = zip(states, state, strict=True)
    return tuple(lax.dynamic_update_index_in_dim(parts, part, k, 1) for parts, part in pairs)
