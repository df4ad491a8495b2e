"""What a rasterizer's configuration leaves open, settled for one image.

Nothing else in splatting depends on the platform. To add a compositor, write a module with
`forward` and `backward` like those of `blend_lax`, add it to `blending.COMPOSITOR_MODULES` and its
name to `config.COMPOSITORS`, and say in `_compositor` where "auto" means it.
"""

import functools
import logging

import jax
import jax.numpy as jnp

from jaxcloseup.fields.splats.blending import compositor_module
from jaxcloseup.fields.splats.config import RasterizeConfig, RasterPlan
from jaxcloseup.fields.splats.layout import PAYLOAD
from jaxcloseup.fields.splats.tiling import TileLists
from jaxcloseup.native import library


_SMALL = 2**17  # pixels of an image that is best cut into small tiles
_CACHED_PAIRS = 2**14  # pairs whose data fit into a core's cache


def plan_raster(config: RasterizeConfig, *, height: int, width: int) -> RasterPlan:
    """Fill in the open options of a configuration with the fastest for an image and platform.

    Small tiles evaluate fewer splats in vain, but more pairs have to be sorted; docs/log/speed.md
    has the times on a CPU. Small tiles that are chosen here get three times the `capacity`, since
    splats touch two to three times as many. A GPU evaluates thousands of tiles at once: its sizes
    are a guess.
    """
    platform = config.platform or jax.default_backend()
    on_cpu = platform == "cpu"
    tile, capacity = config.tile, config.capacity
    if tile is None:
        small = on_cpu and height * width <= _SMALL
        tile, capacity = (4, 3 * capacity) if small else (8, capacity)
    return RasterPlan(
        capacity=capacity,
        near=config.near,
        tile=tile,
        chunk=config.chunk or 8,
        block=config.block or (256 if on_cpu else 4096),
        pairs_at_once=_CACHED_PAIRS if on_cpu else capacity,
        compositor=_compositor(config.compositor, platform, tile),
        interpret=platform != "gpu",
    )


def _compositor(name: str, platform: str, tile: int) -> str:
    """Return the name of a compositor, where "auto" is the fastest that runs on a platform.

    Raises:
      LibraryError: the native library is asked for, and cannot run.
    """
    if name == "native" and platform != "cpu":
        raise library.LibraryError('compositor "native" runs on CPUs alone: use "auto"')
    if name == "native":
        library.require('compositor "native"', 'use "auto"')
    if name != "auto":
        return name
    if platform == "cpu" and library.available():
        return "native"
    return "kernel" if platform == "gpu" and kernels_compile(tile) else "loops"


@functools.cache
def kernels_compile(tile: int) -> bool:
    """Return whether this GPU runs the kernels for tiles of a size; log once why not."""
    plan = RasterPlan(capacity=1, near=1.0, tile=tile)

    def example() -> tuple[jax.Array, TileLists]:
        one = jnp.zeros(1, jnp.int32)
        lists = TileLists(one, one, one, origins=jnp.zeros((1, 2), jnp.int32), overflow=one)
        return jnp.zeros((1, PAYLOAD + 1), jnp.float32), lists

    def both(table: jax.Array, lists: TileLists) -> jax.Array:
        kernels = compositor_module("kernel")  # Pallas may have lost the backend that it imports
        sums, median, trace = kernels.forward(plan, table, lists)
        return kernels.backward(plan, table, lists, trace, (sums, median))

    try:
        jax.jit(both).lower(*jax.eval_shape(example)).compile()
    except Exception as error:  # whatever stops the import or the compiler
        reason = str(error).splitlines() or [type(error).__name__]
        logging.getLogger(__name__).warning(
            "splats are blended by jax.lax, for this GPU cannot run the kernels: %s", reason[0]
        )
        return False
    return True
