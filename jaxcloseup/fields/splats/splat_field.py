"""Splats as a radiance field: trainable 2-D Gaussian splatting (Huang et al., SIGGRAPH 2024).

With a `GaussianConfig` it is 3-D Gaussian splatting (Kerbl et al., SIGGRAPH 2023), which all below
calls surfels too. The field renders whole images only. Its regularizers align normals with the
surface and gather the light along a ray at one depth; their weights do not depend on the unit of
length.
"""

import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxcloseup.fields.contract import RadianceField, Rendering
from jaxcloseup.fields.splats.config import GaussianConfig, SplatConfig, SurfelConfig
from jaxcloseup.fields.splats.density import DensityControl, density_control
from jaxcloseup.fields.splats.filters import sampling_intervals, smoothed
from jaxcloseup.fields.splats.regularizers import (
    depth_to_normal,
    normal_inconsistency,
    scale_free_distortion,
)
from jaxcloseup.fields.splats.render import SurfelAux, render_surfels
from jaxcloseup.fields.splats.selective_adam import scale_by_selective_adam
from jaxcloseup.fields.splats.surfels import Surfels, surfels_from_points
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.numerics import safe_divide, safe_norm
from jaxcloseup.metrics.image_metrics import change_colors, fit_colors, ssim


_RENEWED_EVERY = 100  # steps between renewals of sampling intervals without density control
_UNCHANGED_SHARE = 0.3  # share of the image loss on unchanged colors when images may change theirs


class SurfelBuffers(struct.PyTreeNode):
    """State of the surfel field that is not differentiated.

    Attributes:
      alive: `[N]` bool; dead surfels are not drawn.
      degree: `[]` int32 degree of spherical harmonics that is rendered.
      regularize: `[]` 1 where the normal and distortion losses count, else 0.
      expected: `[]` 1 where `Rendering.depth` is the expected depth, 0 where it is the median.
      interval: `[N]` between the pixels of the photographs that show surfels finest, in world
        units; None without a smoothing filter, see `filters`.
    """

    alive: jax.Array
    degree: jax.Array
    regularize: jax.Array
    expected: jax.Array
    interval: jax.Array | None = None


class SurfelFieldAux(NamedTuple):
    """Private part of the surfel field's renderings.

    Attributes:
      surfels: the `aux` of `render_surfels`.
      penalty: `[H, W]` weighted normal and distortion losses.
      prior: `[]` weighted mean opacity and scale.
    """

    surfels: SurfelAux
    penalty: jax.Array
    prior: jax.Array


def surfel_field(
    config: SurfelConfig | GaussianConfig,
    *,
    extent: float,
    center: jax.Array | None = None,
    photographs: Camera | None = None,
) -> RadianceField:
    """Splats as a field of whole images, with `render`, `loss` and `adapt` compiled.

    Where `Rendering.overflow` is not 0, `config.raster.capacity` was too small and the image is
    wrong. Check it outside `jax.jit`; then build the field again with twice the capacity and repeat
    the call. Parameters and buffers fit every capacity, so nothing else changes:

        while int(field.render(params, buffers, camera, None, None).overflow) > 0:
            raster = dataclasses.replace(config.raster, capacity=2 * config.raster.capacity)
            config = dataclasses.replace(config, raster=raster)
            field = surfel_field(config, extent=extent)

    In training the metric "overflow" is the same count: repeat the steps from the state before.

    Args:
      config: static.
      extent: size of the capture in world units, such as `camera_extent`.
      center: `[3]` middle of its cameras. Beyond an extent from it, `max_scale` is a share of the
        distance: a background may be far. Without it the bound is the same everywhere.
      photographs: stacked `[V]` cameras, at the finest size that steps read: surfels are convolved
        in space with the size of their pixels, see `filters`. None has no such filter.

    Raises:
      ValueError: a setting is out of range.
      TypeError: `config.density` is not the config of a density control.
    """
    if config.depth not in ("median", "expected"):
        raise ValueError(f'SurfelConfig.depth must be "median" or "expected", not "{config.depth}"')
    if config.max_scale is not None and not config.max_scale > 0:
        raise ValueError(f"SurfelConfig.max_scale must be positive or None, not {config.max_scale}")
    if not extent > 0:
        raise ValueError(f"extent must be a positive length, not {extent}")
    control = _density_control(config, extent)

    def init(key: jax.Array, points: jax.Array, rgb: jax.Array) -> tuple[Surfels, SurfelBuffers]:
        surfels, alive = surfels_from_points(
            key,
            points,
            rgb,
            capacity=config.capacity,
            sh_degree=config.sh_degree,
            opacity=config.initial_opacity,
            num_scales=config.num_scales,
        )
        expected = jnp.float32(config.depth == "expected")
        schedule = _schedule(config, jnp.zeros((), jnp.int32))
        buffers = SurfelBuffers(alive, *schedule, expected, interval=intervals(surfels))
        return control.init(surfels), buffers

    def intervals(surfels):
        if photographs is None:
            return None
        return sampling_intervals(surfels.means, photographs, near=config.raster.near)

    def render(
        params: Surfels,
        buffers: SurfelBuffers,
        camera: Camera,
        pixels: jax.Array | None,
        key: jax.Array | None,
    ) -> Rendering:
        del key  # rendering is deterministic
        if pixels is not None:
            raise ValueError("surfels render whole images: pixels must be None")
        return draw(params, buffers, camera)

    @jax.jit
    def draw(params, buffers, camera):
        surfels = control.before_render(_limit_degree(params, buffers.degree), camera)
        surfels = smoothed(surfels, buffers.interval)
        background = None if config.background is None else jnp.full(3, config.background)
        image = render_surfels(surfels, buffers.alive, camera, config.raster, background=background)
        penalty = buffers.regularize * _penalty(image, camera, config)
        prior = _prior(params, buffers.alive, config, extent)
        return image._replace(
            depth=jnp.where(buffers.expected > 0, image.depth, image.aux.median_depth),
            aux=SurfelFieldAux(image.aux, penalty, prior),
        )

    @jax.jit
    def adapt(key: jax.Array, state: Any) -> Any:
        degree, regularize = _schedule(config, state.step)
        buffers = state.buffers.replace(degree=degree, regularize=regularize)
        state = control.adapt(key, state.replace(buffers=buffers))
        state = state.replace(params=_bound_scales(state.params, config, extent, center))
        return state if photographs is None else renew_intervals(state)

    def renew_intervals(state):
        """After every density control, which moves surfels far."""
        every = _RENEWED_EVERY if config.density is None else config.density.every
        due = state.step % every == 0
        old, params = state.buffers.interval, state.params
        new = jax.lax.cond(due, lambda: intervals(params), lambda: old)
        return state.replace(buffers=state.buffers.replace(interval=new))

    loss = jax.jit(functools.partial(_loss, config=config))
    return RadianceField(init=init, render=render, loss=loss, adapt=adapt)


def with_expected_depth(buffers: SurfelBuffers, expected: bool) -> SurfelBuffers:
    """Buffers with which the field renders, and labels use, the expected or the median depth."""
    return buffers.replace(expected=jnp.full_like(buffers.expected, expected))


def camera_extent(cameras: Camera) -> jax.Array:
    """Size `[]` of a capture in world units: 1.1 times the cameras' largest distance to their mean.

    Args:
      cameras: stacked `[V]`; a single camera has extent 0.
    """
    offset = cameras.position - jnp.mean(cameras.position, axis=0, keepdims=True)
    return 1.1 * jnp.max(jnp.linalg.norm(offset, axis=-1))


def surfel_optimizer(config: SplatConfig, *, extent: float) -> optax.GradientTransformation:
    """Adam with one learning rate for each kind of parameter, and the density control's records.

    Its `update` is compiled.

    Args:
      config: static.
      extent: size of the capture in world units.
    """
    moments = scale_by_selective_adam if config.selective_adam else optax.scale_by_adam
    adam = optax.chain(moments(eps=1e-15), _scale_by_learning_rates(config, extent))
    return _density_control(config, extent).wrap_optimizer(adam)


def means_lr_at(config: SplatConfig, step: jax.Array) -> jax.Array:
    """Learning rate `[]` of the means at a step, in extents, without `late_lr_scale`."""
    first, last = config.means_lr
    share = jnp.minimum(step.astype(jnp.float32) / config.means_lr_steps, 1)
    return first * (last / first) ** share


def _late_lr_scale_at(config, step):
    return jnp.where(step < config.means_lr_steps, 1, config.late_lr_scale)


def _scale_by_learning_rates(config, extent):
    def init(params):
        del params
        return optax.ScaleByScheduleState(count=jnp.zeros((), jnp.int32))

    def update(updates, state, params=None):
        del params
        sh_lr = jnp.full(updates.sh.shape[1], config.sh_lr / 20).at[0].set(config.sh_lr)
        # Parameters that a density control adds are not trained: their learning rate is 0.
        learning_rates = jax.tree.map(lambda leaf: 0.0, updates).replace(
            means=means_lr_at(config, state.count) * extent,
            log_scales=config.scale_lr,
            quaternions=config.rotation_lr,
            opacity_logits=config.opacity_lr,
            sh=sh_lr[None, :, None],
        )
        late = _late_lr_scale_at(config, state.count)
        updates = jax.tree.map(lambda lr, update: -late * lr * update, learning_rates, updates)
        return updates, optax.ScaleByScheduleState(count=state.count + 1)

    return optax.GradientTransformation(init, update)


def _density_control(config: SplatConfig, extent: float) -> DensityControl:
    def means_lr(step):
        return _late_lr_scale_at(config, step) * means_lr_at(config, step) * extent

    return density_control(config.density, extent=extent, means_lr=means_lr)


def _schedule(config, step):
    """Degree of spherical harmonics, and whether the normal and distortion losses count."""
    degree = jnp.minimum(step // config.sh_every, config.sh_degree).astype(jnp.int32)
    return degree, (step >= config.regularize_from).astype(jnp.float32)


def _bound_scales(surfels, config, extent, center):
    """Surfels no larger than the config allows."""
    if config.max_scale is None:
        return surfels
    reach = extent
    if center is not None:
        distance = safe_norm(surfels.means - center[None], keepdims=True)
        reach = jnp.maximum(distance, extent)
    largest = jnp.log(config.max_scale * reach)
    return surfels.replace(log_scales=jnp.minimum(surfels.log_scales, largest))


def _limit_degree(surfels, degree):
    """Surfels without spherical harmonics above a degree `[]`."""
    band = jnp.repeat(jnp.arange(4), jnp.array([1, 3, 5, 7]), total_repeat_length=16)
    drawn = (band[: surfels.sh.shape[1]] <= degree)[None, :, None]
    return surfels.replace(sh=jnp.where(drawn, surfels.sh, 0))


def _penalty(image, camera, config):
    """Weighted normal and distortion losses `[H, W]`."""
    typical = safe_divide(jnp.sum(image.alpha * image.depth), jnp.sum(image.alpha))
    distortion = scale_free_distortion(image.aux.distortion, jax.lax.stop_gradient(typical))
    # Distortion is unbounded for surfaces very near a virtual camera.
    distortion = distortion / (1 + distortion)
    if image.normal is None:
        return config.distortion_weight * distortion
    surface = image.aux.median_depth if config.depth == "median" else image.depth
    inconsistency = normal_inconsistency(
        image.aux.normal, depth_to_normal(camera, surface), image.alpha
    )
    return config.normal_weight * inconsistency + config.distortion_weight * distortion


def _prior(surfels, alive, config, extent):
    """Weighted mean opacity and scale `[]` of living surfels."""
    number = jnp.sum(alive, dtype=surfels.means.dtype)

    def mean(values):
        return safe_divide(jnp.sum(jnp.where(alive, values, 0)), number)

    opacity = mean(jax.nn.sigmoid(surfels.opacity_logits))
    scale = mean(jnp.mean(jnp.exp(surfels.log_scales), axis=-1)) / extent
    return config.opacity_weight * opacity + config.scale_weight * scale


def _loss(
    rendering: Rendering, target_rgb: jax.Array, weight: jax.Array, *, config: SplatConfig
) -> tuple[jax.Array, dict[str, jax.Array]]:
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
    prior = jnp.where(total > 0, rendering.aux.prior, 0)
    error = jnp.where(weight[..., None] > 0, jnp.clip(seen, 0, 1) - target_rgb, 0)
    squared = _weighted_mean(jnp.mean(error**2, axis=-1), weight)
    penalty = _weighted_mean(rendering.aux.penalty, weight)
    return image + penalty + prior, {"psnr": -10 * jnp.log10(squared)}


def _weighted_mean(values, weight):
    return safe_divide(jnp.sum(weight * values), jnp.sum(weight))


def _image_loss(seen, target_rgb, weight, ssim_weight):
    """Absolute difference and 1 - SSIM, a weighted mean `[]` over pixels."""
    # Pixels of weight 0 must not show in SSIM's windows at other pixels either.
    target = jnp.where(weight[..., None] > 0, target_rgb, jax.lax.stop_gradient(seen))
    difference = _weighted_mean(jnp.mean(jnp.abs(seen - target), axis=-1), weight)
    similarity = ssim(seen, target, weight=weight)
    dissimilarity = jnp.where(jnp.isnan(similarity), 0, 1 - similarity)
    return (1 - ssim_weight) * difference + ssim_weight * dissimilarity


def _match_colors(seen, target_rgb, weight, ridge):
    """Rendered colors after the affine map that takes them closest to the target."""
    matrix, offset = fit_colors(jax.lax.stop_gradient(seen), target_rgb, weight, ridge=ridge)
    any_weight = jnp.sum(weight) > 0
    matrix = jnp.where(any_weight, matrix, jnp.eye(3, dtype=matrix.dtype))
    return change_colors(seen, matrix, jnp.where(any_weight, offset, 0))
