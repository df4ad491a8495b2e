"""Splats as a radiance field: trainable 2-D Gaussian splatting (Huang et al., SIGGRAPH 2024).

With a `GaussianConfig` it is 3-D Gaussian splatting (Kerbl et al., SIGGRAPH 2023), whose Gaussians
are called surfels below too. The field renders whole images only.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.fields.contract import Local, RadianceField, Rendering
from jaxcloseup.fields.splats.config import (
    AdaptiveConfig,
    GaussianConfig,
    McmcConfig,
    SplatConfig,
    SurfelConfig,
)
from jaxcloseup.fields.splats.control import DensityControl
from jaxcloseup.fields.splats.filters import sampling_intervals, smoothed
from jaxcloseup.fields.splats.local import Bounds, local_steps
from jaxcloseup.fields.splats.render import SurfelAux, render_surfels
from jaxcloseup.fields.splats.splat_loss import depth_loss, penalty_of, prior_of, splat_loss
from jaxcloseup.fields.splats.splat_optimizer import control_of
from jaxcloseup.fields.splats.surfels import Surfels, surfels_from_points
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.numerics import safe_norm


_RENEWED_EVERY = 100  # steps between renewals of sampling intervals without density control


class SurfelBuffers(struct.PyTreeNode):
    """State of the surfel field that is not differentiated.

    Attributes:
      alive: `[N]` bool; dead surfels are not drawn.
      degree: `[]` int32 degree of spherical harmonics that is rendered.
      regularize: `[]` 1 where the normal and distortion losses count, else 0.
      expected: `[]` 1 where `Rendering.depth` is the expected depth, 0 where it is the median.
      interval: `[N]` between the pixels of the photographs that show surfels finest, in world
        units; None without a smoothing filter, see `filters`.
      number: `[]` living surfels in all, where these are a part of them; None: count them.
      hold: `[]` weight of the loss on measured depth; None without that loss.
      bounds: boxes around chunks of surfels, see `local`; None but in local steps.
    """

    alive: jax.Array
    degree: jax.Array
    regularize: jax.Array
    expected: jax.Array
    interval: jax.Array | None = None
    number: jax.Array | None = None
    hold: jax.Array | None = None
    bounds: Bounds | None = None


class SurfelFieldAux(NamedTuple):
    """Private part of the surfel field's renderings.

    Attributes:
      surfels: the `aux` of `render_surfels`.
      penalty: `[H, W]` weighted normal and distortion losses.
      prior: `[]` weighted mean opacity and scale.
      expected_depth: `[H, W]`.
      hold: `[]` weight of the loss on measured depth, or None.
    """

    surfels: SurfelAux
    penalty: jax.Array
    prior: jax.Array
    expected_depth: jax.Array
    hold: jax.Array | None


def surfel_field(
    config: SurfelConfig | GaussianConfig,
    *,
    extent: float,
    center: jax.Array | None = None,
    photographs: Camera | None = None,
) -> RadianceField:
    """Return splats as a field of whole images, with `render`, `loss` and `adapt` compiled.

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
    _check(config, extent)
    field = _SplatField(config, extent, center, photographs, control_of(config, extent))
    # Compiled here, for callers render eagerly too, and every kind of step that a program compiles
    # then traces these parts once.
    draw = jax.jit(field.draw)

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

    loss = jax.jit(functools.partial(splat_loss, config=config))
    return RadianceField(
        init=field.init,
        render=render,
        loss=loss,
        adapt=jax.jit(field.adapt),
        depth_loss=depth_loss if config.depth_weight else None,
        local=field.local(),
    )


def _check(config: SplatConfig, extent: float) -> None:
    if config.depth not in ("median", "expected"):
        raise ValueError(f'SurfelConfig.depth must be "median" or "expected", not "{config.depth}"')
    if config.max_scale is not None and not config.max_scale > 0:
        raise ValueError(f"SurfelConfig.max_scale must be positive or None, not {config.max_scale}")
    if not extent > 0:
        raise ValueError(f"extent must be a positive length, not {extent}")


@dataclasses.dataclass(frozen=True, eq=False)
class _SplatField:
    """What the functions of one field share; see `surfel_field`."""

    config: SplatConfig
    extent: float
    center: jax.Array | None
    photographs: Camera | None
    control: DensityControl

    def init(
        self, key: jax.Array, points: jax.Array, rgb: jax.Array
    ) -> tuple[Surfels, SurfelBuffers]:
        config = self.config
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
        degree, regularize, hold = _schedule(config, jnp.zeros((), jnp.int32))
        buffers = SurfelBuffers(
            alive, degree, regularize, expected, interval=self.intervals(surfels), hold=hold
        )
        return self.control.init(surfels), buffers

    def intervals(self, surfels: Surfels) -> jax.Array | None:
        if self.photographs is None:
            return None
        return sampling_intervals(surfels.means, self.photographs, near=self.config.raster.near)

    def draw(self, params: Surfels, buffers: SurfelBuffers, camera: Camera) -> Rendering:
        config = self.config
        surfels = self.control.before_render(_limit_degree(params, buffers.degree), camera)
        surfels = smoothed(surfels, buffers.interval)
        background = None if config.background is None else jnp.full(3, config.background)
        image = render_surfels(surfels, buffers.alive, camera, config.raster, background=background)
        # The penalty is computed here, for `loss` knows no camera.
        penalty = buffers.regularize * penalty_of(image, camera, config)
        # Priors act on the parameters, not on what the filter makes of them.
        prior = prior_of(params, buffers.alive, config, self.extent, buffers.number)
        return image._replace(
            depth=jnp.where(buffers.expected > 0, image.depth, image.aux.median_depth),
            aux=SurfelFieldAux(image.aux, penalty, prior, image.depth, buffers.hold),
        )

    def adapt(self, key: jax.Array, state: Any) -> Any:
        state = self.control.adapt(key, self.follow_schedule(state))
        state = self.bound_scales(state)
        return state if self.photographs is None else self.renew_intervals(state)

    def follow_schedule(self, state: Any) -> Any:
        degree, regularize, hold = _schedule(self.config, state.step)
        buffers = state.buffers.replace(degree=degree, regularize=regularize, hold=hold)
        return state.replace(buffers=buffers)

    def bound_scales(self, state: Any) -> Any:
        surfels = _bound_scales(state.params, self.config, self.extent, self.center)
        return state.replace(params=surfels)

    def local(self) -> Local | None:
        """Return how steps touch a part of the surfels, if they leave the others as they are."""
        config = self.config
        density: Any = config.density
        noise = isinstance(density, McmcConfig) and density.noise > 0
        if not config.selective_adam or noise or isinstance(density, AdaptiveConfig):
            return None
        every = _RENEWED_EVERY if density is None else density.every

        def adapt(key: jax.Array, part: Any) -> Any:
            del key
            return self.bound_scales(self.follow_schedule(part))

        return local_steps(
            config.capacity,
            near=config.raster.near,
            adapt=jax.jit(adapt),
            adapt_all=jax.jit(self.adapt),
            is_due=lambda step: step % every == 0,
        )

    def renew_intervals(self, state: Any) -> Any:
        """Renew sampling intervals after every density control, which moves surfels far."""
        density: Any = self.config.density
        due = state.step % (_RENEWED_EVERY if density is None else density.every) == 0
        old, params = state.buffers.interval, state.params
        new = jax.lax.cond(due, lambda: self.intervals(params), lambda: old)
        return state.replace(buffers=state.buffers.replace(interval=new))


def with_expected_depth(buffers: SurfelBuffers, expected: bool) -> SurfelBuffers:
    """Return buffers with which the field renders the expected or the median depth."""
    return buffers.replace(expected=jnp.full_like(buffers.expected, expected))


def camera_extent(cameras: Camera) -> jax.Array:
    """Return the size `[]` of a capture: 1.1 times the cameras' largest distance to their mean.

    Args:
      cameras: stacked `[V]`; a single camera has extent 0.
    """
    offset = cameras.position - jnp.mean(cameras.position, axis=0, keepdims=True)
    return 1.1 * jnp.max(jnp.linalg.norm(offset, axis=-1))


def _schedule(
    config: SplatConfig, step: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Return the buffers `degree`, `regularize` and `hold` after so many steps."""
    degree = jnp.minimum(step // config.sh_every, config.sh_degree).astype(jnp.int32)
    regularize = (step >= config.regularize_from).astype(jnp.float32)
    return degree, regularize, depth_hold(config, step)


def depth_hold(config: SplatConfig, step: jax.Array) -> jax.Array | None:
    """Return the weight `[]` of the loss on measured depth after so many steps, or None."""
    if not config.depth_weight:
        return None
    left = jnp.maximum(1 - step.astype(jnp.float32) / config.means_lr_steps, config.depth_kept)
    return config.depth_weight * left


def _bound_scales(
    surfels: Surfels, config: SplatConfig, extent: float, center: jax.Array | None
) -> Surfels:
    """Return surfels no larger than the config allows."""
    if config.max_scale is None:
        return surfels
    reach: jax.Array | float = extent
    if center is not None:
        distance = safe_norm(surfels.means - center[None], keepdims=True)
        reach = jnp.maximum(distance, extent)
    # Beyond the extent the bound is an angle, so that a distant background may be large.
    largest = jnp.log(config.max_scale * reach)
    return surfels.replace(log_scales=jnp.minimum(surfels.log_scales, largest))


def _limit_degree(surfels: Surfels, degree: jax.Array) -> Surfels:
    """Return surfels without spherical harmonics above a degree `[]`."""
    # Degree l has 2 l + 1 functions. Coefficients above the degree keep their values, unseen.
    band = jnp.repeat(jnp.arange(4), jnp.array([1, 3, 5, 7]), total_repeat_length=16)
    drawn = (band[: surfels.sh.shape[1]] <= degree)[None, :, None]
    return surfels.replace(sh=jnp.where(drawn, surfels.sh, 0))
