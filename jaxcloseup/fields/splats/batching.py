"""Batches of images as one image with more tiles, see the batching rules in `blending`."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.splats.tiling import TileLists


def broadcast_batch(
    size: int, batched: Sequence[Any], arguments: tuple[Any, ...]
) -> tuple[Any, ...]:
    """Arguments of a batching rule whose leaves all have the batch axis `[size, ...]`.

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

    def flat(leaf, shift=0):
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
