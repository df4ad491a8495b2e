"""The state that training changes, and how the mean gradient of a step's draws changes it."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.training.parallel import Spread
from jaxcloseup.training.sampling import DrawKeys, draw_keys


Metrics = dict[str, jax.Array]


class DrawLoss(NamedTuple):
    """The loss of one draw of a step.

    Attributes:
      draw: `(keys, data) -> drawn`, draws at random what the step looks at.
      gradient: `(params, buffers, drawn) -> (loss, metrics), gradients` by the parameters.
      cameras: `(drawn) -> cameras`, all that the loss renders.
    """

    draw: Callable[[DrawKeys, Any], Any]
    gradient: Callable[[Any, Any, Any], tuple[tuple[jax.Array, Metrics], Any]]
    cameras: Callable[[Any], tuple[Camera, ...]]


class TrainState(struct.PyTreeNode):
    """Everything a step changes. Steps draw from `fold_in(key, step)`, so a resumed run repeats.

    Attributes:
      step: `[]` int32 steps taken.
      params: what the optimizer trains.
      buffers: what the field keeps besides.
      opt_state: the optimizer's state.
      key: the run's key, never changed.
    """

    step: jax.Array
    params: Any
    buffers: Any
    opt_state: Any
    key: jax.Array


def init_state(
    key: jax.Array,
    points: jax.Array,
    rgb: jax.Array,
    *,
    field: RadianceField,
    optimizer: optax.GradientTransformation,
) -> TrainState:
    """Return the state before the first step; `key` is consumed.

    Args:
      key: random key.
      points: `[P, 3]` initial points, for fields that start from them.
      rgb: `[P, 3]` their colors.
      field: static; field to train.
      optimizer: static.
    """
    key_init, key_steps = jax.random.split(key)
    params, buffers = field.init(key_init, points, rgb)
    return TrainState(jnp.zeros((), jnp.int32), params, buffers, optimizer.init(params), key_steps)


def update_state(
    state: TrainState,
    of_draw: DrawLoss,
    data: Any,
    *,
    field: RadianceField,
    optimizer: optax.GradientTransformation,
    draws: int,
    spread: Spread,
    lr_scale: jax.Array | None = None,
    local: bool = False,
) -> tuple[TrainState, Metrics]:
    """Take one optimizer step along the mean gradient of the draws' losses.

    Args:
      state: training state.
      of_draw: what one draw looks at, and its loss.
      data: what all draws read.
      field: static; its `adapt` follows the update.
      optimizer: static.
      draws: static; how many there are.
      spread: how several draws are taken.
      lr_scale: `[]` factor on the optimizer's updates; None: 1.
      local: static; touch only what the step sees, where the field has `local`: for one draw,
        outside of `jax.jit`, of a state that `field.local.prepare` made.

    Returns:
      The next state and the metrics, as in `train_step`.
    """
    keys, key_adapt = draw_keys(state.key, state.step, draws)
    scale = jnp.ones(()) if lr_scale is None else lr_scale
    advance = functools.partial(_advance, update=optimizer.update)
    if local and field.local is not None:
        drawn = of_draw.draw(keys, data)
        part, place = field.local.take(state, of_draw.cameras(drawn))
        (value, metrics), gradients = of_draw.gradient(part.params, part.buffers, drawn)
        part, skipped = advance(part, key_adapt, value, gradients, scale, adapt=field.local.adapt)
        after = field.local.put(key_adapt, state, part, place)
        return after, {"loss": value, "skipped": skipped} | metrics

    def gradient(keys: DrawKeys, shared: tuple[Any, Any, Any]) -> Any:
        params, buffers, data = shared
        return of_draw.gradient(params, buffers, of_draw.draw(keys, data))

    shared = state.params, state.buffers, data
    found = spread(gradient, keys, shared) if draws > 1 else gradient(keys, shared)
    (value, metrics), gradients = found
    after, skipped = advance(state, key_adapt, value, gradients, scale, adapt=field.adapt)
    return after, {"loss": value, "skipped": skipped} | metrics


# Compiled by itself for fields that render whole images: all kinds of steps share it.
@functools.partial(jax.jit, static_argnames=("update", "adapt"))
def _advance(
    state: Any,
    key: jax.Array,
    value: jax.Array,
    gradients: Any,
    lr_scale: jax.Array,
    *,
    update: Callable[..., Any],
    adapt: Callable[..., Any],
) -> tuple[TrainState, jax.Array]:
    """Return the state after a step, and whether the step was skipped, 0 or 1.

    A step whose loss or gradient is not finite must not spoil the run: it is skipped, whole, and
    counted.
    """
    finite = jnp.isfinite(value)
    for leaf in jax.tree.leaves(gradients):
        finite &= jnp.all(jnp.isfinite(leaf))

    updates, opt_state = update(gradients, state.opt_state, state.params)
    updates = jax.tree.map(lambda leaf: lr_scale.astype(leaf.dtype) * leaf, updates)
    new = optax.apply_updates(state.params, updates), opt_state
    # Selected, not in a branch of a conditional, which would copy everything once more.
    params, opt_state = jax.tree.map(
        lambda new, old: jnp.where(finite, new, old), new, (state.params, state.opt_state)
    )
    moved = state.replace(step=state.step + 1, params=params, opt_state=opt_state)

    def changed(state: TrainState) -> tuple[Any, Any, Any]:
        return state.params, state.buffers, state.opt_state

    params, buffers, opt_state = jax.lax.cond(
        finite, lambda: changed(adapt(key, moved)), lambda: changed(moved)
    )
    after = moved.replace(params=params, buffers=buffers, opt_state=opt_state)
    return after, 1 - finite.astype(jnp.float32)
