"""Adaptive density control (Kerbl et al. 2023) for 2-D Gaussian splatting, at fixed capacity.

Where the loss has a large gradient with respect to a surfel's image, the scene needs more surfels:
small surfels are cloned, large ones split in two. Faint and huge surfels are removed, and all
opacities are lowered now and then, so that needless surfels fade. New surfels take free rows; when
rows run out, the surfels with the largest gradient come first.

Two things differ from the published code: the gradient includes the shares of the low-pass filter
and of view-dependent color, and views in which it is 0 do not count.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxcloseup.fields.splats.config import AdaptiveConfig
from jaxcloseup.fields.splats.control import DensityControl, is_due, replace_surfels
from jaxcloseup.fields.splats.filters import kept_opacity
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.numerics import matmul, safe_norm
from jaxcloseup.geometry.rotations import quaternion_to_matrix


class OffsetSurfels(Surfels):
    """Surfels with an image-plane offset: a parameter that stays 0 and whose gradient is recorded.

    Attributes:
      image_offset: `[N, 2]` shift of the center's image (x, y) in units of half an image: a shift
        from -1 to 1 crosses the whole image.
    """

    image_offset: jax.Array


class ImageGradientState(struct.PyTreeNode):
    """The 2-D gradient that surfels accumulated since the last refinement."""

    total: jax.Array  # `[N]` sum of the norms of the image offset's gradient
    views: jax.Array  # `[N]` number of views in which that gradient was not 0


def adaptive_control(
    config: AdaptiveConfig, *, extent: float, means_lr: Callable[[jax.Array], jax.Array]
) -> DensityControl:
    """Return refinement and resets of opacity when they are due; see `density_control`.

    The wrapped optimizer's state must start with that of `optax.scale_by_adam`.
    """
    del means_lr

    def wrap_optimizer(optimizer: optax.GradientTransformation) -> optax.GradientTransformation:
        return optax.chain(record_image_gradients(), optimizer)

    def adapt(key: jax.Array, state: Any) -> Any:
        due = is_due(state.step, every=config.every, start=config.start, stop=config.stop)
        reset_due = is_due(state.step, every=config.reset_every, start=0, stop=config.stop)
        state = jax.lax.cond(
            due, lambda state: _refine(key, state, config, extent), lambda state: state, state
        )
        return jax.lax.cond(
            reset_due, lambda state: _reset(state, config), lambda state: state, state
        )

    return DensityControl(
        init=with_image_offset,
        wrap_optimizer=wrap_optimizer,
        before_render=apply_image_offset,  # type: ignore[arg-type]  # of what `init` returns
        adapt=adapt,
    )


def with_image_offset(surfels: Surfels) -> OffsetSurfels:
    """Return the same surfels with an image-plane offset of 0."""
    leaves = {f.name: getattr(surfels, f.name) for f in dataclasses.fields(Surfels)}
    return OffsetSurfels(**leaves, image_offset=jnp.zeros_like(surfels.means[:, :2]))


def apply_image_offset(surfels: OffsetSurfels, camera: Camera) -> OffsetSurfels:
    """Shift surfels parallel to the image plane by their image offset.

    The offset is 0, so the surfels stay in place, but the loss has a gradient with respect to it:
    the view-space gradient of Kerbl et al. (section 5.2), which no array of the renderer holds.
    """
    # Only the offset's gradient matters here, not a second path to the means.
    offset = jax.lax.stop_gradient(surfels.means) - camera.position[None]
    depth = matmul(offset, camera.rotation)[:, 2:]
    half_image = jnp.array([[camera.width / 2, camera.height / 2]], depth.dtype)
    moved = surfels.image_offset * half_image * depth / camera.intrinsics[None, :2]
    return surfels.replace(means=surfels.means + matmul(moved, camera.rotation[:, :2].T))


def record_image_gradients() -> optax.GradientTransformation:
    """Accumulate the image offset's gradient in the optimizer's state; leave updates unchanged."""

    def init(params: OffsetSurfels) -> ImageGradientState:
        zeros = jnp.zeros(params.image_offset.shape[0], params.image_offset.dtype)
        return ImageGradientState(zeros, zeros)

    def update(
        updates: OffsetSurfels, state: ImageGradientState, params: OffsetSurfels | None = None
    ) -> tuple[OffsetSurfels, ImageGradientState]:
        del params
        # The norm of each view's gradient: summed vectors of opposite views would cancel.
        norm = safe_norm(updates.image_offset)
        return updates, ImageGradientState(state.total + norm, state.views + (norm > 0))

    return optax.GradientTransformation(init, update)


def refine(
    key: jax.Array,
    surfels: OffsetSurfels,
    alive: jax.Array,
    gradients: ImageGradientState,
    config: AdaptiveConfig,
    *,
    extent: float,
    remove_huge: jax.Array,
) -> tuple[OffsetSurfels, jax.Array, jax.Array, jax.Array]:
    """Clone, split and remove surfels.

    A clone is an exact copy. Two surfels replace a split one; their centers are drawn from its
    Gaussian in its plane or in space and their scales are smaller by `config.shrink`.

    Args:
      key: random key; consumed.
      surfels: `N` surfels.
      alive: `[N]` bool.
      gradients: the 2-D gradients accumulated since the last refinement.
      config: static.
      extent: size of the capture in world units.
      remove_huge: `[]` bool, whether surfels larger than `config.huge` are removed.

    Returns:
      Surfels, `alive [N]`, `[N]` bool, True where a surfel is new and the optimizer must forget its
      row, and the row `[N]` that each comes from.
    """
    scale = jnp.max(jnp.exp(surfels.log_scales), axis=-1) / extent
    # Per view that saw the surfel: surfels out of sight must not look converged.
    mean_gradient = gradients.total / jnp.maximum(gradients.views, 1)
    opaque = alive & (jax.nn.sigmoid(surfels.opacity_logits) >= config.min_opacity)
    growing = opaque & (mean_gradient >= config.gradient)
    # As published: a clone is an exact copy, which later gradients pull away from its original.
    # A huge surfel with a large gradient is split, which makes it smaller.
    keep = opaque & (growing | ~(remove_huge & (scale > config.huge)))
    source, added, parent = _place_copies(growing, keep, mean_gradient)

    # Both halves of a split surfel move: the copy in its new row, and the surfel that was there.
    split = (parent | added) & (scale[source] > config.small)
    surfels = jax.tree.map(lambda leaf: leaf[source], surfels)
    shape = surfels.log_scales.shape
    step = jax.random.normal(key, shape, surfels.means.dtype) * jnp.exp(surfels.log_scales)
    axes = quaternion_to_matrix(surfels.quaternions)[..., : shape[1]]
    moved = surfels.means + jnp.sum(axes * step[:, None], axis=-1)
    surfels = surfels.replace(
        means=jnp.where(split[:, None], moved, surfels.means),
        log_scales=surfels.log_scales - jnp.where(split, jnp.log(config.shrink), 0)[:, None],
    )
    return surfels, keep | added, added | split, source


def _place_copies(
    growing: jax.Array, keep: jax.Array, mean_gradient: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return which row each row copies, which rows are copies, and which are copied, `[N]`.

    Rows that are not kept are free. When they run out, the largest gradients come first.
    """
    count = growing.shape[0]
    strongest = jnp.argsort(jnp.where(growing, -mean_gradient, 1), stable=True)
    room = jnp.argsort(keep, stable=True)
    number = jnp.minimum(jnp.sum(growing), jnp.sum(~keep))
    granted = jnp.arange(count) < number
    place = jnp.where(granted, room, count)  # `count` is out of bounds, so the update is dropped
    source = jnp.arange(count).at[place].set(strongest, mode="drop")
    added = jnp.zeros(count, bool).at[place].set(True, mode="drop")
    parent = jnp.zeros(count, bool).at[jnp.where(granted, strongest, count)].set(True, mode="drop")
    return source, added, parent


def reset_opacities(
    surfels: OffsetSurfels, config: AdaptiveConfig, interval: jax.Array | None = None
) -> OffsetSurfels:
    """Return surfels whose opacities are at most `config.reset_opacity`, as they are drawn.

    Args:
      surfels: `N` surfels.
      config: settings.
      interval: `[N]` of the filter in space, which lowers opacities; None without it.
    """
    # Needless surfels fade between two resets (Kerbl et al., section 5.2); others recover. What is
    # not drawn at all, as a small surfel would be if the filter came on top, would get no gradient.
    most = jnp.full_like(surfels.opacity_logits, config.reset_opacity)
    if interval is not None:
        most = jnp.minimum(most / kept_opacity(surfels, interval), 1 - 1e-6)
    logits = jnp.log(most) - jnp.log1p(-most)
    return surfels.replace(opacity_logits=jnp.minimum(surfels.opacity_logits, logits))


def _refine(key: jax.Array, state: Any, config: AdaptiveConfig, extent: float) -> Any:
    """Return a state whose surfels are refined and whose 2-D gradients accumulate anew."""
    gradients, adam = state.opt_state
    surfels, alive, changed, source = refine(
        key,
        state.params,
        state.buffers.alive,
        gradients,
        config,
        extent=extent,
        remove_huge=state.step > config.reset_every,
    )
    zeros, buffers = jax.tree.map(jnp.zeros_like, gradients), state.buffers
    if buffers.interval is not None:  # a reset in the same step needs those of new surfels
        buffers = buffers.replace(interval=buffers.interval[source])
    return replace_surfels(
        state.replace(opt_state=(zeros, adam), buffers=buffers), surfels, alive, changed
    )


def _reset(state: Any, config: AdaptiveConfig) -> Any:
    """Return a state whose opacities are reset, with Adam's moments of the opacities."""
    # Old moments would at once carry the opacities back up.
    gradients, (moments, *others) = state.opt_state
    mu, nu = (
        moment.replace(opacity_logits=jnp.zeros_like(moment.opacity_logits))
        for moment in (moments.mu, moments.nu)
    )
    return state.replace(
        params=reset_opacities(state.params, config, state.buffers.interval),
        opt_state=(gradients, (moments._replace(mu=mu, nu=nu), *others)),
    )
