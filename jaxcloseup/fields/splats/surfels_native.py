"""Surfels rendered by the native library, from parameters to an image, in one call each way.

It projects as `projection` does and blends as `blend_native`; nothing in between is an array of
XLA. Surfels that do not show cost one test. The derivative projects and lists them anew.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import CustomVJPPrimal, SymbolicZero, custom_vjp_primal_tree_values

from jaxcloseup.fields.splats.config import RasterizeConfig
from jaxcloseup.fields.splats.layout import MOMENTS
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.geometry.cameras import Camera


FEATURES = 6  # color and normal


def can_render(surfels: Surfels, opacity: jax.Array, camera: Camera) -> bool:
    """Return whether the native library renders such surfels, as `render_sums` takes them."""
    arrays = jax.tree.leaves((surfels, opacity, _numbers_of(camera)))
    single = all(array.dtype == jnp.float32 for array in arrays)
    return single and surfels.log_scales.shape[1] == 2


def render_sums(
    surfels: Surfels, opacity: jax.Array, camera: Camera, config: RasterizeConfig
) -> tuple[jax.Array, jax.Array]:
    """Return sums over surfels `[6 + MOMENTS, H, W]` and the median z-depth `[H, W]`.

    The payload of the sums, see `blend_tiles`, is color and normal. Differentiable.

    Args:
      surfels: `N` surfels; logits of opacity do not count.
      opacity: `[N]` in [0, 1]; surfels of opacity 0 are not drawn.
      camera: one camera.
      config: static; `near` and `antialias` count.
    """
    shapes = surfels.means, surfels.log_scales, surfels.quaternions, opacity, surfels.sh
    return _render(config, (camera.height, camera.width), shapes, _numbers_of(camera))


def _numbers_of(camera: Camera) -> tuple[jax.Array, jax.Array]:
    return camera.camtoworld, camera.intrinsics


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _render(
    config: RasterizeConfig, size: tuple[int, int], splats: Any, camera: Any
) -> tuple[jax.Array, jax.Array]:
    sums, median, *_ = _call_forward(config, size, splats, camera)
    return sums, median


def _call_forward(config: RasterizeConfig, size: tuple[int, int], splats: Any, camera: Any) -> Any:
    image = functools.partial(jax.ShapeDtypeStruct, size)
    results = [
        jax.ShapeDtypeStruct((FEATURES + MOMENTS, *size), jnp.float32),
        *(image(kind) for kind in (jnp.float32, jnp.float32, jnp.int32, jnp.float32)),
    ]
    return _call("surfels_forward", results, (*splats, *camera), config, size)


def _forward(config: RasterizeConfig, size: tuple[int, int], splats: Any, camera: Any) -> Any:
    # A camera is rarely trained.
    trained = any(leaf.perturbed for leaf in jax.tree.leaves(camera, is_leaf=_is_primal))
    splats, camera = map(custom_vjp_primal_tree_values, (splats, camera))
    sums, median, *trace = _call_forward(config, size, splats, camera)
    kept = (camera, None) if trained else (None, camera)
    return (sums, median), (splats, *kept, trace)


def _backward(
    config: RasterizeConfig, size: tuple[int, int], residuals: Any, cotangents: Any
) -> tuple[Any, Any]:
    splats, trained, fixed, trace = residuals
    camera = fixed if trained is None else trained
    results = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in splats]
    *bars, camera_bar = _call(
        "surfels_backward",
        [*results, jax.ShapeDtypeStruct((16,), jnp.float32)],
        (*splats, *camera, *trace, *map(_as_array, cotangents)),
        config,
        size,
        of_camera=trained is not None,
    )
    if trained is None:
        return tuple(bars), (None, None)
    return tuple(bars), (camera_bar[:12].reshape(3, 4), camera_bar[12:])


_render.defvjp(_forward, _backward, symbolic_zeros=True)


def _is_primal(leaf: Any) -> bool:
    return isinstance(leaf, CustomVJPPrimal)


def _as_array(bar: Any) -> jax.Array:
    """Return a cotangent, which may be a symbolic zero, as an array."""
    return jnp.zeros(bar.shape, bar.dtype) if isinstance(bar, SymbolicZero) else jnp.asarray(bar)


def _call(
    name: str,
    results: Any,
    arrays: tuple[jax.Array, ...],
    config: RasterizeConfig,
    size: tuple[int, int],
    **more: bool,
) -> Any:
    height, width = map(np.int64, size)
    return jax.ffi.ffi_call(f"jaxcloseup_{name}", results, vmap_method="broadcast_all")(
        *arrays,
        height=height,
        width=width,
        near=np.float32(config.near),
        antialias=config.antialias,
        **more,
    )
