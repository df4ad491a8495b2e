"""Forward warp of every pixel of many views into chosen pixels of one virtual view.

This is the paper's union I* of forward warps. A full-size capture has tens of millions of source
pixels, and a close-up sees few of them. Sources are therefore kept in square blocks with bounding
spheres. Blocks that cannot land in the virtual view are culled whole; the others are lifted and
projected on the fly, a chunk at a time. Most sources of a chunk miss the chosen pixels, so a chunk
leaves one bit per source, and only sources whose bit is set are projected again and drawn. Both
loops have dynamic lengths, so no capacity can overflow.
"""

from collections.abc import Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points
from jaxcloseup.geometry.flag_loops import for_each_hit, for_each_true
from jaxcloseup.geometry.numerics import matmul
from jaxcloseup.geometry.visibility import sphere_in_view
from jaxcloseup.geometry.warp import NO_SOURCE, ForwardWarp, draw_nearest


# Fastest sizes on two CPU cores; the result does not depend on them.
BLOCK = 16  # side of a block in pixels
CHUNK = 2048  # maximum number of blocks projected together
GROUP = 1024  # minimum number of sources drawn together

Buffer = tuple[jax.Array, jax.Array]  # depths and sources, see `draw_nearest`


class SourceBlocks(struct.PyTreeNode):
    """Training pixels with their depth, in N square blocks of P pixels.

    Attributes:
      depth: `[N, P]` z-depth in the pixel's own view, 0 where undefined.
      view: `[N]` int32 index of the block's view.
      corner: `[N, 2]` int32 (x, y) index of the block's top-left pixel.
      center: `[N, 3]` center of the block's bounding sphere, world units.
      radius: `[N]` radius of that sphere; negative if no pixel of the block has a depth.
    """

    depth: jax.Array
    view: jax.Array
    corner: jax.Array
    center: jax.Array
    radius: jax.Array


def block_sources(
    cameras: Camera, depths: jax.Array, weight: jax.Array | None = None
) -> SourceBlocks:
    """Cut training views into blocks, once for many warps.

    Args:
      cameras: stacked cameras `[V]`.
      depths: `[V, H, W]` z-depth, world units; not positive or not finite is undefined.
      weight: `[V, H, W]` pixels of weight 0 are not sources; 1 everywhere by default.
    """
    chex.assert_rank(depths, 3)
    num_views, height, width = depths.shape
    defined = (depths > 0) & jnp.isfinite(depths)
    if weight is not None:
        defined &= weight > 0
    depths = jnp.where(defined, depths, 0)
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    pad = ((0, rows * BLOCK - height), (0, columns * BLOCK - width))

    def blocks_of_view(camera: Camera, depth: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        points = pixels_to_points(camera, pixel_grid(height, width), depth)

        def cut(array: jax.Array) -> jax.Array:
            array = jnp.pad(array, pad + ((0, 0),) * (array.ndim - 2))
            tail = array.shape[2:]
            array = array.reshape(rows, BLOCK, columns, BLOCK, *tail).swapaxes(1, 2)
            return array.reshape(rows * columns, BLOCK * BLOCK, *tail)

        depth, points = cut(depth), cut(points)
        there = (depth > 0)[..., None]
        low = jnp.min(jnp.where(there, points, jnp.inf), axis=1)
        high = jnp.max(jnp.where(there, points, -jnp.inf), axis=1)
        empty = ~jnp.any(there, axis=1)
        center = jnp.where(empty, 0, (low + high) / 2)
        distance = jnp.linalg.norm(points - center[:, None], axis=-1)
        radius = jnp.max(jnp.where(there[..., 0], distance, 0), axis=1)
        return depth, center, jnp.where(empty[:, 0], -1, radius)

    depth, center, radius = jax.lax.map(lambda view: blocks_of_view(*view), (cameras, depths))
    view, row, column = jnp.meshgrid(
        *(jnp.arange(size, dtype=jnp.int32) for size in (num_views, rows, columns)), indexing="ij"
    )
    return SourceBlocks(
        depth=depth.reshape(-1, BLOCK * BLOCK),
        view=view.reshape(-1),
        corner=jnp.stack([column, row], axis=-1).reshape(-1, 2) * BLOCK,
        center=center.reshape(-1, 3),
        radius=radius.reshape(-1),
    )


def union_warp(
    sources: SourceBlocks,
    cameras: Camera,
    values: jax.Array,
    camera: Camera,
    pixels: jax.Array,
    *,
    exclude: jax.Array | int = -1,
) -> ForwardWarp:
    """Forward-warp all training pixels into a virtual view and read the result at chosen pixels.

    The result equals that of `forward_warp` with every source, read at `pixels`.

    Args:
      sources: from `block_sources` of the same cameras and depths.
      cameras: stacked cameras `[V]`.
      values: `[V, H, W, C]` values of the training pixels, of any dtype.
      camera: the virtual camera.
      pixels: `[..., 2]` pixels of the virtual view, inside its image; repeats are allowed.
      exclude: index of a view whose pixels are not sources; -1 excludes none.

    Returns:
      A `ForwardWarp` with `[...]` in place of `[H, W]`, without gradient.
    """
    chex.assert_rank([values, sources.depth], [4, 2])
    arguments = jax.lax.stop_gradient((sources, cameras, values, camera, pixels))
    return _union_warp(*arguments, jnp.asarray(exclude, jnp.int32))


@jax.custom_batching.custom_vmap
def _union_warp(
    sources: SourceBlocks,
    cameras: Camera,
    values: jax.Array,
    camera: Camera,
    pixels: jax.Array,
    exclude: jax.Array,
) -> ForwardWarp:
    chosen = jnp.floor(pixels.reshape(-1, 2)).astype(jnp.int32)
    chosen = jnp.clip(chosen, 0, jnp.array([[camera.width - 1, camera.height - 1]]))
    chosen = chosen[:, 1] * camera.width + chosen[:, 0]
    # A slot for each chosen pixel; of repeated pixels, one slot serves all.
    slot_of_pixel = jnp.full(camera.height * camera.width, -1, jnp.int32)
    slot_of_pixel = slot_of_pixel.at[chosen].set(jnp.arange(chosen.size, dtype=jnp.int32))
    is_chosen = slot_of_pixel >= 0

    center = matmul(sources.center - camera.position[None], camera.rotation)
    visible = sphere_in_view(camera, center, sources.radius)
    blocks_there = visible & (sources.radius >= 0) & (sources.view != exclude)
    affine = _pixel_to_virtual(cameras, camera)
    every_offset = jnp.arange(BLOCK * BLOCK, dtype=jnp.int32)[None]
    num_blocks = len(blocks_there)
    group = max(GROUP, chosen.size // 32)

    def draw_chunk(block: jax.Array, live: jax.Array, buffer: Buffer) -> Buffer:
        depth = sources.depth[block]
        target, _ = _project(sources, block[:, None], every_offset, depth, affine, camera)
        hit = (target >= 0) & is_chosen[target] & live[:, None]

        def draw_group(
            row: jax.Array, offset: jax.Array, live: jax.Array, buffer: Buffer
        ) -> Buffer:
            source = block[row] * BLOCK * BLOCK + offset
            depth = sources.depth[block[row], offset]
            target, depth = _project(sources, block[row], offset, depth, affine, camera)
            slot = jnp.where((target >= 0) & live, slot_of_pixel[target], -1)
            # A slot past the end is not drawn.
            return draw_nearest(buffer, jnp.where(slot >= 0, slot, chosen.size), depth, source)

        return for_each_hit(hit, group, draw_group, buffer)

    buffer = (
        jnp.full(chosen.size, jnp.inf, sources.depth.dtype),
        jnp.full(chosen.size, NO_SOURCE, jnp.int32),
    )
    buffer = for_each_true(blocks_there, min(CHUNK, -(-num_blocks // 8)), draw_chunk, buffer)
    depth, source = (array[slot_of_pixel[chosen]] for array in buffer)

    hit = source != NO_SOURCE
    block, offset = jnp.divmod(jnp.where(hit, source, 0), BLOCK * BLOCK)
    x = sources.corner[block, 0] + offset % BLOCK
    y = sources.corner[block, 1] + offset // BLOCK
    read = jnp.where(hit[:, None], values[sources.view[block], y, x], 0)
    shape = pixels.shape[:-1]
    return ForwardWarp(
        values=read.reshape(*shape, -1), depth=depth.reshape(shape), hit=hit.reshape(shape)
    )


@_union_warp.def_vmap
def _one_after_the_other(
    size: int, batched: Sequence[Any], *arguments: Any
) -> tuple[ForwardWarp, Any]:
    """Compute a batch of warps one after another, and reuse the result of an equal predecessor.

    The work of a warp depends on the data, so a batch computed at once would wait for its largest
    member. Arms of a sweep that draw the same camera follow each other.
    """

    def pick(index: jax.Array | int) -> tuple[Any, ...]:
        return jax.tree.map(
            lambda leaf, has_axis: leaf[index] if has_axis else leaf, arguments, tuple(batched)
        )

    def warp(before: ForwardWarp, index: jax.Array) -> tuple[ForwardWarp, ForwardWarp]:
        now, last = pick(index), pick(jnp.maximum(index - 1, 0))
        repeated = index > 0
        for leaf, old, has_axis in zip(*map(jax.tree.leaves, (now, last, batched)), strict=True):
            repeated &= jnp.all(leaf == old) if has_axis else True
        result = jax.lax.cond(repeated, lambda: before, lambda: _union_warp(*now))
        return result, result

    nothing = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(_union_warp, *pick(0))
    )
    _, results = jax.lax.scan(warp, nothing, jnp.arange(size))
    return results, jax.tree.map(lambda _: True, results)


def _pixel_to_virtual(cameras: Camera, camera: Camera) -> tuple[jax.Array, jax.Array]:
    """Return A `[V, 3, 3]` and b `[V, 3]`: pixel (x, y) at depth d projects to A (x, y, 1) d + b.

    Lifting and projecting become one affine map for each view, with A = K' R'^T R_j K_j^-1 and
    b = K' R'^T (t_j - t').
    """

    def matrix(fx: jax.Array, fy: jax.Array, cx: jax.Array, cy: jax.Array) -> jax.Array:
        zero, one = jnp.zeros_like(fx), jnp.ones_like(fx)
        return jnp.array([[fx, zero, cx], [zero, fy, cy], [zero, zero, one]])

    project = matmul(matrix(*camera.intrinsics), camera.rotation.T)

    def one_view(view: Camera) -> tuple[jax.Array, jax.Array]:
        fx, fy, cx, cy = view.intrinsics
        lift = matrix(1 / fx, 1 / fy, -cx / fx, -cy / fy)
        return (
            matmul(matmul(project, view.rotation), lift),
            matmul(project, view.position - camera.position),
        )

    return jax.vmap(one_view)(cameras)


def _project(
    sources: SourceBlocks,
    block: jax.Array,
    offset: jax.Array,
    depth: jax.Array,
    affine: tuple[jax.Array, jax.Array],
    camera: Camera,
) -> tuple[jax.Array, jax.Array]:
    """Return flat target pixels (-1 for none) and z-depths of sources.

    `block` and `offset`, the index of a pixel within its block, broadcast. Both loops call this,
    so that a source lands on the same pixel in both.
    """
    matrix, shift = (array[sources.view[block]] for array in affine)
    corner = sources.corner[block].astype(depth.dtype) + 0.5
    column, row = (index.astype(depth.dtype) for index in (offset % BLOCK, offset // BLOCK))

    def coordinate(axis: int) -> jax.Array:
        by_x, by_y, constant = (matrix[..., axis, k] for k in range(3))
        start = by_x * corner[..., 0] + by_y * corner[..., 1] + constant
        return depth * (start + by_x * column + by_y * row) + shift[..., axis]

    x, y, z = map(coordinate, range(3))
    in_front = (depth > 0) & (z > jnp.finfo(z.dtype).eps)
    z = jnp.where(in_front, z, 1)
    x, y = x / z, y / z
    lands = in_front & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    x, y = (jnp.floor(jnp.where(lands, array, 0)).astype(jnp.int32) for array in (x, y))
    return jnp.where(lands, y * camera.width + x, -1), z
