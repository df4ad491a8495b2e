"""Blends the splats of all tiles, by the compositor of a plan."""

import functools
import importlib
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.splats.config import RasterPlan
from jaxcloseup.fields.splats.layout import Trace
from jaxcloseup.fields.splats.tiling import TileLists


# Modules with `forward(plan, table, lists) -> sums, median, trace`, and
# `backward(plan, table, lists, trace, (sums_bar, median_bar)) -> table_bar`.
COMPOSITOR_MODULES = {"loops": "blend_lax", "kernel": "blend_pallas"}

Blended = tuple[jax.Array, jax.Array]  # sums and median, or their cotangents


def compositor_module(name: str) -> ModuleType:
    """Import the module of a compositor; not before it is used, for a backend may be missing."""
    return importlib.import_module(f"{__package__}.{COMPOSITOR_MODULES[name]}")


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def blend_tiles(plan: RasterPlan, table: jax.Array, lists: TileLists) -> Blended:
    """Blend splats front to back in all tiles; only `table` is differentiated.

    A custom derivative, since autodiff through the loops would store every product of every splat
    and pixel: it took 7 to 19 times as long.

    Args:
      plan: static.
      table: `[N, C]` from `pack`.
      lists: result of `tile_lists` with the plan's tile.

    Returns:
      Sums `[T, F + MOMENTS, P]` over splats of weight times `Channels`: payload, z, 1, and the
      first and second power of 1 / z minus its value at the pixel's first splat; and the median
      z-depth `[T, P]`. Tiles are in row-major order.
    """
    return _blend_forward(plan, table, lists)[0]


def _blend_forward(
    plan: RasterPlan, table: jax.Array, lists: TileLists
) -> tuple[Blended, tuple[jax.Array, TileLists, Trace]]:
    sums, median, trace = _batched_forward(plan)(table, lists)
    return (sums, median), (table, lists, trace)


def _blend_backward(
    plan: RasterPlan, residuals: tuple[jax.Array, TileLists, Trace], cotangents: Blended
) -> tuple[jax.Array, None]:
    return _batched_backward(plan)(*residuals, cotangents), None


blend_tiles.defvjp(_blend_forward, _blend_backward)


@functools.cache
def _batched_forward(plan: RasterPlan) -> Callable[..., tuple[jax.Array, jax.Array, Trace]]:
    """Return `forward` that blends a batch of images as one image with more tiles.

    If `vmap` batched the loops instead, all images would wait for the slowest at every chunk.
    """
    compositor = compositor_module(plan.compositor)
    forward = jax.custom_batching.custom_vmap(functools.partial(compositor.forward, plan))

    @forward.def_vmap
    def _(size: int, batched: Any, table: jax.Array, lists: TileLists) -> Any:
        merged = merge_images(*broadcast_batch(size, batched, (table, lists)))
        result = split_images(size, forward(*merged))
        return result, jax.tree.map(lambda leaf: True, result)

    return forward


@functools.cache
def _batched_backward(plan: RasterPlan) -> Callable[..., jax.Array]:
    """Return `backward` with the batching of `_batched_forward`."""
    compositor = compositor_module(plan.compositor)
    backward = jax.custom_batching.custom_vmap(functools.partial(compositor.backward, plan))

    @backward.def_vmap
    def _(
        size: int,
        batched: Any,
        table: jax.Array,
        lists: TileLists,
        trace: Trace,
        cotangents: Blended,
    ) -> Any:
        arguments = broadcast_batch(size, batched, (table, lists, trace, cotangents))
        table, lists = merge_images(*arguments[:2])
        more = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), arguments[2:])
        return split_images(size, backward(table, lists, *more)), True

    return backward


def broadcast_batch(
    size: int, batched: Sequence[Any], arguments: tuple[Any, ...]
) -> tuple[Any, ...]:
    """Return the arguments of a batching rule, whose leaves all have the batch axis `[size, ...]`.

    Args:
      size: number of images.
      batched: trees of bool like `arguments`, True where a leaf already has the batch axis.
      arguments: trees of arrays.
    """
    return jax.tree.map(
        lambda leaf, has_axis: leaf if has_axis else jnp.broadcast_to(leaf, (size, *leaf.shape)),
        arguments,
        tuple(batched),
    )


def merge_images(table: jax.Array, lists: TileLists) -> tuple[jax.Array, TileLists]:
    """Merge tables `[M, N, C]` and tile lists of M images into those of one image."""
    count, capacity = table.shape[1], lists.splats.shape[1]

    def flat(leaf: jax.Array, shift: int = 0) -> jax.Array:
        image = jnp.arange(leaf.shape[0], dtype=leaf.dtype)
        leaf = leaf + shift * image.reshape(-1, *(1,) * (leaf.ndim - 1))
        return leaf.reshape(-1, *leaf.shape[2:])

    return table.reshape(-1, table.shape[-1]), TileLists(
        splats=flat(lists.splats, count),
        starts=flat(lists.starts, capacity),
        counts=flat(lists.counts),
        origins=flat(lists.origins),
        overflow=lists.overflow.sum(),
    )


def split_images(size: int, tree: Any) -> Any:
    """Split the leading axis `[size * n, ...]` of every leaf into `[size, n, ...]`."""
    return jax.tree.map(lambda leaf: leaf.reshape(size, -1, *leaf.shape[1:]), tree)
