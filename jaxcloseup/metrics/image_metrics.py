"""Image quality: PSNR, SSIM and color-corrected PSNR, each for one image and weighted by pixel.

Images are `[H, W, 3]` floats in [0, 1]; batch with `jax.vmap`. Published numbers refer to 8-bit
images: `quantize` both images first, so that a saved PNG reproduces the number. A weight that is 0
everywhere gives NaN, which callers report as absent.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxcloseup.geometry.numerics import matmul, safe_divide
from jaxcloseup.metrics.similarity import Window, similarity
from jaxcloseup.native import library


SSIM_TAPS, SSIM_SIGMA = 11, 1.5
SSIM_K1, SSIM_K2 = 0.01, 0.03
_BLOCK = 32  # pixels that are blurred by one product of matrices


def quantize(image: jax.Array) -> jax.Array:
    """Round an image to 8 bits per channel: clip to [0, 1], then round to n / 255."""
    return jnp.round(jnp.clip(image, 0, 1) * 255) / 255


def psnr(image: jax.Array, target: jax.Array, *, weight: jax.Array | None = None) -> jax.Array:
    """Compute the PSNR, -10 log10(mean squared error), in dB; inf for equal images.

    Args:
      image: `[H, W, 3]` in [0, 1].
      target: `[H, W, 3]` in [0, 1].
      weight: `[H, W]` weight of each pixel in the mean; 1 by default.
    """
    image, target, weight = in_single(image, target, weight)
    return -10 * jnp.log10(_weighted_mean((image - target) ** 2, weight))


def ssim(image: jax.Array, target: jax.Array, *, weight: jax.Array | None = None) -> jax.Array:
    """Compute SSIM, 1 for equal images; the mean over the windows inside the image.

    Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004,
    equations 13 to 17, per channel: Gaussian windows of 11 taps and sigma 1.5,
    K1 = 0.01, K2 = 0.03.

    Args:
      image: `[H, W, 3]` in [0, 1], at least 11 pixels a side.
      target: `[H, W, 3]` in [0, 1].
      weight: `[H, W]`; a window has the weight of its central pixel, whatever else it covers, so
        crop padding away instead of giving it weight 0.

    Raises:
      ValueError: a side of the image has fewer than 11 pixels.
    """
    image, target, weight = in_single(image, target, weight)
    if min(image.shape[:2]) < SSIM_TAPS:
        raise ValueError(f"SSIM needs {SSIM_TAPS} pixels a side: the image is {image.shape[:2]}.")
    border = SSIM_TAPS // 2
    windows = weight[border:-border, border:-border]
    single = image.dtype == jnp.float32
    if not (single and library.available()):
        return _similarity(image, target, windows)
    # XLA's CPU backend takes six times as long.
    return lax.platform_dependent(
        image, target, windows, cpu=_similarity_natively, default=_similarity
    )


def _similarity_natively(image: jax.Array, target: jax.Array, weight: jax.Array) -> jax.Array:
    """Average SSIM over windows with weights `[H - 10, W - 10]`, in the native library."""
    total = jnp.sum(weight)
    window = Window(_taps(), (SSIM_K1**2, SSIM_K2**2))
    mean = similarity(image, target, safe_divide(weight, total), window)
    return jnp.where(total > 0, mean, jnp.nan)


def _similarity(image: jax.Array, target: jax.Array, weight: jax.Array) -> jax.Array:
    """Average SSIM over windows with weights `[H - 10, W - 10]`."""
    import dm_pix  # here, so that fields can be imported without it

    with jax.numpy_dtype_promotion("standard"):  # dm_pix mixes integers and floats
        found = dm_pix.ssim(
            image, target, max_val=1.0, k1=SSIM_K1, k2=SSIM_K2, filter_fn=_blur, return_map=True
        )
    return _weighted_mean(found, weight)


def _taps() -> tuple[float, ...]:
    """Return the Gaussian of `ssim`, which sums to 1."""
    taps = np.exp(-0.5 * ((np.arange(SSIM_TAPS) - SSIM_TAPS // 2) / SSIM_SIGMA) ** 2)
    return tuple(taps / np.sum(taps))


def _blur(image: jax.Array) -> jax.Array:
    """Blur by the Gaussian of `ssim`; XLA's CPU backend convolves ten times slower."""
    return jnp.swapaxes(_blur_rows(jnp.swapaxes(_blur_rows(image), 0, 1)), 0, 1)


def _blur_rows(image: jax.Array) -> jax.Array:
    """Blur along the first axis, in blocks that a matrix makes from the pixels which they cover.

    The derivative of a sum of shifted images would take twenty times as long.
    """
    size, reach = image.shape[0], SSIM_TAPS - 1
    count = -(-(size - reach) // _BLOCK)
    filled = jnp.pad(image, [(0, (count + 1) * _BLOCK - size), (0, 0), (0, 0)])
    blocks = filled.reshape(count + 1, _BLOCK, *image.shape[1:])
    covered = jnp.concatenate([blocks[:-1], blocks[1:, :reach]], axis=1)
    taps = _taps()
    windows = [np.pad(taps, (k, _BLOCK - 1 - k)) for k in range(_BLOCK)]
    matrix = jnp.asarray(np.stack(windows), image.dtype)
    blurred = jnp.einsum("oi,biwc->bowc", matrix, covered, precision=lax.Precision.HIGHEST)
    return blurred.reshape(-1, *image.shape[1:])[: size - reach]


def cc_psnr(image: jax.Array, target: jax.Array, *, weight: jax.Array | None = None) -> jax.Array:
    """Compute the PSNR after the affine change of colors that fits the target best.

    The change, a 3x3 matrix and an offset for the whole image, minimizes the weighted squared
    error; its result is clipped to [0, 1]. Differences in exposure and white balance do not count.
    Other programs fit other changes: compare their numbers with those of `color_corrections`. Where
    colors span less than three dimensions, as in a gray image, the change of least norm applies.
    Arguments as in `psnr`.
    """
    image, target, weight = in_single(image, target, weight)
    fitted = change_colors(image, *fit_colors(image, target, weight))
    return psnr(jnp.clip(fitted, 0, 1), target, weight=weight)


def fit_colors(
    image: jax.Array, target: jax.Array, weight: jax.Array, *, ridge: float = 0.0
) -> tuple[jax.Array, jax.Array]:
    """Fit the affine change of an image's colors with the least weighted squared error.

    Args:
      image: `[H, W, 3]` colors to change.
      target: `[H, W, 3]` colors to reach.
      weight: `[H, W]` non-negative weights of the pixels.
      ridge: weight of the squared distance from the identity, against the mean squared error.

    Returns:
      Matrix `[3, 3]` and offset `[3]` for `change_colors`. Both are NaN if the weights sum to 0,
      and have the least norm if the colors do not determine them.
    """
    share = safe_divide(weight, jnp.sum(weight), fill=jnp.nan)[..., None]
    mean = jnp.sum(share * image, axis=(0, 1), keepdims=True)
    target_mean = jnp.sum(share * target, axis=(0, 1), keepdims=True)
    # Centered colors take the offset out of the system and keep its condition number low.
    colors, targets = image - mean, target - target_mean
    towards = ridge * jnp.eye(3, dtype=image.dtype)
    own, shared = (_sum_of_products(share * colors, other) for other in (colors, targets))
    inverse = jnp.linalg.pinv(own + towards, rtol=1e-5, hermitian=True)
    matrix = matmul(inverse, shared + towards)
    mean, target_mean = mean[0, 0], target_mean[0, 0]
    reached = mean + (target_mean - mean) / (1 + ridge)
    return matrix, reached - matmul(mean[None], matrix)[0]


def _sum_of_products(left: jax.Array, right: jax.Array) -> jax.Array:
    """Return `[3, 3]` sums over the pixels of two images `[H, W, 3]` of all products of channels.

    Rows are summed first. In one loop over half a million pixels, a sum of 32 bits loses what tells
    the colors of a nearly gray image from gray, and XLA would make it one loop.
    """
    rows = jnp.einsum("hwi,hwj->hij", left, right, precision=jax.lax.Precision.HIGHEST)
    return jnp.sum(jax.lax.optimization_barrier(rows), axis=0)


def change_colors(image: jax.Array, matrix: jax.Array, offset: jax.Array) -> jax.Array:
    """Change the colors of an image `[H, W, 3]` to `image @ matrix + offset`."""
    return matmul(image, matrix[None]) + offset[None, None]


def in_single(
    image: jax.Array, target: jax.Array, weight: jax.Array | None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Check two images and weights of pixels, 1 by default, and return them in float32 at least.

    A sum over an image overflows half precision.
    """
    chex.assert_shape(image, (None, None, 3))
    chex.assert_equal_shape([image, target])
    chex.assert_type([image, target], float)
    if weight is None:
        weight = jnp.ones(image.shape[:2], jnp.float32)
    chex.assert_shape(weight, image.shape[:2])
    arrays = jnp.asarray(image), jnp.asarray(target), jnp.asarray(weight)
    double = any(array.dtype == jnp.float64 for array in arrays)
    image, target, weight = (
        array.astype(jnp.float64 if double else jnp.float32) for array in arrays
    )
    return image, target, weight


def _weighted_mean(values: jax.Array, weight: jax.Array) -> jax.Array:
    """Average `[H, W, 3]` values with weights `[H, W]`; NaN where these sum to 0."""
    total = jnp.sum(weight)
    return safe_divide(jnp.sum(jnp.mean(values, axis=-1) * weight), total, fill=jnp.nan)
