"""The compositor as Pallas kernels, for GPUs: one program a tile, one splat after another.

Each program walks its tile's list as the loops of `blend_lax` do, with all pixels of the tile at
once. The derivative has no atomic additions, so it repeats to the last bit: a program writes the
cotangent of each of its pairs to a place of its own, and a second kernel adds up those of each
splat, always in the same order.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxcloseup.fields.splats.config import RasterPlan
from jaxcloseup.fields.splats.layout import ANCHOR, MOMENTS, PAYLOAD, Channels, Column, Trace
from jaxcloseup.fields.splats.splat_math import (
    TRANSMITTANCE_MIN,
    Moments,
    Walk,
    channels,
    pass_splat,
    pull_back,
    row_bar,
    shade,
    sum_pixels,
    worth,
)
from jaxcloseup.fields.splats.tiling import TileLists, longest_first, starts_of


_TILE = plgpu.CompilerParams(num_warps=2)
Ref = Any  # of an array in the memory of the device


def forward(
    plan: RasterPlan, table: jax.Array, lists: TileLists
) -> tuple[jax.Array, jax.Array, Trace]:
    """Compute what `blend_lax.forward` does."""
    features, pixels = table.shape[1] - PAYLOAD, plan.tile**2
    tiles, dtype = lists.starts.shape[0], table.dtype
    order = longest_first(lists.counts)
    each = pl.BlockSpec((1, pixels), lambda i: (i, 0))
    values = jax.ShapeDtypeStruct((tiles, pixels), dtype)
    sums, median, *trace = pl.pallas_call(
        functools.partial(_forward_tile, plan, features),
        grid=(tiles,),
        out_specs=[pl.BlockSpec((1, features + MOMENTS, pixels), lambda i: (i, 0, 0)), *[each] * 4],
        out_shape=[
            jax.ShapeDtypeStruct((tiles, features + MOMENTS, pixels), dtype),
            values,
            values,
            jax.ShapeDtypeStruct((tiles, pixels), jnp.int32),
            values,
        ],
        interpret=plan.interpret,
        compiler_params=_TILE,
    )(table, *_in_turn(lists, order))
    place = jnp.argsort(order)
    sums, median, *trace = (leaf[place] for leaf in (sums, median, *trace))
    return sums, median, Trace(*trace)


def backward(
    plan: RasterPlan,
    table: jax.Array,
    lists: TileLists,
    trace: Trace,
    cotangents: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """Compute what `blend_lax.backward` does."""
    features, pixels = table.shape[1] - PAYLOAD, plan.tile**2
    tiles, capacity = lists.starts.shape[0], lists.splats.shape[0]
    order = longest_first(lists.counts)
    (sums_bar, median_bar), trace = jax.tree.map(lambda leaf: leaf[order], (cotangents, trace))
    in_turn = _in_turn(lists, order)
    each = pl.BlockSpec((1, pixels), lambda i: (i, 0))
    whole = [pl.BlockSpec(a.shape, lambda i, n=a.ndim: (0,) * n) for a in (table, *in_turn)]
    pairs_bar = pl.pallas_call(
        functools.partial(_backward_tile, plan, features),
        grid=(tiles,),
        in_specs=[
            *whole,
            *[each] * 3,
            pl.BlockSpec((1, features + MOMENTS, pixels), lambda i: (i, 0, 0)),
            each,
        ],
        out_shape=jax.ShapeDtypeStruct((capacity, table.shape[1]), table.dtype),
        interpret=plan.interpret,
        compiler_params=_TILE,
    )(table, *in_turn, trace.transmittance, trace.stop, trace.reference, sums_bar, median_bar)
    return _add_pairs(pairs_bar, lists, table.shape[0], interpret=plan.interpret)


def _in_turn(lists: TileLists, order: jax.Array) -> tuple[jax.Array, ...]:
    """Return lists in an order of tiles, longest first, so that long lists begin first."""
    return lists.splats, lists.starts[order], lists.counts[order], lists.origins[order]


def _pixels(tile: int, dtype: jnp.dtype) -> tuple[jax.Array, jax.Array]:
    """Return pixel centers x and y `[P]` of a tile, without arrays that Triton cannot make."""
    place = jnp.arange(tile * tile, dtype=jnp.int32)
    x, y = (part(place, jnp.int32(tile)).astype(dtype) + 0.5 for part in (lax.rem, lax.div))
    return x, y


def _column(table: Ref, splat: jax.Array, origin: list[jax.Array]) -> Column:
    """Return a function of columns `[]` of a splat's row, whose anchor is local to the tile."""

    def column(i: int) -> jax.Array:
        value = table[splat, i]
        return value - origin[i - ANCHOR] if i in (ANCHOR, ANCHOR + 1) else value

    return column


class _ForwardState(struct.PyTreeNode):
    """State of a tile's forward loop."""

    position: jax.Array  # `[]` index of the next splat in the list
    before: jax.Array  # `[P]` product of 1 - alpha so far
    walk: Walk  # position of each pixel
    sums: Channels  # partial sums


def _forward_tile(plan: RasterPlan, features: int, *refs: Ref) -> None:
    """Write the sums, the median and the trace of one tile."""
    table, splats, starts, counts, origins, *out = refs
    sums_out, median_out, transmittance_out, stop_out, reference_out = out
    i, dtype = pl.program_id(0), table.dtype
    start, count = starts[i], counts[i]
    origin = [origins[i, axis].astype(dtype) for axis in range(2)]
    x, y = _pixels(plan.tile, dtype)

    def unfinished(state: _ForwardState) -> jax.Array:
        return (state.position < count) & (jnp.max(state.before) >= TRANSMITTANCE_MIN)

    def step(state: _ForwardState) -> _ForwardState:
        position, before = state.position, state.before
        column = _column(table, splats[start + position], origin)
        seen = shade(column, x, y, plan.near)
        after = before - seen.alpha * before
        weight, walk = pass_splat(
            state.walk, seen.alpha, seen.inverse_depth, seen.z, before, after, position
        )
        new = channels(column, features, seen, walk.reference)
        sums = jax.tree.map(lambda total, value: total + weight * value, state.sums, new)
        return _ForwardState(position + 1, after, walk, sums)

    ones, zeros = jnp.ones_like(x), jnp.zeros_like(x)
    walk = Walk(ones, jnp.zeros(x.shape, jnp.int32), zeros, zeros)
    sums = Channels.of((zeros,) * (features + MOMENTS))
    state = lax.while_loop(unfinished, step, _ForwardState(jnp.int32(0), ones, walk, sums))
    for channel, total in enumerate(state.sums.listed()):
        sums_out[0, channel] = total
    walk = state.walk
    median_out[0] = walk.median
    transmittance_out[0] = walk.remaining
    stop_out[0] = walk.stop
    reference_out[0] = walk.reference


class _BackwardState(struct.PyTreeNode):
    """State of a tile's backward loop."""

    position: jax.Array  # `[]` index of the next splat in front
    behind: jax.Array  # `[P]` sum of weight times worth of the splats behind it
    after: jax.Array  # `[P]` transmittance behind it


def _backward_tile(plan: RasterPlan, features: int, *refs: Ref) -> None:
    """Write the cotangents of the pairs of one tile."""
    table, splats, starts, counts, origins, *trace_refs, sums_bar_ref, median_bar, pairs_bar = refs
    i, dtype = pl.program_id(0), table.dtype
    start, count = starts[i], counts[i]
    origin = [origins[i, axis].astype(dtype) for axis in range(2)]
    x, y = _pixels(plan.tile, dtype)
    middle = plan.tile / 2
    trace = Trace(*(leaf[0] for leaf in trace_refs))
    sums_bar = Channels.of([sums_bar_ref[0, channel] for channel in range(features + MOMENTS)])
    median_bar = median_bar[0]

    def moments(values: jax.Array) -> Moments:
        return tuple(jnp.sum(values * by) for by in (jnp.ones_like(x), x - middle, y - middle))

    def step(state: _BackwardState) -> _BackwardState:
        position, after = state.position, state.after
        column = _column(table, splats[start + position], origin)
        seen = shade(column, x, y, plan.near)
        alpha = jnp.where(position < trace.stop, seen.alpha, 0)
        value = worth(column, seen, trace.reference, sums_bar)
        before = after * (1 / (1 - alpha))
        weight, pulled = pull_back(
            seen, alpha, before, after, state.behind, value, trace, sums_bar, median_bar
        )
        sums = sum_pixels(pulled, moments, jnp.sum)
        payload = [jnp.sum(weight * bar) for bar in sums_bar.payload]
        for c, bar in enumerate(row_bar(column, middle, sums, payload)):
            pairs_bar[start + position, c] = bar
        return _BackwardState(position - 1, state.behind + weight * value, before)

    def blank(position: jax.Array) -> jax.Array:
        for c in range(PAYLOAD + features):
            pairs_bar[start + position, c] = jnp.zeros((), dtype)
        return position + 1

    # Pairs behind the last one that counts have no cotangent.
    longest = jnp.minimum(jnp.max(trace.stop), count)
    lax.while_loop(lambda position: position < count, blank, longest)
    state = _BackwardState(longest - 1, jnp.zeros_like(x), trace.transmittance)
    lax.while_loop(lambda state: state.position >= 0, step, state)


def _add_pairs(pairs_bar: jax.Array, lists: TileLists, count: int, *, interpret: bool) -> jax.Array:
    """Return sums `[N, C]` of the pairs' cotangents, splat by splat."""
    capacity = lists.splats.shape[0]
    # Merged images leave room between their lists, whose places belong to no splat.
    begins, ends = lists.starts, lists.starts + lists.counts
    changes = jnp.zeros(capacity + 1, jnp.int32).at[begins].add(1).at[ends].add(-1)
    listed = jnp.cumsum(changes[:-1]) > 0
    place = jnp.arange(capacity, dtype=jnp.int32)
    owner, pair = lax.sort((jnp.where(listed, lists.splats, count), place), num_keys=1)
    bounds = starts_of(owner, count)

    def add(pairs_bar: Ref, pair: Ref, bounds: Ref, out: Ref) -> None:
        i = pl.program_id(0)

        def step(state: tuple[jax.Array, tuple[jax.Array, ...]]) -> Any:
            position, sums = state
            row = [pairs_bar[pair[position], c] for c in range(out.shape[1])]
            return position + 1, tuple(a + b for a, b in zip(sums, row, strict=True))

        zeros = (jnp.zeros((), out.dtype),) * out.shape[1]
        end = bounds[i + 1]
        _, sums = lax.while_loop(lambda state: state[0] < end, step, (bounds[i], zeros))
        for c, total in enumerate(sums):
            out[0, c] = total

    return pl.pallas_call(
        add,
        grid=(count,),
        out_specs=pl.BlockSpec((1, pairs_bar.shape[1]), lambda i: (i, 0)),
        out_shape=jax.ShapeDtypeStruct((count, pairs_bar.shape[1]), pairs_bar.dtype),
        interpret=interpret,
        compiler_params=_TILE,
    )(pairs_bar, pair, bounds)
