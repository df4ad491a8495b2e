"""The optimizer of splats: a learning rate for each kind of parameter."""

import jax
import jax.numpy as jnp
import optax

from jaxcloseup.fields.splats.config import SplatConfig
from jaxcloseup.fields.splats.control import DensityControl
from jaxcloseup.fields.splats.density import density_control
from jaxcloseup.fields.splats.selective_adam import scale_by_selective_adam
from jaxcloseup.fields.splats.surfels import Surfels


def surfel_optimizer(config: SplatConfig, *, extent: float) -> optax.GradientTransformation:
    """Return Adam with one learning rate for each kind of parameter, and the control's records.

    Args:
      config: static.
      extent: size of the capture in world units.
    """
    moments = scale_by_selective_adam if config.selective_adam else optax.scale_by_adam
    # The published epsilon: gradients of means over a whole image are tiny.
    adam = optax.chain(moments(eps=1e-15), _scale_by_learning_rates(config, extent))
    return control_of(config, extent).wrap_optimizer(adam)


def control_of(config: SplatConfig, extent: float) -> DensityControl:
    """Return the density control of a field, whose noise follows the means' learning rate."""

    def means_lr(step: jax.Array) -> jax.Array:
        return _late_lr_scale_at(config, step) * means_lr_at(config, step) * extent

    return density_control(config.density, extent=extent, means_lr=means_lr)


def means_lr_at(config: SplatConfig, step: jax.Array) -> jax.Array:
    """Return the learning rate `[]` of the means at a step, in extents, without `late_lr_scale`."""
    first, last = config.means_lr
    share = jnp.minimum(step.astype(jnp.float32) / config.means_lr_steps, 1)
    return first * (last / first) ** share


def _late_lr_scale_at(config: SplatConfig, step: jax.Array) -> jax.Array:
    return jnp.where(step < config.means_lr_steps, 1, config.late_lr_scale)


def _scale_by_learning_rates(config: SplatConfig, extent: float) -> optax.GradientTransformation:
    def init(params: Surfels) -> optax.OptState:
        del params
        return optax.ScaleByScheduleState(count=jnp.zeros((), jnp.int32))

    def update(
        updates: Surfels, state: optax.OptState, params: Surfels | None = None
    ) -> tuple[Surfels, optax.OptState]:
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
