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
_LARGE = 2**16  # room that is worth shortcuts


@struct.dataclass
class TileLists:
    """The lists of all `T` tiles, in row-major order.

    Attributes:
      splats: `[capacity]` indices of splats, tile after tile, each tile's nearest first.
      starts: `[T]` index into `splats` at which a tile's list starts.
      counts: `[T]` length of a tile's list.
      origins: `[T, 2]` x and y of a tile's first pixel.
      overflow: `[]` int32 number of pairs that did not fit, which are those of the farthest splats;
        `LARGEST` where the number of pairs may exceed int32.
    """

    splats: jax.Array
    starts: jax.Array
    counts: jax.Array
    origins: jax.Array
    overflow: jax.Array


def tile_lists(
    box: jax.Array,
    order: jax.Array,
    *,
    height: int,
    width: int,
    tile: int,
    capacity: int,
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
      reaches: says of `[P]` indices of splats and `[P, 2]` corners x, y of tiles, in pixels, which
        of these pairs are worth listing, `[P]` bool; None lists all.
    """
    chex.assert_shape(box, (order.shape[0], 4))
    count = order.shape[0]
    across, down = -(-width // tile), -(-height // tile)
    first, last = _tile_range(box, jnp.array([width, height]), tile)
    extent = jnp.maximum(last - first + 1, 0)
    pairs = extent[:, 0] * extent[:, 1]

    total = jnp.sum(pairs, dtype=jnp.int32)
    too_many = jnp.sum(pairs.astype(jnp.float32)) > LARGEST / 2  # int32 may have wrapped

    def sort(rows, room):
        touched = first, extent, order, reaches
        found = _sort(*touched, rows, room, tile=tile, across=across, down=down)
        fill = across * down, 0
        return tuple(
            jnp.pad(part, (0, capacity - room), constant_values=value)
            for part, value in zip(found, fill, strict=True)
        )

    # Sorting costs what there is room for; windows show few splats in few pairs.
    rooms = [(count, capacity)]
    if capacity >= _LARGE:
        rooms = [(max(count // 4, 1), capacity // 4), (count, capacity // 2), *rooms]
    after = jnp.max(jnp.where(pairs > 0, jnp.arange(count, dtype=jnp.int32), -1), initial=-1)
    fits = [(after < rows) & (total <= room) & ~too_many for rows, room in rooms[:-1]]
    branches = [functools.partial(sort, *room) for room in rooms]
    first_fit = jnp.argmax(jnp.stack([*fits, jnp.array(True)]))
    tile_of, splats = lax.switch(first_fit, branches)
    tiles = jnp.arange(across * down + 1, dtype=jnp.int32)
    starts = jnp.searchsorted(tile_of, tiles).astype(jnp.int32)
    tiles = tiles[:-1]
    return TileLists(
        splats=splats,
        starts=starts[:-1],
        counts=starts[1:] - starts[:-1],
        origins=tile * jnp.stack([tiles % across, tiles // across], axis=-1),
        overflow=jnp.where(too_many, LARGEST, jnp.maximum(total - capacity, 0)),
    )


def longest_first(counts: jax.Array) -> jax.Array:
    """Indices `[T]` of tiles by the length of their lists, of equal ones by index."""
    return jnp.argsort(-counts, stable=True).astype(jnp.int32)


def _sort(first, extent, order, reaches, rows, capacity, *, tile, across, down):
    """Sorted pairs `[capacity]` of the first `rows` splats: tiles and splats.

    Pairs are laid out by depth rank, so those of the farthest splats overflow. The tile is
    `across * down` past the last pair.
    """
    by_depth = _nearest_first(order[:rows])
    first, extent = first[by_depth], extent[by_depth]
    pairs, columns = extent[:, 0] * extent[:, 1], jnp.maximum(extent[:, 0], 1)
    ends = jnp.cumsum(pairs)
    place = jnp.arange(capacity, dtype=jnp.int32)
    ranks = jnp.arange(rows, dtype=jnp.int32)
    rank = jnp.repeat(ranks, pairs, total_repeat_length=capacity)
    within = place - (ends - pairs)[rank]
    down_by = within // columns[rank]
    row = first[rank, 1] + down_by
    column = first[rank, 0] + within - down_by * columns[rank]
    listed = place < ends[-1]
    if reaches is not None:
        listed &= reaches(by_depth[rank], tile * jnp.stack([column, row], axis=-1))
    tiles = across * down
    tile_of = jnp.where(listed, row * across + column, tiles)
    tile_of, rank = _sort_pairs(tile_of, rank, tiles + 1, rows)
    return tile_of, by_depth[rank]


def _tile_range(box: jax.Array, size: jax.Array, tile: int) -> tuple[jax.Array, jax.Array]:
    """First and last tile `[N, 2]` (x, y) with pixel centers in the box; last < first if none."""
    # Clip before the cast: a box may reach to infinity, which int32 cannot hold.
    edge = (size - 1).astype(box.dtype)[None]
    first = jnp.clip(jnp.ceil(box[:, :2] - 0.5), 0, edge + 1).astype(jnp.int32)
    last = jnp.clip(jnp.floor(box[:, 2:] - 0.5), -1, edge).astype(jnp.int32)
    empty = jnp.any(last < first, axis=-1, keepdims=True)
    return jnp.where(empty, 0, first // tile), jnp.where(empty, -1, last // tile)


def _nearest_first(order: jax.Array) -> jax.Array:
    """Indices `[N]` that sort a non-negative `order[N]`, ties by index.

    XLA's CPU backend sorts single integers several times faster than pairs. So float32 is sorted
    digit by digit, the last digit first; a digit and a position share one integer.
    """
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


def _sort_pairs(tile, rank, tiles: int, ranks: int):
    """Sort pairs by (tile, rank); one packed key sorts several times faster than two."""
    bits = max(ranks - 1, 1).bit_length()
    if tiles <= 2 ** (32 - bits):
        key = lax.sort((tile.astype(jnp.uint32) << bits) | rank.astype(jnp.uint32))
        return (key >> bits).astype(jnp.int32), (key & (2**bits - 1)).astype(jnp.int32)
    return tuple(lax.sort((tile, rank), num_keys=2))
