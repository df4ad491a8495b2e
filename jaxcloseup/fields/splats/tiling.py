"""Lists of the splats that touch each tile, nearest first, as sorted (tile, splat) pairs.

Tiles are squares of pixels in row-major order. The number of pairs is static; pairs that do not fit
are left out and counted.
"""

import functools
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import lax


LARGEST = 2**31 - 1
_Carried = tuple[jax.Array, tuple[jax.Array, jax.Array]]  # a rank, and tiles and ranks
_LARGE = 2**16  # room for pairs that is worth shortcuts
_FEW = 2**12  # splats that are worth a shortcut


class TileLists(struct.PyTreeNode):
    """The lists of all `T` tiles, in row-major order."""

    splats: jax.Array  # `[capacity]` indices of splats, tile after tile, each tile's nearest first
    starts: jax.Array  # `[T]` index into `splats` at which a tile's list starts
    counts: jax.Array  # `[T]` length of a tile's list
    origins: jax.Array  # `[T, 2]` x and y of a tile's first pixel
    # `[]` int32 number of pairs that did not fit, always the farthest splats; `LARGEST` where the
    # number of pairs may exceed int32
    overflow: jax.Array


def tile_lists(
    box: jax.Array,
    order: jax.Array,
    *,
    height: int,
    width: int,
    tile: int,
    capacity: int,
    at_once: int | None = None,
    reaches: Callable[[jax.Array, jax.Array], jax.Array] | None = None,
) -> TileLists:
    """Sort (tile, splat) pairs by tile, then by `order[N]`, then by index.

    Args:
      box: `[N, 4]` bounds (x0, y0, x1, y1) in pixels of each splat. A tile lists the splats whose
        box holds one of its pixel *centers*; a box with x1 < x0 or y1 < y0 is empty.
      order: `[N]` depth of each splat, not negative.
      height: image height in pixels; static.
      width: image width in pixels; static.
      tile: side of a tile in pixels; static.
      capacity: largest number of pairs of splats and tiles that their boxes touch; static.
      at_once: largest number of pairs that are made before the next ones, so that a CPU keeps their
        data in its cache; static. None makes all at once.
      reaches: `(splats[P], corners[P, 2]) -> [P]` bool, True where a pair of a splat's index and a
        tile's corner x, y, in pixels, is worth listing; None lists all.
    """
    chex.assert_shape(box, (order.shape[0], 4))
    across, down = -(-width // tile), -(-height // tile)
    first, last = _tile_range(box, jnp.array([width, height]), tile)
    extent = jnp.maximum(last - first + 1, 0)
    pairs = extent[:, 0] * extent[:, 1]

    # Pairs of boxes, of which `reaches` may drop some: the room is static, so it must hold these.
    total = jnp.sum(pairs, dtype=jnp.int32)
    too_many = jnp.sum(pairs.astype(jnp.float32)) > LARGEST / 2  # int32 may have wrapped

    # Splats are sorted by depth first: a pair's key is then a tile and a rank, both small integers.
    by_depth = _nearest_first_shown(order, pairs)
    tile_of, rank = _touched_tiles(
        first[by_depth],
        extent[by_depth],
        by_depth,
        reaches,
        tile=tile,
        across=across,
        down=down,
        capacity=capacity,
        at_once=min(capacity, at_once or capacity),
    )
    starts, splats = _sorted_pairs(tile_of, rank, by_depth, total, across * down)
    tiles = jnp.arange(across * down, dtype=jnp.int32)
    return TileLists(
        splats=splats,
        starts=starts[:-1],
        counts=starts[1:] - starts[:-1],
        origins=tile * jnp.stack([tiles % across, tiles // across], axis=-1),
        overflow=jnp.where(too_many, LARGEST, jnp.maximum(total - capacity, 0)),
    )


def longest_first(counts: jax.Array) -> jax.Array:
    """Return indices `[T]` of tiles by the length of their lists, of equal ones by index."""
    return jnp.argsort(-counts, stable=True).astype(jnp.int32)


def starts_of(ordered: jax.Array, count: int) -> jax.Array:
    """Return where each number 0 to `count` begins, `[count + 1]`, in ascending int32 `[P]`."""
    # Unrolled, for a GPU starts each step of a loop anew.
    numbers = jnp.arange(count + 1, dtype=jnp.int32)
    return jnp.searchsorted(ordered, numbers, method="scan_unrolled").astype(jnp.int32)


def _nearest_first_shown(order: jax.Array, pairs: jax.Array) -> jax.Array:
    """Return indices `[N]` of splats, the nearest first as far as these have pairs `[N]`."""
    count = order.shape[0]
    few = count // 4
    if few < _FEW:
        return _nearest_first(order)
    # Where a window leaves out many splats, visible ones come first: sort only the head.
    index = jnp.arange(count, dtype=jnp.int32)
    after = jnp.max(jnp.where(pairs > 0, index, -1), initial=-1)  # the last splat that shows

    def sort_few() -> jax.Array:
        return jnp.concatenate([_nearest_first(order[:few]), index[few:]])

    return lax.cond(after < few, sort_few, lambda: _nearest_first(order))


def _touched_tiles(
    first: jax.Array,
    extent: jax.Array,
    splats: jax.Array,
    reaches: Callable[[jax.Array, jax.Array], jax.Array] | None,
    *,
    tile: int,
    across: int,
    down: int,
    capacity: int,
    at_once: int,
) -> tuple[jax.Array, jax.Array]:
    """Return tiles `[capacity]` of the pairs of splats, which are in order of depth, and ranks.

    Pairs are laid out by rank, so those of the farthest splats overflow. The tile is
    `across * down` where there is no pair, or nothing worth listing.
    """
    pairs, columns = extent[:, 0] * extent[:, 1], jnp.maximum(extent[:, 0], 1)
    ends = jnp.cumsum(pairs)
    begins = ends - pairs
    tiles = across * down
    size, steps = at_once, -(-capacity // at_once)
    # How many splats' pairs end in front of each pair: sums along this are the pairs' ranks.
    ended = jnp.zeros(steps * size, jnp.int32).at[ends].add(1, mode="drop").reshape(steps, size)

    def find(rank: jax.Array, step: tuple[jax.Array, jax.Array]) -> _Carried:
        ended, place = step

        def some() -> _Carried:
            ranks = rank + jnp.cumsum(ended)
            places = place + jnp.arange(size, dtype=jnp.int32)
            listed = places < ends[-1]
            # Which tile of the splat's box, row by row.
            within = places - begins[ranks]
            down_by = within // columns[ranks]
            row = first[ranks, 1] + down_by
            column = first[ranks, 0] + within - down_by * columns[ranks]
            if reaches is not None:
                corner = tile * jnp.stack([column, row], axis=-1)
                listed &= reaches(splats[ranks], corner)
            return ranks[-1], (jnp.where(listed, row * across + column, tiles), ranks)

        def none() -> _Carried:
            return rank, (jnp.full(size, tiles, jnp.int32), jnp.zeros(size, jnp.int32))

        return lax.cond(place < ends[-1], some, none)

    # One block of pairs after the other: the rank at a block's end is where the next one begins.
    starts = size * jnp.arange(steps, dtype=jnp.int32)
    _, (tile_of, ranks) = lax.scan(find, jnp.int32(0), (ended, starts))
    return tile_of.reshape(-1)[:capacity], ranks.reshape(-1)[:capacity]


def _sorted_pairs(
    tile_of: jax.Array, rank: jax.Array, by_depth: jax.Array, total: jax.Array, tiles: int
) -> tuple[jax.Array, jax.Array]:
    """Return where each tile's pairs start, `[T + 1]`, and splats `[capacity]` by tile and rank."""
    capacity = tile_of.shape[0]
    # Sorting costs what there is room for; windows show few splats in few pairs.
    eighths = (1, 1.5, 2, 3, 4, 6) if capacity >= _LARGE else ()
    rooms = [int(capacity * part / 8) for part in eighths] + [capacity]

    def sort(room: int) -> tuple[jax.Array, jax.Array]:
        ordered, ranks = _sort_pairs(tile_of[:room], rank[:room], tiles + 1, len(by_depth))
        return starts_of(ordered, tiles), jnp.pad(by_depth[ranks], (0, capacity - room))

    # The first room that holds all pairs; the last one holds what fits.
    smallest = jnp.argmax(jnp.stack([total <= room for room in rooms[:-1]] + [jnp.array(True)]))
    return lax.switch(smallest, [functools.partial(sort, room) for room in rooms])


def _tile_range(box: jax.Array, size: jax.Array, tile: int) -> tuple[jax.Array, jax.Array]:
    """Return the first and last tile `[N, 2]` with pixel centers in boxes; last < first if none."""
    # Clip before the cast: a box may reach to infinity, which int32 cannot hold.
    edge = (size - 1).astype(box.dtype)[None]
    first = jnp.clip(jnp.ceil(box[:, :2] - 0.5), 0, edge + 1).astype(jnp.int32)
    last = jnp.clip(jnp.floor(box[:, 2:] - 0.5), -1, edge).astype(jnp.int32)
    empty = jnp.any(last < first, axis=-1, keepdims=True)
    return jnp.where(empty, 0, first // tile), jnp.where(empty, -1, last // tile)


def _nearest_first(order: jax.Array) -> jax.Array:
    """Return indices `[N]` that sort a non-negative `order[N]`, ties by index."""
    # XLA's CPU backend sorts single integers several times faster than pairs. So float32 is sorted
    # digit by digit, the last digit first; a digit and a position share one integer. The bits of
    # floats that are not negative rise with the floats.
    count = order.shape[0]
    place = jnp.arange(count, dtype=jnp.uint32)
    if order.dtype != jnp.float32:
        return lax.sort((order, place.astype(jnp.int32)), num_keys=1, is_stable=True)[1]
    width = max(count - 1, 1).bit_length()
    keys = lax.bitcast_convert_type(order, jnp.uint32)
    by_key = place
    for shift in range(0, 32, 32 - width):
        digit = (keys[by_key] >> shift) << width  # the shift drops higher digits
        by_key = by_key[lax.sort(digit | place) & (2**width - 1)]
    return by_key.astype(jnp.int32)


def _sort_pairs(
    tile: jax.Array, rank: jax.Array, tiles: int, ranks: int
) -> tuple[jax.Array, jax.Array]:
    """Sort pairs by (tile, rank)."""
    # One packed key sorts several times faster than two.
    bits = max(ranks - 1, 1).bit_length()
    if tiles <= 2 ** (32 - bits):
        key = lax.sort((tile.astype(jnp.uint32) << bits) | rank.astype(jnp.uint32))
        return (key >> bits).astype(jnp.int32), (key & (2**bits - 1)).astype(jnp.int32)
    tile, rank = lax.sort((tile, rank), num_keys=2)
    return tile, rank
