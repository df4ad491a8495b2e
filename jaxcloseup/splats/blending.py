"""Blends the splats of all tiles, by the compositor that suits the platform."""

import functools

import jax

from jaxcloseup.splats import loops
from jaxcloseup.splats.batching import broadcast_batch, merge_images, split_images
from jaxcloseup.splats.kernel import Trace
from jaxcloseup.splats.tiling import TileLists


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def blend_tiles(config, table: jax.Array, lists: TileLists) -> tuple[jax.Array, jax.Array]:
    """Blend splats front to back in all tiles; only `table` is differentiated.

    Args:
      config: a `RasterizeConfig`; static.
      table: `[N, C]` from `pack`.
      lists: result of `tile_lists` with the config's tile and block.

    Returns:
      Sums `[T, F + 4, P]` over splats of weight times payload, z, 1, and the first and second power
      of 1 / z minus its value at the pixel's first splat; and the median z-depth `[T, P]`. Tiles
      are in row-major order.
    """
    return _blend_forward(config, table, lists)[0]


def _blend_forward(config, table, lists):
    sums, median, trace = _batched_forward(config)(table, lists)
    return (sums, median), (table, lists, trace)


def _blend_backward(config, residuals, cotangents):
    return _batched_backward(config)(*residuals, cotangents), None


blend_tiles.defvjp(_blend_forward, _blend_backward)


@functools.cache
def _batched_forward(config):
    """`forward` that blends a batch of images as one image with more tiles.

    If `vmap` batched the loops instead, all images would wait for the slowest at every chunk.
    """
    forward = jax.custom_batching.custom_vmap(functools.partial(loops.forward, config))

    @forward.def_vmap
    def _(size, batched, table, lists):
        table, lists = merge_images(*broadcast_batch(size, batched, (table, lists)))
        return split_images(size, forward(table, lists)), (True, True, Trace(True, True, True))

    return forward


@functools.cache
def _batched_backward(config):
    """`backward` with the batching of `_batched_forward`."""
    backward = jax.custom_batching.custom_vmap(functools.partial(loops.backward, config))

    @backward.def_vmap
    def _(size, batched, table, lists, trace, cotangents):
        arguments = broadcast_batch(size, batched, (table, lists, trace, cotangents))
        table, lists = merge_images(*arguments[:2])
        more = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), arguments[2:])
        return split_images(size, backward(table, lists, *more)), True

    return backward
