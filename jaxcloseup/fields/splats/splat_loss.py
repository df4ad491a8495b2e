"""The loss of a splat field: colors, and regularizers that suit every unit of length."""

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import Rendering
from jaxcloseup.fields.splats.config import SplatConfig, SurfelConfig
from jaxcloseup.fields.splats.regularizers import (
    depth_to_normal,
    normal_inconsistency,
    scale_free_distortion,
)
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.metrics.image_metrics import change_colors, fit_colors, ssim


_SATURATED = 0.1  # relative error of depth at which its pull is a quarter
_UNCHANGED_SHARE = 0.3  # share of the image loss on unchanged colors when images may change theirs


def splat_loss(
    rendering: Rendering, target_rgb: jax.Array, weight: jax.Array, *, config: SplatConfig
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the loss of an image as `RadianceField.loss`, and the image's PSNR.

    The image loss is that of Kerbl et al. (2023), equation 7: an absolute difference and 1 - SSIM.
    """
    chex.assert_equal_shape([rendering.rgb, target_rgb])
    chex.assert_shape(weight, target_rgb.shape[:-1])
    total = jnp.sum(weight)
    seen = rendering.rgb
    image = _image_loss(seen, target_rgb, weight, config.ssim_weight)
    if config.color_ridge is not None:
        seen = _match_colors(seen, target_rgb, weight, config.color_ridge)
        matched = _image_loss(seen, target_rgb, weight, config.ssim_weight)
        # Without a loss on unchanged colors, they would drift away from all photographs.
        image = _UNCHANGED_SHARE * image + (1 - _UNCHANGED_SHARE) * matched
    # An image without weight has no loss at all, as the contract says.
    prior = jnp.where(total > 0, rendering.aux.prior, 0)
    error = jnp.where(weight[..., None] > 0, jnp.clip(seen, 0, 1) - target_rgb, 0)
    squared = _weighted_mean(jnp.mean(error**2, axis=-1), weight)
    penalty = _weighted_mean(rendering.aux.penalty, weight)
    return image + penalty + prior, {"psnr": -10 * jnp.log10(squared)}


def _weighted_mean(values: jax.Array, weight: jax.Array) -> jax.Array:
    return safe_divide(jnp.sum(weight * values), jnp.sum(weight))


def _image_loss(
    seen: jax.Array, target_rgb: jax.Array, weight: jax.Array, ssim_weight: float
) -> jax.Array:
    """Return the absolute difference and 1 - SSIM, a weighted mean `[]` over pixels."""
    # Pixels of weight 0 must not show in SSIM's windows at other pixels either.
    target = jnp.where(weight[..., None] > 0, target_rgb, jax.lax.stop_gradient(seen))
    difference = _weighted_mean(jnp.mean(jnp.abs(seen - target), axis=-1), weight)
    similarity = ssim(seen, target, weight=weight)
    # SSIM is NaN where no window has any weight.
    dissimilarity = jnp.where(jnp.isnan(similarity), 0, 1 - similarity)
    return (1 - ssim_weight) * difference + ssim_weight * dissimilarity


def _match_colors(
    seen: jax.Array, target_rgb: jax.Array, weight: jax.Array, ridge: float
) -> jax.Array:
    """Return rendered colors after the affine map that takes them closest to the target."""
    matrix, offset = fit_colors(jax.lax.stop_gradient(seen), target_rgb, weight, ridge=ridge)
    any_weight = jnp.sum(weight) > 0
    matrix = jnp.where(any_weight, matrix, jnp.eye(3, dtype=matrix.dtype))
    return change_colors(seen, matrix, jnp.where(any_weight, offset, 0))


def depth_loss(rendering: Rendering, depth: jax.Array, trust: jax.Array) -> jax.Array:
    """Return the weighted relative error `[]` of the expected depth, saturated where it is large.

    The expected depth moves with everything that is drawn along a ray, so what floats before the
    surface fades, and what lies behind it comes forward. A measured depth may be wrong: beyond
    some percent its pull falls.
    """
    chex.assert_equal_shape([rendering.depth, depth, trust])
    seen = rendering.aux.expected_depth
    error = jnp.abs(safe_divide(seen, depth) - 1)
    pull = trust * jax.lax.stop_gradient(rendering.alpha) * error / (1 + error / _SATURATED)
    return rendering.aux.hold * jnp.mean(jnp.where((trust > 0) & (seen > 0), pull, 0))


def penalty_of(image: Rendering, camera: Camera, config: SplatConfig) -> jax.Array:
    """Return weighted normal and distortion losses `[H, W]`."""
    # In units of the mean depth, so that one weight suits every unit of length.
    typical = safe_divide(jnp.sum(image.alpha * image.depth), jnp.sum(image.alpha))
    distortion = scale_free_distortion(image.aux.distortion, jax.lax.stop_gradient(typical))
    # Distortion is unbounded for surfaces very near a virtual camera.
    distortion = distortion / (1 + distortion)
    if image.normal is None or not isinstance(config, SurfelConfig):
        return config.distortion_weight * distortion
    surface = image.aux.median_depth if config.depth == "median" else image.depth
    inconsistency = normal_inconsistency(
        image.aux.normal, depth_to_normal(camera, surface), image.alpha
    )
    return config.normal_weight * inconsistency + config.distortion_weight * distortion


def prior_of(
    surfels: Surfels,
    alive: jax.Array,
    config: SplatConfig,
    extent: float,
    number: jax.Array | None = None,
) -> jax.Array:
    """Return the weighted mean opacity and scale `[]` of living surfels, or these ones' share.

    `number` is how many live in all, where these are a part of them.

    Both fade surfels that nothing holds, which MCMC density control then moves (Kheradmand et al.
    2024, equation 10).
    """
    if number is None:
        number = jnp.sum(alive, dtype=surfels.means.dtype)

    def mean(values: jax.Array) -> jax.Array:
        return safe_divide(jnp.sum(jnp.where(alive, values, 0)), number)

    opacity = mean(jax.nn.sigmoid(surfels.opacity_logits))
    scale = mean(jnp.mean(jnp.exp(surfels.log_scales), axis=-1)) / extent
    return config.opacity_weight * opacity + config.scale_weight * scale
