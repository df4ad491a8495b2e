"""The compositor in `jax.lax`, for every platform.

Tiles are sorted by the length of their lists and processed in blocks of `B`. A block processes its
lists in chunks of `K` splats and evaluates a chunk at all `P` pixels of its tiles at once, in
arrays `[K, B, P]`; only the products along a list are sequential. The derivative walks the same
chunks back to front, so memory is linear in pixels and pairs, and all sums have one fixed order.
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxcloseup.splats.kernel import (
    HOMOGRAPHY,
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
from jaxcloseup.splats.tiling import TileLists


_EXACT = lax.Precision.HIGHEST


def _column(rows):
    """Columns `[K, B, 1]` of gathered table rows `[K, B, C]`."""
    return lambda i: rows[:, :, i, None]


def _gather(table, lists: TileLists, tiles, position, chunk):
    """Table rows `[K, B, C]` of each tile's chunk, with local anchors, and splats `[K, B]`."""
    starts, counts, origins = tiles
    place = position + jnp.arange(chunk, dtype=jnp.int32)[:, None]
    inside = place < counts[None]
    # Past a list's end, take the splat at its start and give it opacity 0.
    index = lists.splats[starts[None] + jnp.where(inside, place, 0)]
    rows = table[index]
    anchor = rows[..., :HOMOGRAPHY] - origins[None].astype(table.dtype)
    opacity = jnp.where(inside, rows[..., OPACITY], 0)[..., None]
    rows = jnp.concatenate(
        [anchor, rows[..., HOMOGRAPHY:OPACITY], opacity, rows[..., OPACITY + 1 :]], axis=-1
    )
    return rows, index


def _pixels(tile: int, dtype) -> tuple[jax.Array, jax.Array]:
    """Pixel centers x and y `[P]` of a tile whose first corner is the origin."""
    centers = jnp.arange(tile, dtype=dtype) + 0.5
    return jnp.tile(centers, tile), jnp.repeat(centers, tile)


def forward(config, table: jax.Array, lists: TileLists) -> tuple[jax.Array, jax.Array, Trace]:
    """Sums and median of `blend_tiles`, and what `backward` needs besides."""
    features = table.shape[1] - PAYLOAD
    x, y = (at[None, None] for at in _pixels(config.tile, table.dtype))

    def attenuate(product, alpha):
        # The product keeps falling once a pixel is finished, so the pixel stays finished.
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
            position, product, walk, sums = state
            rows, _ = _gather(table, lists, tiles, position, config.chunk)
            seen = shade(_column(rows), x, y, config.near)
            before = product
            product, afters = lax.scan(attenuate, product, seen.alpha)
            weights = []
            for k in range(config.chunk):
                splat = seen.alpha[k], seen.inverse_depth[k], seen.z[k]
                weight, walk = pass_splat(walk, *splat, before, afters[k], position + k)
                weights.append(weight)
                before = afters[k]
            sums = tuple(
                total + sum(weights[k] * channel[k] for k in range(config.chunk))
                for total, channel in zip(
                    sums, channels(_column(rows), features, seen, walk.reference[None]), strict=True
                )
            )
            return position + config.chunk, product, walk, sums

        shape = (len(counts), config.tile**2)
        ones, zeros = jnp.ones(shape, table.dtype), jnp.zeros(shape, table.dtype)
        walk = Walk(ones, jnp.zeros(shape, jnp.int32), zeros, zeros)
        state = (jnp.int32(0), ones, walk, (zeros,) * (features + 4))
        _, _, walk, sums = lax.while_loop(unfinished, step, state)
        return jnp.stack(sums, axis=1), walk.median, Trace(*walk[:3])

    sums, median, trace = lax.map(block, (lists.starts, lists.counts, lists.origins))
    in_order = lambda tiles: tiles.reshape((-1, *tiles.shape[2:]))[lists.slot]  # noqa: E731
    return in_order(sums), in_order(median), trace


def backward(
    config,
    table: jax.Array,
    lists: TileLists,
    trace: Trace,
    cotangents: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """The table's cotangent `[N, C]` from those of the sums and the median."""
    pixels = _pixels(config.tile, table.dtype)
    x, y = (at[None, None] for at in pixels)
    # Moments about the middle of a tile lose the fewest digits.
    middle = config.tile / 2
    basis = jnp.stack([jnp.ones_like(pixels[0]), *(at - middle for at in pixels)], axis=1)

    def moments(values):
        sums = jnp.einsum("kbp,pm->kbm", values, basis, precision=_EXACT)
        return jnp.moveaxis(sums, -1, 0)

    cotangents = tuple(bar[lists.tile] for bar in cotangents)

    def recede(carry, splat):
        behind, after = carry
        alpha, passing, value = splat
        before = after * passing
        behind = behind + alpha * before * value
        return (behind, before), (behind, before)

    def block(table_bar, tiles):
        *tiles, (sums_bar, median_bar), trace = tiles
        each_bar = [sums_bar[None, :, i] for i in range(sums_bar.shape[1])]
        bars = (each_bar[-4], each_bar[-2], each_bar[-1], median_bar[None])
        here = jax.tree.map(lambda leaf: leaf[None], trace)

        def step(state):
            position, behind, after, table_bar = state
            rows, index = _gather(table, lists, tiles, position, config.chunk)
            seen = shade(_column(rows), x, y, config.near)
            place = position + jnp.arange(config.chunk, dtype=jnp.int32)[:, None, None]
            alpha = jnp.where(place < here.stop, seen.alpha, 0)
            value = worth(_column(rows), seen, here.reference, each_bar)
            ends = (behind, after)
            (behind, after), (behinds, before) = lax.scan(
                recede, ends, (alpha, 1 / (1 - alpha), value), reverse=True
            )
            # Shift by one: the state behind a splat is the state in front of the next one.
            behinds = jnp.concatenate([behinds[1:], ends[0][None]])
            afters = jnp.concatenate([before[1:], ends[1][None]])
            weight, pulled = pull_back(seen, alpha, before, afters, behinds, value, here, bars)
            payload = jnp.einsum("kbp,bfp->kbf", weight, sums_bar[:, :-4], precision=_EXACT)
            sums = pulled._replace(
                **{name: moments(getattr(pulled, name)) for name in ("u", "v", "w", "low_pass")},
                clip=pulled.clip.sum(-1),
                scaled=pulled.scaled.sum(-1),
            )
            columns = row_bar(lambda i: rows[..., i], middle, sums, [])
            update = jnp.concatenate([jnp.stack(columns, axis=-1), payload], axis=-1)
            table_bar = table_bar.at[index.reshape(-1)].add(update.reshape(-1, table.shape[1]))
            return position - config.chunk, behind, after, table_bar

        longest = jnp.minimum(trace.stop.max(), tiles[1].max())
        position = (longest - 1) // config.chunk * config.chunk
        state = (position, jnp.zeros_like(median_bar), trace.transmittance, table_bar)
        return lax.while_loop(lambda state: state[0] >= 0, step, state)[-1], None

    tiles = (lists.starts, lists.counts, lists.origins, cotangents, trace)
    return lax.scan(block, jnp.zeros_like(table), tiles)[0]
