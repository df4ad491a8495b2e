"""The compositor as Pallas kernels, for GPUs: one program a tile, one splat after another.

Each program walks its tile's list as the loops of `loops` do, with all pixels of the tile at once.
The derivative has no atomic additions, so it repeats to the last bit: a program writes the
cotangent of each of its pairs to a place of its own, and a second kernel adds up those of each
splat, always in the same order.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxcloseup.fields.splats.splat_math import (
    ANCHOR,
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
from jaxcloseup.fields.splats.tiling import TileLists, longest_first, starts_of


_TILE = plgpu.CompilerParams(num_warps=2)


def forward(
    config, table: jax.Array, lists: TileLists, *, interpret: bool = False
) -> tuple[jax.Array, jax.Array, Trace]:
    """`loops.forward`; with `interpret`, on any platform, slowly."""
    features, pixels = table.shape[1] - PAYLOAD, config.tile**2
    tiles, dtype = lists.starts.shape[0], table.dtype
    order = longest_first(lists.counts)
    each = pl.BlockSpec((1, pixels), lambda i: (i, 0))
    values = jax.ShapeDtypeStruct((tiles, pixels), dtype)
    sums, median, *trace = pl.pallas_call(
        functools.partial(_forward_tile, config, features),
        grid=tiles,
        out_specs=[pl.BlockSpec((1, features + 4, pixels), lambda i: (i, 0, 0)), *[each] * 4],
        out_shape=[
            jax.ShapeDtypeStruct((tiles, features + 4, pixels), dtype),
            values,
            values,
            jax.ShapeDtypeStruct((tiles, pixels), jnp.int32),
            values,
        ],
        interpret=interpret,
        compiler_params=_TILE,
    )(table, *_in_turn(lists, order))
    place = jnp.argsort(order)
    sums, median, *trace = (leaf[place] for leaf in (sums, median, *trace))
    return sums, median, Trace(*trace)


def backward(
    config,
    table: jax.Array,
    lists: TileLists,
    trace: Trace,
    cotangents: tuple[jax.Array, jax.Array],
    *,
    interpret: bool = False,
) -> jax.Array:
    """`loops.backward`; with `interpret`, on any platform, slowly."""
    features, pixels = table.shape[1] - PAYLOAD, config.tile**2
    tiles, capacity = lists.starts.shape[0], lists.splats.shape[0]
    order = longest_first(lists.counts)
    (sums_bar, median_bar), trace = jax.tree.map(lambda leaf: leaf[order], (cotangents, trace))
    in_turn = _in_turn(lists, order)
    each = pl.BlockSpec((1, pixels), lambda i: (i, 0))
    whole = [pl.BlockSpec(a.shape, lambda i, n=a.ndim: (0,) * n) for a in (table, *in_turn)]
    pairs_bar = pl.pallas_call(
        functools.partial(_backward_tile, config, features),
        grid=tiles,
        in_specs=[
            *whole,
            *[each] * 3,
            pl.BlockSpec((1, features + 4, pixels), lambda i: (i, 0, 0)),
            each,
        ],
        out_shape=jax.ShapeDtypeStruct((capacity, table.shape[1]), table.dtype),
        interpret=interpret,
        compiler_params=_TILE,
    )(table, *in_turn, *trace, sums_bar, median_bar)
    return _add_pairs(pairs_bar, lists, table.shape[0], interpret)


def _in_turn(lists, order):
    """Lists in an order of tiles, longest first, so that long lists begin first."""
    return lists.splats, lists.starts[order], lists.counts[order], lists.origins[order]


def _pixels(tile: int, dtype: Any) -> tuple[jax.Array, jax.Array]:
    place = jnp.arange(tile * tile, dtype=jnp.int32)
    return tuple(part(place, jnp.int32(tile)).astype(dtype) + 0.5 for part in (lax.rem, lax.div))


def _column(table, splat, origin):
    """Columns `[]` of a splat's row, whose anchor is made local to the tile."""

    def column(i):
        value = table[splat, i]
        return value - origin[i] if i in (ANCHOR, ANCHOR + 1) else value

    return column


def _forward_tile(config, features, *refs):
    table, splats, starts, counts, origins, *out = refs
    sums_out, median_out, transmittance_out, stop_out, reference_out = out
    i, dtype = pl.program_id(0), table.dtype
    start, count = starts[i], counts[i]
    origin = [origins[i, axis].astype(dtype) for axis in range(2)]
    x, y = _pixels(config.tile, dtype)

    def unfinished(state):
        position, product = state[:2]
        return (position < count) & (jnp.max(product) >= TRANSMITTANCE_MIN)

    def step(state):
        position, before, walk, sums = state
        column = _column(table, splats[start + position], origin)
        seen = shade(column, x, y, config.near)
        after = before - seen.alpha * before
        weight, walk = pass_splat(
            walk, seen.alpha, seen.inverse_depth, seen.z, before, after, position
        )
        new = channels(column, features, seen, walk.reference)
        sums = tuple(total + weight * value for total, value in zip(sums, new, strict=True))
        return position + 1, after, walk, sums

    ones, zeros = jnp.ones_like(x), jnp.zeros_like(x)
    walk = Walk(ones, jnp.zeros(x.shape, jnp.int32), zeros, zeros)
    state = (jnp.int32(0), ones, walk, (zeros,) * (features + 4))
    _, _, walk, sums = lax.while_loop(unfinished, step, state)
    for channel, total in enumerate(sums):
        sums_out[0, channel] = total
    median_out[0] = walk.median
    transmittance_out[0], stop_out[0], reference_out[0] = walk[:3]


def _backward_tile(config, features, *refs):
    table, splats, starts, counts, origins, *trace, sums_bar, median_bar, pairs_bar = refs
    i, dtype = pl.program_id(0), table.dtype
    start, count = starts[i], counts[i]
    origin = [origins[i, axis].astype(dtype) for axis in range(2)]
    x, y = _pixels(config.tile, dtype)
    middle = config.tile / 2
    trace = Trace(*(leaf[0] for leaf in trace))
    each_bar = [sums_bar[0, channel] for channel in range(features + 4)]
    bars = (each_bar[-4], each_bar[-2], each_bar[-1], median_bar[0])

    def moments(values):
        return tuple(jnp.sum(values * by) for by in (jnp.ones_like(x), x - middle, y - middle))

    def step(state):
        position, behind, after = state
        column = _column(table, splats[start + position], origin)
        seen = shade(column, x, y, config.near)
        alpha = jnp.where(position < trace.stop, seen.alpha, 0)
        value = worth(column, seen, trace.reference, each_bar)
        before = after * (1 / (1 - alpha))
        weight, pulled = pull_back(seen, alpha, before, after, behind, value, trace, bars)
        sums = pulled._replace(
            **{name: moments(getattr(pulled, name)) for name in ("u", "v", "w", "low_pass")},
            clip=jnp.sum(pulled.clip),
            scaled=jnp.sum(pulled.scaled),
        )
        payload = [jnp.sum(weight * each_bar[f]) for f in range(features)]
        for c, bar in enumerate(row_bar(column, middle, sums, payload)):
            pairs_bar[start + position, c] = bar
        return position - 1, behind + weight * value, before

    def blank(position):
        for c in range(PAYLOAD + features):
            pairs_bar[start + position, c] = jnp.zeros((), dtype)
        return position + 1

    # Pairs behind the last one that counts have no cotangent.
    longest = jnp.minimum(jnp.max(trace.stop), count)
    lax.while_loop(lambda position: position < count, blank, longest)
    state = (longest - 1, jnp.zeros_like(x), trace.transmittance)
    lax.while_loop(lambda state: state[0] >= 0, step, state)


def _add_pairs(pairs_bar, lists, count, interpret):
    """Sums `[N, C]` of the pairs' cotangents, splat by splat."""
    capacity = lists.splats.shape[0]
    begins, ends = lists.starts, lists.starts + lists.counts
    changes = jnp.zeros(capacity + 1, jnp.int32).at[begins].add(1).at[ends].add(-1)
    listed = jnp.cumsum(changes[:-1]) > 0
    place = jnp.arange(capacity, dtype=jnp.int32)
    owner, pair = lax.sort((jnp.where(listed, lists.splats, count), place), num_keys=1)
    bounds = starts_of(owner, count)

    def add(pairs_bar, pair, bounds, out):
        i = pl.program_id(0)

        def step(state):
            position, sums = state
            row = [pairs_bar[pair[position], c] for c in range(out.shape[1])]
            return position + 1, tuple(a + b for a, b in zip(sums, row, strict=True))

        zeros = (jnp.zeros((), out.dtype),) * out.shape[1]
        end = bounds[i + 1]
        state = lax.while_loop(lambda state: state[0] < end, step, (bounds[i], zeros))
        for c, total in enumerate(state[1]):
            out[0, c] = total

    return pl.pallas_call(
        add,
        grid=count,
        out_specs=pl.BlockSpec((1, pairs_bar.shape[1]), lambda i: (i, 0)),
        out_shape=jax.ShapeDtypeStruct((count, pairs_bar.shape[1]), pairs_bar.dtype),
        interpret=interpret,
        compiler_params=_TILE,
    )(pairs_bar, pair, bounds)
