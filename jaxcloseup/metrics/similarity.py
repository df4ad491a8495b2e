"""SSIM natively: a weighted sum over windows, with its derivative in the same call."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Window(NamedTuple):
    """What SSIM's windows are.

    Attributes:
      taps: 11 weights along a row or column of a window, symmetric, with the sum 1.
      constants: C1, C2.
    """

    taps: tuple[float, ...]
    constants: tuple[float, float]


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def similarity(image: jax.Array, target: jax.Array, share: jax.Array, window: Window) -> jax.Array:
    """Sum SSIM over the windows inside two images, in the native library.

    Wang et al. (2004), equation 13, the mean over the channels, rearranged so that rounding leaves
    1 where images are equal: see `native/ssim_rows.cc`. It has a first derivative only.

    Args:
      image: `[H, W, 3]` float32, at least 11 pixels a side.
      target: the same.
      share: `[H - 10, W - 10]` weights of the windows.
      window: see there.

    Returns:
      `[]` the weighted sum.
    """
    found, _ = _call(image, target, share, window, derivative=False)
    return jnp.sum(share * found)


def _forward(
    image: jax.Array, target: jax.Array, share: jax.Array, window: Window
) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    found, gradient = _call(image, target, share, window, derivative=True)
    return jnp.sum(share * found), (image, target, share, found, gradient)


def _backward(
    window: Window, residuals: tuple[jax.Array, ...], cotangent: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    image, target, share, found, gradient = residuals
    # Dead code unless someone differentiates the target; SSIM is symmetric.
    _, other = _call(target, image, share, window, derivative=True)
    return cotangent * gradient, cotangent * other, cotangent * found


similarity.defvjp(_forward, _backward)


def _call(
    image: jax.Array, target: jax.Array, share: jax.Array, window: Window, *, derivative: bool
) -> tuple[jax.Array, jax.Array]:
    """Return SSIM `[H - 10, W - 10]`, and the derivative of its sum by the image, if wanted."""
    height, width, channels = image.shape
    reach = len(window.taps) - 1
    shapes = [share.shape, (0,), (0,)]
    if derivative:
        # The last one is only there to be written and read within the call.
        shapes[1:] = [image.shape, (3, height + reach, width + reach, channels)]
    results = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    found, gradient, _ = jax.ffi.ffi_call("jaxcloseup_ssim", results, vmap_method="sequential")(
        image,
        target,
        share,
        taps=np.array(window.taps, np.float32),
        constants=np.array(window.constants, np.float32),
    )
    return found, gradient
