"""Surfels as a radiance field: 2-D Gaussian splatting (Huang et al., SIGGRAPH 2024), trainable.

Whole images only. Normals are pulled towards the surface and light along a ray to one depth, with
weights that depend on no unit of length; density is controlled at a fixed capacity.
"""

import dataclasses
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxcloseup.field import RadianceField, Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.metrics import fit_colors, ssim
from jaxcloseup.numerics import matmul, safe_divide
from jaxcloseup.splats.adaptive import (
    AdaptiveConfig,
    ProbedSurfels,
    apply_probe,
    measure_pull,
    refine,
    reset_opacities,
    with_probe,
)
from jaxcloseup.splats.mcmc import McmcConfig, relocate, wander
from jaxcloseup.splats.rasterize import RasterizeConfig
from jaxcloseup.splats.regularizers import (
    depth_to_normal,
    normal_inconsistency,
    scale_free_distortion,
)
from jaxcloseup.splats.render import SurfelAux, render_surfels
from jaxcloseup.splats.surfels import Surfels, surfels_from_points


_UNCHANGED_SHARE = 0.3  # of the loss of colors as they are, where images may change them


@dataclasses.dataclass(frozen=True)
class SurfelConfig:
    """Surfels and their training; lengths are in extents of the capture.

    Attributes:
      capacity: how many surfels there can be.
      sh_degree: of the color's spherical harmonics.
      sh_every: steps after which one more degree is drawn.
      initial_opacity: of surfels at the initial points.
      depth: "median" or "expected": what the field calls depth, labels are made with, and normals
        are held against; arms of a sweep may have labels from the other.
      background: gray level in [0, 1] behind the scene; None is black.
      color_ridge: in training each image may change its colors by an affine map, to which this
        is the resistance, see `fit_colors`; None allows none. Rendered images have no such change:
        a part of the loss holds their colors to the photographs' as they are.
      ssim_weight: share of 1 - SSIM in the loss; the rest is the absolute difference.
      normal_weight: of the disagreement between normals and depth.
      distortion_weight: of the spread of light along a ray, for a mean depth of 1.
      regularize_from: step from which these two count.
      opacity_weight: of the mean opacity.
      scale_weight: of the mean scale.
      means_lr: learning rate of the means, first and at `decay_steps`.
      decay_steps: see `means_lr`; it stays there.
      late_lr_scale: factor on all learning rates from `decay_steps` on.
      sh_lr, opacity_lr, scale_lr, rotation_lr: Adam's; 1/20 of `sh_lr` for what depends
        on the direction.
      density: when surfels move, appear and vanish, by either rule; None for never.
      raster: static sizes of the rasterizer.
    """

    capacity: int = 200_000
    sh_degree: int = 3
    sh_every: int = 1000
    initial_opacity: float = 0.5
    depth: str = "median"
    background: float | None = None
    color_ridge: float | None = None
    ssim_weight: float = 0.2
    normal_weight: float = 0.05
    distortion_weight: float = 1.0
    regularize_from: int = 3000
    opacity_weight: float = 0.01
    scale_weight: float = 0.01
    means_lr: tuple[float, float] = (1.6e-4, 1.6e-6)
    decay_steps: int = 30_000
    late_lr_scale: float = 1.0
    sh_lr: float = 2.5e-3
    opacity_lr: float = 5e-2
    scale_lr: float = 5e-3
    rotation_lr: float = 1e-3
    density: McmcConfig | AdaptiveConfig | None = dataclasses.field(default_factory=McmcConfig)
    raster: RasterizeConfig = dataclasses.field(default_factory=RasterizeConfig)


@struct.dataclass
class SurfelBuffers:
    """What surfels keep beside their parameters.

    Attributes:
      alive: `[N]` bool.
      degree: `[]` int32 degree of spherical harmonics that is drawn.
      regularize: `[]` 1 once regularizers count, before that 0.
      expected: `[]` 1 where the expected depth is what the field calls depth, 0 where the median.
    """

    alive: jax.Array
    degree: jax.Array
    regularize: jax.Array
    expected: jax.Array


class SurfelFieldAux(NamedTuple):
    """What else the field renders.

    Attributes:
      surfels: of `render_surfels`.
      penalty: `[H, W]` the regularizers of each pixel.
      prior: `[]` the regularizers of opacities and scales.
    """

    surfels: SurfelAux
    penalty: jax.Array
    prior: jax.Array


def surfel_field(config: SurfelConfig, *, extent: float) -> RadianceField:
    """Surfels as a field of whole images.

    Args:
      config: static.
      extent: size of the capture in world units, such as `camera_extent`.

    Raises:
      ValueError: a setting is out of range.
    """
    if config.depth not in ("median", "expected"):
        raise ValueError(f'SurfelConfig.depth is "median" or "expected", not "{config.depth}"')
    if not extent > 0:
        raise ValueError(f"extent must be a positive length, not {extent}")

    def init(key: jax.Array, points: jax.Array, rgb: jax.Array) -> tuple[Surfels, SurfelBuffers]:
        surfels, alive = surfels_from_points(
            key,
            points,
            rgb,
            capacity=config.capacity,
            sh_degree=config.sh_degree,
            opacity=config.initial_opacity,
        )
        if isinstance(config.density, AdaptiveConfig):
            surfels = with_probe(surfels)
        expected = jnp.float32(config.depth == "expected")
        schedule = _schedule(config, jnp.zeros((), jnp.int32))
        return surfels, SurfelBuffers(alive, *schedule, expected)

    def render(
        params: Surfels,
        buffers: SurfelBuffers,
        camera: Camera,
        pixels: jax.Array | None,
        key: jax.Array | None,
    ) -> Rendering:
        del key  # nothing is random
        if pixels is not None:
            raise ValueError("surfels render whole images: pixels must be None")
        band = jnp.repeat(jnp.arange(4), jnp.array([1, 3, 5, 7]), total_repeat_length=16)
        drawn = (band[: params.sh.shape[1]] <= buffers.degree)[None, :, None]
        surfels = params.replace(sh=jnp.where(drawn, params.sh, 0))
        if isinstance(surfels, ProbedSurfels):
            surfels = apply_probe(surfels, camera)
        background = None if config.background is None else jnp.full(3, config.background)
        image = render_surfels(surfels, buffers.alive, camera, config.raster, background=background)
        median, expected = image.aux.median_depth, image.depth
        surface = median if config.depth == "median" else expected

        inconsistency = normal_inconsistency(
            image.aux.normal, depth_to_normal(camera, surface), image.alpha
        )
        typical = safe_divide(jnp.sum(image.alpha * image.depth), jnp.sum(image.alpha))
        distortion = scale_free_distortion(image.aux.distortion, jax.lax.stop_gradient(typical))
        # Of what is right before a camera, in views that nobody took, it has no bound.
        distortion = distortion / (1 + distortion)
        penalty = config.normal_weight * inconsistency + config.distortion_weight * distortion
        number = jnp.sum(buffers.alive, dtype=image.rgb.dtype)

        def mean(values):
            return safe_divide(jnp.sum(jnp.where(buffers.alive, values, 0)), number)

        opacity = mean(jax.nn.sigmoid(params.opacity_logits))
        scale = mean(jnp.mean(jnp.exp(params.log_scales), axis=-1)) / extent
        prior = config.opacity_weight * opacity + config.scale_weight * scale
        aux = SurfelFieldAux(image.aux, buffers.regularize * penalty, prior)
        depth = jnp.where(buffers.expected > 0, expected, median)
        return Rendering(image.rgb, depth, image.alpha, aux)

    def loss(
        rendering: Rendering, target_rgb: jax.Array, weight: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        return _loss(rendering, target_rgb, weight, config)

    def adapt(key: jax.Array, state: Any) -> Any:
        return _adapt(key, state, config, extent)

    return RadianceField(init=init, render=render, loss=loss, adapt=adapt)


def camera_extent(cameras: Camera) -> jax.Array:
    """Size `[]` of a capture in world units: 1.1 times the reach of its cameras from their middle.

    Args:
      cameras: stacked `[V]`; of a single camera the extent is 0.
    """
    offset = cameras.position - jnp.mean(cameras.position, axis=0, keepdims=True)
    return 1.1 * jnp.max(jnp.linalg.norm(offset, axis=-1))


def surfel_optimizer(config: SurfelConfig, *, extent: float) -> optax.GradientTransformation:
    """Adam with a learning rate for each kind of parameter, that of the means decaying."""

    def init(params):
        del params
        return optax.ScaleByScheduleState(count=jnp.zeros((), jnp.int32))

    def update(updates, state, params=None):
        del params
        by_band = jnp.full(updates.sh.shape[1], config.sh_lr / 20).at[0].set(config.sh_lr)
        rates = jax.tree.map(lambda leaf: 0.0, updates).replace(
            means=means_lr(config, state.count) * extent,
            log_scales=config.scale_lr,
            quaternions=config.rotation_lr,
            opacity_logits=config.opacity_lr,
            sh=by_band[None, :, None],
        )
        late = _late(config, state.count)
        updates = jax.tree.map(lambda rate, update: -late * rate * update, rates, updates)
        return updates, optax.ScaleByScheduleState(count=state.count + 1)

    rescale = optax.GradientTransformation(init, update)
    adam = optax.chain(optax.scale_by_adam(eps=1e-15), rescale)
    if isinstance(config.density, AdaptiveConfig):
        return optax.chain(measure_pull(), adam)
    return adam


def _late(config, step):
    return jnp.where(step < config.decay_steps, 1, config.late_lr_scale)


def means_lr(config: SurfelConfig, step: jax.Array) -> jax.Array:
    """Learning rate of the means at a step, in extents: from first to last along an exponential."""
    first, last = config.means_lr
    share = jnp.minimum(step.astype(jnp.float32) / config.decay_steps, 1)
    return first * (last / first) ** share


def _loss(rendering, target_rgb, weight, config):
    chex.assert_equal_shape([rendering.rgb, target_rgb])
    chex.assert_shape(weight, target_rgb.shape[:-1])
    total = jnp.sum(weight)

    def mean(values):
        return safe_divide(jnp.sum(weight * values), total)

    # What weighs nothing must not show in windows beside it either.
    counts = weight[..., None] > 0

    def distance(seen):
        target = jnp.where(counts, target_rgb, jax.lax.stop_gradient(seen))
        difference = mean(jnp.mean(jnp.abs(seen - target), axis=-1))
        similarity = ssim(seen, target, weight=weight)
        dissimilarity = jnp.where(jnp.isnan(similarity), 0, 1 - similarity)
        return (1 - config.ssim_weight) * difference + config.ssim_weight * dissimilarity

    seen = rendering.rgb
    image = distance(seen)
    if config.color_ridge is not None:
        data = jax.lax.stop_gradient(seen), target_rgb, weight
        matrix, offset = fit_colors(*data, ridge=config.color_ridge)
        matrix = jnp.where(total > 0, matrix, jnp.eye(3, dtype=matrix.dtype))
        seen = matmul(seen, matrix[None]) + jnp.where(total > 0, offset, 0)[None, None]
        # Colors that are free in every photograph would drift away from all of them.
        image = _UNCHANGED_SHARE * image + (1 - _UNCHANGED_SHARE) * distance(seen)
    prior = jnp.where(total > 0, rendering.aux.prior, 0)
    off = jnp.where(counts, jnp.clip(seen, 0, 1) - target_rgb, 0)
    squared = mean(jnp.mean(off**2, axis=-1))
    metrics = {
        "psnr": -10 * jnp.log10(squared),
        "overflow": rendering.aux.surfels.overflow.astype(jnp.float32),
    }
    return image + mean(rendering.aux.penalty) + prior, metrics


def _schedule(config, step):
    degree = jnp.minimum(step // config.sh_every, config.sh_degree).astype(jnp.int32)
    return degree, (step >= config.regularize_from).astype(jnp.float32)


def _adapt(key, state, config, extent):
    degree, regularize = _schedule(config, state.step)
    buffers = state.buffers.replace(degree=degree, regularize=regularize)
    state = state.replace(buffers=buffers)
    density = config.density
    if density is None:
        return state
    due = (state.step % density.every == 0) & (state.step > density.start)
    due &= state.step < density.stop
    if isinstance(density, AdaptiveConfig):
        return _adapt_classically(key, state, density, due, extent)
    key_relocate, key_wander = jax.random.split(key)

    def move(state):
        surfels, alive, changed = relocate(key_relocate, state.params, state.buffers.alive, density)
        return _replace_surfels(state, surfels, alive, changed)

    state = jax.lax.cond(due, move, lambda state: state, state)
    rate = _late(config, state.step) * means_lr(config, state.step) * extent
    surfels = wander(key_wander, state.params, state.buffers.alive, rate, density)
    return state.replace(params=surfels)


def _adapt_classically(key, state, density, due, extent):
    def grow(state):
        pull, adam = state.opt_state
        remove_huge = state.step > density.reset_every
        surfels, alive, new = refine(
            key,
            state.params,
            state.buffers.alive,
            pull,
            density,
            extent=extent,
            remove_huge=remove_huge,
        )
        none = jax.tree.map(jnp.zeros_like, pull)
        return _replace_surfels(state.replace(opt_state=(none, adam)), surfels, alive, new)

    def fade(state):
        pull, (moments, rates) = state.opt_state
        mu, nu = (
            moment.replace(opacity_logits=jnp.zeros_like(moment.opacity_logits))
            for moment in (moments.mu, moments.nu)
        )
        return state.replace(
            params=reset_opacities(state.params, density),
            opt_state=(pull, (moments._replace(mu=mu, nu=nu), rates)),
        )

    state = jax.lax.cond(due, grow, lambda state: state, state)
    faded = (state.step % density.reset_every == 0) & (state.step < density.stop) & (state.step > 0)
    return jax.lax.cond(faded, fade, lambda state: state, state)


def _replace_surfels(state, surfels, alive, changed):
    """The state with other surfels, of which the optimizer forgets those that changed."""

    def forget(leaf):
        if leaf.ndim == 0 or leaf.shape[0] != changed.shape[0]:
            return leaf
        return jnp.where(changed.reshape(-1, *(1,) * (leaf.ndim - 1)), 0, leaf)

    return state.replace(
        params=surfels,
        buffers=state.buffers.replace(alive=alive),
        opt_state=jax.tree.map(forget, state.opt_state),
    )
