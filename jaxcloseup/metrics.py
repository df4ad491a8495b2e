"""Image quality: PSNR, SSIM and color-corrected PSNR, each for one image and weighted by pixel.

Images are `[H, W, 3]` floats in [0, 1]; batch with `jax.vmap`. Published numbers are those of 8-bit
images: `quantize` both first, and a saved PNG reproduces the number. A weight that is 0 everywhere
gives NaN, for the caller to report as absent.
"""

import chex
import dm_pix
import jax
import jax.numpy as jnp

from jaxcloseup.numerics import matmul, safe_divide


SSIM_TAPS = 11


def quantize(image: jax.Array) -> jax.Array:
    """The image as 8 bits per channel would hold it: clipped to [0, 1], rounded to n / 255."""
    return jnp.round(jnp.clip(image, 0, 1) * 255) / 255


def psnr(image: jax.Array, target: jax.Array, *, weight: jax.Array | None = None) -> jax.Array:
    """Peak signal-to-noise ratio, -10 log10(mean squared error), in dB; inf for equal images.

    Args:
      image: `[H, W, 3]` in [0, 1].
      target: `[H, W, 3]` in [0, 1].
      weight: `[H, W]` of each pixel in the mean; all alike by default.
    """
    weight = _check(image, target, weight)
    return -10 * jnp.log10(_weighted_mean((image - target) ** 2, weight))


def ssim(image: jax.Array, target: jax.Array, *, weight: jax.Array | None = None) -> jax.Array:
    """Structural similarity, 1 for equal images; mean over the windows that lie inside.

    Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004,
    equations 13 to 17, for each channel alone: Gaussian windows of 11 taps and sigma 1.5,
    K1 = 0.01, K2 = 0.03.

    Args:
      image: `[H, W, 3]` in [0, 1], at least 11 pixels a side.
      target: `[H, W, 3]` in [0, 1].
      weight: `[H, W]`; a window weighs what the pixel at its center does, whatever else it covers,
        so crop padding away rather than give it the weight 0.
    """
    weight = _check(image, target, weight)
    if min(image.shape[:2]) < SSIM_TAPS:
        raise ValueError(f"SSIM needs {SSIM_TAPS} pixels a side: the image is {image.shape[:2]}.")
    with jax.numpy_dtype_promotion("standard"):  # dm_pix mixes integers and floats
        similarity = dm_pix.ssim(
            image, target, max_val=1.0, filter_size=SSIM_TAPS, filter_sigma=1.5, return_map=True
        )
    border = SSIM_TAPS // 2
    return _weighted_mean(similarity, weight[border:-border, border:-border])


def cc_psnr(image: jax.Array, target: jax.Array, *, weight: jax.Array | None = None) -> jax.Array:
    """PSNR after the affine change of the image's colors that fits the target best.

    The change, a 3x3 matrix and an offset for the whole image, minimizes the weighted squared error
    and its result is clipped to [0, 1]: exposure and white balance are forgiven. Programs fit
    different families of changes (multinerf adds quadratic terms, gsplat takes each channel alone),
    so these numbers compare only among themselves. Where colors span less than three dimensions,
    as in a gray image, the change of least norm is taken. Arguments as in `psnr`.
    """
    weight = _check(image, target, weight)
    matrix, offset = fit_colors(image, target, weight)
    fitted = matmul(image, matrix[None]) + offset[None, None]
    return psnr(jnp.clip(fitted, 0, 1), target, weight=weight)


def fit_colors(
    image: jax.Array, target: jax.Array, weight: jax.Array, *, ridge: float = 0.0
) -> tuple[jax.Array, jax.Array]:
    """The affine change of an image's colors with the least weighted squared error.

    Args:
      image: `[H, W, 3]`.
      target: `[H, W, 3]`.
      weight: `[H, W]`.
      ridge: weight of the change's squared distance from none, against the mean squared error.

    Returns:
      Matrix `[3, 3]` and offset `[3]`: rows of colors times the matrix, plus the offset. NaN where
      the weights sum to 0; of least norm where the colors leave it open.
    """
    share = safe_divide(weight, jnp.sum(weight), fill=jnp.nan)[..., None]
    mean = jnp.sum(share * image, axis=(0, 1), keepdims=True)
    target_mean = jnp.sum(share * target, axis=(0, 1), keepdims=True)
    # Centerd colors take the offset out of the system and keep its condition low.
    colors, targets = (image - mean).reshape(-1, 3), (target - target_mean).reshape(-1, 3)
    weighted = colors.T * share.reshape(1, -1)
    towards = ridge * jnp.eye(3, dtype=image.dtype)
    inverse = jnp.linalg.pinv(matmul(weighted, colors) + towards, rtol=1e-5, hermitian=True)
    matrix = matmul(inverse, matmul(weighted, targets) + towards)
    mean, target_mean = mean[0, 0], target_mean[0, 0]
    reached = mean + (target_mean - mean) / (1 + ridge)
    return matrix, reached - matmul(mean[None], matrix)[0]


def _check(image: jax.Array, target: jax.Array, weight: jax.Array | None) -> jax.Array:
    """Check shapes and types, and return the weight or ones."""
    chex.assert_shape(image, (None, None, 3))
    chex.assert_equal_shape([image, target])
    chex.assert_type([image, target], float)
    if weight is None:
        return jnp.ones(image.shape[:2], image.dtype)
    chex.assert_shape(weight, image.shape[:2])
    return weight


def _weighted_mean(values: jax.Array, weight: jax.Array) -> jax.Array:
    """Mean of `[H, W, 3]` values with weights `[H, W]`, NaN where these sum to 0."""
    total = jnp.sum(weight)
    return safe_divide(jnp.sum(jnp.mean(values, axis=-1) * weight), total, fill=jnp.nan)
