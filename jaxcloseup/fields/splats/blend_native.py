"""The native compositor, for CPUs: lists of tiles, blending and its derivative in one call each.

It blends as `blend_lax` does, with the same arithmetic (`native/splat_tiles.cc`), on tiles of its
own size. Lists hold any number of pairs, so nothing overflows. The derivative makes them anew: that
costs a tenth of what it takes to walk along them.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.fields.splats.config import RasterPlan
from jaxcloseup.fields.splats.layout import MOMENTS, PAYLOAD, Trace


TILE = 4  # side of a tile in pixels, as in `native/splat_layout.h`
MOST_FEATURES = 54

Splats = tuple[jax.Array, jax.Array, jax.Array]  # table, boxes, order


def can_blend(table: jax.Array) -> bool:
    """Return whether the native compositor takes such a table."""
    return table.dtype == jnp.float32 and table.shape[1] <= PAYLOAD + MOST_FEATURES


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def blend_image(
    plan: RasterPlan, height: int, width: int, table: jax.Array, box: jax.Array, order: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Blend splats front to back into an image; only `table` is differentiated.

    Args:
      plan: static; `near` counts.
      height: in pixels; static.
      width: in pixels; static.
      table: `[N, C]` float32, from `pack`.
      box: `[N, 4]` bounds x0, y0, x1, y1 in pixels.
      order: `[N]` depths, not negative.

    Returns:
      Sums `[F + MOMENTS, H, W]` as of `blend_tiles`, and the median z-depth `[H, W]`.
    """
    return _forward(plan, height, width, table, box, order)[0]


def _forward(
    plan: RasterPlan, height: int, width: int, table: jax.Array, box: jax.Array, order: jax.Array
) -> Any:
    image, channels = (height, width), table.shape[-1] - PAYLOAD + MOMENTS
    shapes = [(channels, *image), image, image, image, image]
    kinds = [jnp.float32] * 3 + [jnp.int32, jnp.float32]
    sums, median, *trace = _call(
        "splats_forward",
        [jax.ShapeDtypeStruct(*pair) for pair in zip(shapes, kinds, strict=True)],
        (plan, height, width),
        table,
        box,
        order,
    )
    return (sums, median), (table, box, order, Trace(*trace))


def _backward(
    plan: RasterPlan, height: int, width: int, residuals: Any, cotangents: Any
) -> tuple[jax.Array, None, None]:
    table, box, order, trace = residuals
    table_bar = _call(
        "splats_backward",
        jax.ShapeDtypeStruct(table.shape, table.dtype),
        (plan, height, width),
        *(table, box, order, trace.transmittance, trace.stop, trace.reference),
        *cotangents,
    )
    return table_bar, None, None


blend_image.defvjp(_forward, _backward)


def count_pairs(
    plan: RasterPlan, height: int, width: int, table: jax.Array, box: jax.Array, order: jax.Array
) -> jax.Array:
    """Return the lengths of all tiles' lists, `[rows, columns]`; arguments as of `blend_image`."""
    shape = -(-height // TILE), -(-width // TILE)
    result = jax.ShapeDtypeStruct(shape, jnp.int32)
    return _call("splats_count", result, (plan, height, width), table, box, order)


def _call(name: str, result: Any, static: tuple[RasterPlan, int, int], *arrays: jax.Array) -> Any:
    plan, height, width = static
    function = jax.ffi.ffi_call(f"jaxcloseup_{name}", result, vmap_method="broadcast_all")
    return function(
        *arrays, height=np.int64(height), width=np.int64(width), near=np.float32(plan.near)
    )
