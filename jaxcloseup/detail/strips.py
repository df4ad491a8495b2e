"""Predictions of the networks for a whole image, strip by strip.

The features of an image take more memory than a CPU's caches hold; those of a few rows do not.
"""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxcloseup.detail.features import REACH, edges, feature_planes, feature_powers
from jaxcloseup.detail.weights import DetailWeights, mean_planes
from jaxcloseup.photos.gather import Gathered


_ROWS = 16  # of a strip
_PIXELS = 1024  # whose features go through the networks together
_LOOPS = 2  # loops over strips, which run at the same time


class _Whole(NamedTuple):
    """What features of a pixel are made of, `[H, W, ...]`."""

    gathered: tuple[Gathered, Gathered]
    alpha: jax.Array
    bends: jax.Array


def predict_by_strips(
    weights: DetailWeights,
    finer: jax.Array,
    gathered: tuple[Gathered, Gathered],
    instead: jax.Array,
    alpha: jax.Array,
    depth: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Predict how far to trust what is gathered, from `pixel_features`, which see for arguments.

    Args:
      weights: trained networks.
      finer: `[]` of a `Detail`.
      gathered: residuals and colors.
      instead: `[H, W, 3]` what gathered colors would add to the render.
      alpha: `[H, W]` rendered opacity.
      depth: `[H, W]` rendered z-depth; 0 where undefined.

    Returns:
      Outputs `[2, H, W]` of the mixing networks, and of those of errors.
    """
    powers = feature_powers(*gathered, instead)
    powers = jnp.pad(powers, ((0, 0), (REACH, REACH), (0, 0)), mode="edge")
    whole = _Whole(gathered, alpha, edges(depth))

    def predict(start: jax.Array | int, rows: int, chunks: int) -> jax.Array:
        strip = jax.tree.map(lambda image: jax.lax.dynamic_slice_in_dim(image, start, rows), whole)
        near = jax.lax.dynamic_slice_in_dim(powers, start, rows + 2 * REACH, axis=1)
        residual, colors = strip.gathered
        planes = feature_planes(residual, colors, strip.alpha, strip.bends, near, finer)
        planes = planes.reshape(-1, chunks, rows // chunks * width)

        def outputs(chunk: jax.Array) -> jax.Array:
            features = jax.lax.dynamic_index_in_dim(planes, chunk, axis=1, keepdims=False)
            both = weights.mixing, weights.errors
            return jnp.concatenate([mean_planes(networks, features) for networks in both])

        found = jax.lax.map(outputs, jnp.arange(chunks))
        return jnp.moveaxis(found, 0, 1).reshape(4, rows, width).astype(jnp.float32)

    def by_strips() -> jax.Array:
        ends = sorted({height * i // _LOOPS for i in range(_LOOPS + 1)})
        loops = [_loop(predict, *rows, width) for rows in itertools.pairwise(ends)]
        return jnp.concatenate(loops, axis=1)

    height, width = depth.shape
    whole_image = functools.partial(predict, 0, height, 1)
    found = jax.lax.platform_dependent(cpu=by_strips, default=whole_image)
    return found[:2], found[2:]


def _loop(predict: Callable[..., jax.Array], first: int, last: int, width: int) -> jax.Array:
    """Predict the rows `[4, last - first, W]` of an image, strip by strip; the last two overlap."""
    rows = min(_ROWS, last - first)
    chunks = max(count for count in range(1, rows + 1) if _divides(count, rows, width))
    strips = -(-(last - first) // rows)

    def add(strip: jax.Array, found: jax.Array) -> jax.Array:
        start = jnp.minimum(strip * rows, last - first - rows)
        strip = predict(first + start, rows, chunks)
        return jax.lax.dynamic_update_slice_in_dim(found, strip, start, axis=1)

    found = jnp.zeros((4, last - first, width), jnp.float32)
    return jax.lax.fori_loop(0, strips, add, found)


def _divides(count: int, rows: int, width: int) -> bool:
    """Return whether as many chunks of rows have one size, and not too few pixels."""
    return count == 1 or (rows % count == 0 and rows * width >= count * _PIXELS)
