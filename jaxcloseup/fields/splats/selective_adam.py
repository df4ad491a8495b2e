"""Adam that leaves surfels out of sight alone, as gsplat's selective Adam does.

A window shows a small part of a scene. Adam would move the other surfels on, by what it remembers
of older gradients, and forget how large these were.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxcloseup.fields.splats.surfels import Surfels


class SelectiveAdamState(NamedTuple):
    """Moments of the gradients of N surfels.

    Attributes:
      count: `[N]` int32 steps in which each was seen.
      mu: mean of its gradients.
      nu: mean of their squares.
    """

    count: jax.Array  # type: ignore[assignment]  # hides tuple.count, as in states of optax
    mu: optax.Updates
    nu: optax.Updates


def scale_by_selective_adam(
    b1: float = 0.9, b2: float = 0.999, eps: float = 1e-15
) -> optax.GradientTransformation:
    """Return Adam (Kingma and Ba 2015) that updates each surfel only in steps that see it.

    A surfel is seen where its color or its place has a gradient: the color of one that is black
    has none, since it is held at 0. Each counts its own steps, which correct the
    bias of its moments, so that surfels may be added at any time.
    """

    def init(params: Surfels) -> SelectiveAdamState:
        zeros = jax.tree.map(jnp.zeros_like, params)
        return SelectiveAdamState(jnp.zeros(params.means.shape[0], jnp.int32), zeros, zeros)

    def update(
        gradients: Surfels, state: SelectiveAdamState, params: Surfels | None = None
    ) -> tuple[Surfels, SelectiveAdamState]:
        del params
        # Priors have gradients of opacities and scales for every surfel, of these for none.
        seen = jnp.any(gradients.sh != 0, axis=(1, 2)) | jnp.any(gradients.means != 0, axis=1)
        count = state.count + seen.astype(jnp.int32)

        def rows(values: jax.Array, like: jax.Array) -> jax.Array:
            return values.reshape(-1, *(1,) * (like.ndim - 1))

        def moment(old: jax.Array, new: jax.Array, decay: float) -> jax.Array:
            return jnp.where(rows(seen, old), decay * old + (1 - decay) * new, old)

        def step(mu: jax.Array, nu: jax.Array) -> jax.Array:
            times = rows(jnp.maximum(count, 1), mu).astype(mu.dtype)
            mean, square = mu / (1 - b1**times), nu / (1 - b2**times)
            return jnp.where(rows(seen, mu), mean / (jnp.sqrt(square) + eps), 0)

        mu = jax.tree.map(lambda old, g: moment(old, g, b1), state.mu, gradients)
        nu = jax.tree.map(lambda old, g: moment(old, g * g, b2), state.nu, gradients)
        return jax.tree.map(step, mu, nu), SelectiveAdamState(count, mu, nu)

    return optax.GradientTransformation(init, update)
