"""Blends the splats of all tiles, by the compositor that suits the platform."""

import functools
import logging
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcloseup.fields.splats import blend_lax as loops
from jaxcloseup.fields.splats import blend_pallas as gpu_kernel
from jaxcloseup.fields.splats.batching import broadcast_batch, merge_images, split_images
from jaxcloseup.fields.splats.splat_math import PAYLOAD, Trace
from jaxcloseup.fields.splats.tiling import TileLists


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def blend_tiles(config, table: jax.Array, lists: TileLists) -> tuple[jax.Array, jax.Array]:
    """Blend splats front to back in all tiles; only `table` is differentiated.

    Args:
      config: a `RasterizeConfig`; static.
      table: `[N, C]` from `pack`.
      lists: result of `tile_lists` with the config's tile.

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


def _compositor(config, name: str) -> Callable[..., Any]:
    """The function `name` of the compositor that `config` asks for."""
    on_gpu = jax.default_backend() == "gpu"
    if config.compositor == "loops" or (
        config.compositor == "auto" and not (on_gpu and _kernels_compile(config.tile))
    ):
        return functools.partial(getattr(loops, name), config)
    return functools.partial(getattr(gpu_kernel, name), config, interpret=not on_gpu)


@functools.cache
def _kernels_compile(tile: int) -> bool:
    """Whether this GPU runs the kernels; says why not, once."""
    config, array = _Tiles(tile, near=1.0), jax.ShapeDtypeStruct
    one = array((1,), jnp.int32)
    lists = TileLists(one, one, one, array((1, 2), jnp.int32), one)
    table = array((1, PAYLOAD + 1), jnp.float32)

    def both(table, lists):
        *sums, trace = gpu_kernel.forward(config, table, lists)
        return gpu_kernel.backward(config, table, lists, trace, tuple(sums))

    try:
        jax.jit(both).lower(table, lists).compile()
    except Exception as error:  # whatever stops the compiler
        reason = str(error).splitlines() or [type(error).__name__]
        logging.getLogger(__name__).warning(
            "splats are blended by jax.lax, for this GPU cannot run the kernels: %s", reason[0]
        )
        return False
    return True


class _Tiles(NamedTuple):
    """What compositors read of a `RasterizeConfig`."""

    tile: int
    near: float


@functools.cache
def _batched_forward(config):
    """`forward` that blends a batch of images as one image with more tiles.

    If `vmap` batched the loops instead, all images would wait for the slowest at every chunk.
    """
    forward = jax.custom_batching.custom_vmap(_compositor(config, "forward"))

    @forward.def_vmap
    def _(size, batched, table, lists):
        table, lists = merge_images(*broadcast_batch(size, batched, (table, lists)))
        return split_images(size, forward(table, lists)), (True, True, Trace(True, True, True))

    return forward


@functools.cache
def _batched_backward(config):
    """`backward` with the batching of `_batched_forward`."""
    backward = jax.custom_batching.custom_vmap(_compositor(config, "backward"))

    @backward.def_vmap
    def _(size, batched, table, lists, trace, cotangents):
        arguments = broadcast_batch(size, batched, (table, lists, trace, cotangents))
        table, lists = merge_images(*arguments[:2])
        more = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), arguments[2:])
        return split_images(size, backward(table, lists, *more)), True

    return backward
