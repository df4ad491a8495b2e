"""Steps that touch only the surfels that their cameras may see.

A window of a photograph shows a small share of a scene, and a step should cost what it shows. So
surfels lie in chunks of neighbors, in Morton order, each within a box. A step tests the boxes,
takes the rows of the chunks in sight, and puts them back when they have changed.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.fields.contract import Local
from jaxcloseup.fields.splats.filters import SMOOTHING_VARIANCE
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.geometry.cameras import Camera


_LARGEST, _SMALLEST = 64, 32  # surfels of a chunk: smaller ones hold less that is out of sight
_STEP = 2  # parts are compiled for this many times more chunks, and for all
_FEWEST = 64  # chunks of the smallest part; smaller ones would save less than they compile
_SAMPLED = 4096  # surfels, about, of which quantiles are taken: more would only take longer
# Pixels by which an image grows on each side: filters draw a splat farther out than it reaches.
_MARGIN = 4.0
_CUTOFF = 3.34  # standard deviations at which the most opaque splat falls to `ALPHA_MIN`


class Bounds(struct.PyTreeNode):
    """Boxes that hold the centers of the surfels of M chunks, and how far these reach."""

    center: jax.Array  # `[M, 3]`
    half: jax.Array  # `[M, 3]` half the sides, along the world's axes
    reach: jax.Array  # `[M]`; negative where no surfel is alive


def chunk_rows(capacity: int) -> int | None:
    """Return how many surfels a chunk has, a divisor of the capacity; None if there is none."""
    sizes = range(min(_LARGEST, capacity), _SMALLEST - 1, -1)
    return next((size for size in sizes if capacity % size == 0), None)


def local_steps(
    capacity: int,
    *,
    near: float,
    adapt: Callable[[jax.Array, Any], Any],
    adapt_all: Callable[[jax.Array, Any], Any],
    is_due: Callable[[int], bool],
) -> Local | None:
    """Return how steps touch a part of `capacity` surfels; None where they make no chunks.

    Args:
      capacity: number of rows.
      near: z-depth before which nothing is drawn.
      adapt: `(key, part) -> part`, after every step.
      adapt_all: `(key, state) -> state`, when it is due.
      is_due: `(step) -> bool`.
    """
    rows = chunk_rows(capacity)
    if rows is None:
        return None
    chunks = capacity // rows

    def take(state: Any, cameras: tuple[Camera, ...]) -> tuple[Any, jax.Array | None]:
        place, count = _find(state.buffers.bounds, cameras, near=near)
        size = _part_size(int(count), chunks)
        if size == chunks:  # all, in their places
            return _without_bounds(state), None
        return _take(state, place[:size], rows=rows)

    def put(key: jax.Array, state: Any, part: Any, place: jax.Array | None) -> Any:
        # The state before knows its number already; that of the part is still being computed.
        due = is_due(int(state.step) + 1)
        whole = place is None
        state = _bounded(part, rows=rows) if whole else _put(state, part, place, rows=rows)
        # Surfels that moved far are sorted anew, or their chunks would be in sight everywhere.
        return _prepare(adapt_all(key, state), rows=rows) if due else state

    return Local(
        prepare=functools.partial(_prepare, rows=rows),
        take=take,
        adapt=adapt,
        put=put,
        finish=_finish,
    )


def _part_size(needed: int, chunks: int) -> int:
    """Return the number of chunks of a part: few sizes are compiled.

    Moving more than half of all takes longer than testing the others.
    """
    size = _FEWEST
    while size < needed:
        size *= _STEP
    return size if 2 * size <= chunks else chunks


@functools.partial(jax.jit, static_argnames="rows")
def _prepare(state: Any, *, rows: int) -> Any:
    state = _finish(state)
    order = morton_order(state.params, state.buffers.alive)
    state = _map_rows(lambda leaf: leaf[order], state)
    number = jnp.sum(state.buffers.alive, dtype=jnp.float32)
    state = state.replace(buffers=state.buffers.replace(number=number))
    return _bounded(state, rows=rows)


@functools.partial(jax.jit, static_argnames="rows")
def _bounded(state: Any, *, rows: int) -> Any:
    return state.replace(buffers=state.buffers.replace(bounds=_bounds_of(state, rows)))


def _without_bounds(state: Any) -> Any:
    return state.replace(buffers=state.buffers.replace(bounds=None))


@functools.partial(jax.jit, static_argnames="near")
def _find(
    bounds: Bounds, cameras: tuple[Camera, ...], *, near: float
) -> tuple[jax.Array, jax.Array]:
    """Return the chunks that any camera may see, the others' number in place of them; how many."""
    count = bounds.reach.shape[0]
    seen = jnp.zeros(count, bool)
    for camera in cameras:
        seen |= _boxes_in_view(bounds, camera, near)
    place = jnp.nonzero(seen, size=count, fill_value=count)[0]
    return place.astype(jnp.int32), jnp.sum(seen)


def _boxes_in_view(bounds: Bounds, camera: Camera, near: float) -> jax.Array:
    """Return whether anything within `reach` of boxes `[M]` may show.

    Never a false no for discs. A volumetric Gaussian far beside the image may be drawn larger than
    its own radius; one that is missed for that had an opacity of hardly more than 1/255 there.
    """
    fx, fy, cx, cy = camera.intrinsics
    right, down, ahead = camera.rotation.T
    offset = bounds.center - camera.position[None]

    def inside(normal: jax.Array, beyond: jax.Array | float = 0.0) -> jax.Array:
        farthest = jnp.sum(offset * normal[None] + bounds.half * jnp.abs(normal)[None], axis=1)
        return farthest + bounds.reach * jnp.linalg.norm(normal) >= beyond

    seen = (bounds.reach >= 0) & inside(ahead, near)
    # The planes through the edges of the image, grown by the margin.
    for axis, focal, first, size in ((right, fx, cx, camera.width), (down, fy, cy, camera.height)):
        seen &= inside(focal * axis + (first + _MARGIN) * ahead)
        seen &= inside(-focal * axis + (size - first + _MARGIN) * ahead)
    return seen


@functools.partial(jax.jit, static_argnames="rows")
def _take(state: Any, place: jax.Array, *, rows: int) -> tuple[Any, jax.Array]:
    """Return the state of some chunks; those past the end are dead surfels."""

    def pick(leaf: jax.Array) -> jax.Array:
        chunks = leaf.reshape(-1, rows, *leaf.shape[1:])
        return chunks.at[place].get(mode="fill", fill_value=0).reshape(-1, *leaf.shape[1:])

    return _without_bounds(_map_rows(pick, state)), place


@functools.partial(jax.jit, static_argnames="rows", donate_argnums=0)
def _put(state: Any, part: Any, place: jax.Array, *, rows: int) -> Any:
    """Return the state with chunks in their places; what is not per surfel is the part's."""
    capacity, taken = state.buffers.alive.shape[0], part.buffers.alive.shape[0]
    bounds = jax.tree.map(
        lambda old, new: old.at[place].set(new, mode="drop"),
        state.buffers.bounds,
        _bounds_of(part, rows),
    )

    def into(old: jax.Array, new: jax.Array) -> jax.Array:
        if not _is_per_row(old, capacity) or not _is_per_row(new, taken):
            return new
        shape = (-1, rows, *old.shape[1:])
        return old.reshape(shape).at[place].set(new.reshape(shape), mode="drop").reshape(old.shape)

    after = jax.tree.map(into, _without_bounds(state), part)
    return after.replace(buffers=after.buffers.replace(bounds=bounds))


def _finish(state: Any) -> Any:
    return state.replace(buffers=state.buffers.replace(bounds=None, number=None))


def _is_per_row(leaf: jax.Array, rows: int) -> bool:
    return leaf.ndim > 0 and leaf.shape[0] == rows


def _map_rows(function: Callable[[jax.Array], jax.Array], state: Any) -> Any:
    """Map what is per surfel; scalars, such as Adam's count, and bounds stay."""
    rows = state.buffers.alive.shape[0]
    return jax.tree.map(lambda leaf: function(leaf) if _is_per_row(leaf, rows) else leaf, state)


def _bounds_of(state: Any, rows: int) -> Bounds:
    """Return the bounds of each chunk's living surfels."""
    surfels, alive = state.params, state.buffers.alive.reshape(-1, rows)
    means = surfels.means.reshape(-1, rows, 3)
    scale = jnp.exp(jnp.max(surfels.log_scales, axis=-1))
    if state.buffers.interval is not None:
        scale = jnp.sqrt(scale**2 + SMOOTHING_VARIANCE * state.buffers.interval**2)
    low = jnp.min(jnp.where(alive[..., None], means, jnp.inf), axis=1)
    high = jnp.max(jnp.where(alive[..., None], means, -jnp.inf), axis=1)
    largest = jnp.max(jnp.where(alive, scale.reshape(-1, rows), 0), axis=1)
    some = jnp.any(alive, axis=1)
    return Bounds(
        center=jnp.where(some[:, None], (low + high) / 2, 0),
        half=jnp.where(some[:, None], (high - low) / 2, 0),
        reach=jnp.where(some, 1.01 * _CUTOFF * largest, -1),
    )


def morton_order(surfels: Surfels, alive: jax.Array) -> jax.Array:
    """Return an order `[N]` in which neighbors in space lie together, the dead last.

    Large surfels lie apart from small ones: one of them would make its chunk visible from anywhere.
    """
    largest = jnp.max(surfels.log_scales, axis=-1)
    some = slice(None, None, max(1, len(largest) // _SAMPLED))
    typical = jnp.nanmedian(jnp.where(alive, largest, jnp.nan)[some])
    size = jnp.clip(jnp.floor((largest - typical) / jnp.log(4.0)), 0, 3)
    # Most surfels, without the few that are far out.
    living = jnp.where(alive[:, None], surfels.means, jnp.nan)[some]
    low, high = jnp.nanquantile(living, jnp.array([0.02, 0.98]), axis=0)
    # Cells are cubes: a thin layer is not cut across its thickness.
    share = (surfels.means - low[None]) / jnp.maximum(jnp.max(high - low), 1e-12)
    cell = jnp.nan_to_num(jnp.clip(share * 511, 0, 511)).astype(jnp.uint32)
    key = sum(_spread_bits(cell[:, i]) << i for i in range(3))
    key |= jnp.nan_to_num(size).astype(jnp.uint32) << 27
    return jnp.argsort(jnp.where(alive, key, jnp.uint32(2**32 - 1)), stable=True)


def _spread_bits(number: jax.Array) -> jax.Array:
    """Return numbers below 2^10 with two zeros in front of each bit."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        number = (number | (number << shift)) & mask
    return number
