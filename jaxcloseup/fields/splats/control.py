"""The contract of density controls, a record of pure functions, and helpers of all schemes.

Every scheme works at a fixed capacity, so no array changes shape.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.geometry.cameras import Camera


class DensityControl(NamedTuple):
    """How one scheme moves, adds and removes surfels; the defaults change nothing.

    Attributes:
      init: `(surfels) -> surfels`, adds the scheme's own parameters to the initial surfels.
      wrap_optimizer: `(optimizer) -> optimizer`, adds the scheme's own records of gradients.
      before_render: `(surfels, camera) -> surfels`, called on the surfels of every rendering.
      adapt: `(key, state) -> state`, called on the `TrainState` after every step; consumes `key`.
    """

    init: Callable[[Surfels], Surfels] = lambda surfels: surfels
    wrap_optimizer: Callable[[optax.GradientTransformation], optax.GradientTransformation] = (
        lambda optimizer: optimizer
    )
    before_render: Callable[[Surfels, Camera], Surfels] = lambda surfels, camera: surfels
    adapt: Callable[[jax.Array, Any], Any] = lambda key, state: state


def is_due(step: jax.Array, *, every: int, start: int, stop: int) -> jax.Array:
    """Return whether a step `[]` is a multiple of `every` after `start` and before `stop`."""
    due = (step % every == 0) & (step > start)
    return due & (step < stop)


def replace_surfels(state: Any, surfels: Surfels, alive: jax.Array, changed: jax.Array) -> Any:
    """Return the state with new surfels; the optimizer's records of changed surfels become 0.

    Args:
      state: a `TrainState`.
      surfels: `N` surfels.
      alive: `[N]` bool.
      changed: `[N]` bool.
    """

    def forget(leaf: jax.Array) -> jax.Array:
        # Scalars, such as Adam's count, and other records are not per surfel.
        if leaf.ndim == 0 or leaf.shape[0] != changed.shape[0]:
            return leaf
        return jnp.where(changed.reshape(-1, *(1,) * (leaf.ndim - 1)), 0, leaf)

    return state.replace(
        params=surfels,
        buffers=state.buffers.replace(alive=alive),
        opt_state=jax.tree.map(forget, state.opt_state),
    )
