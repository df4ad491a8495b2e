"""Density control as Markov chain Monte Carlo (Kheradmand et al., NeurIPS 2024).

Surfels that have faded move onto opaque ones, which share their light with the copies, and Gaussian
noise moves all surfels a little, faint ones most. No array changes shape.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.splats.config import McmcConfig
from jaxcloseup.fields.splats.control import DensityControl, is_due, replace_surfels
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.geometry.rotations import quaternion_to_matrix


MAX_COPIES = 51  # largest number of coincident surfels that one surfel becomes at once
_MAX_OPACITY = 1 - 1e-6


def mcmc_control(
    config: McmcConfig, *, extent: float, means_lr: Callable[[jax.Array], jax.Array]
) -> DensityControl:
    """Return relocation when it is due, and position noise after every step."""
    del extent

    def adapt(key: jax.Array, state: Any) -> Any:
        key_relocate, key_noise = jax.random.split(key)

        def move(state: Any) -> Any:
            moved = relocate(key_relocate, state.params, state.buffers.alive, config)
            return replace_surfels(state, *moved)

        due = is_due(state.step, every=config.every, start=config.start, stop=config.stop)
        state = jax.lax.cond(due, move, lambda state: state, state)
        if not config.noise:
            return state
        learning_rate = means_lr(state.step)
        surfels = add_position_noise(
            key_noise, state.params, state.buffers.alive, learning_rate, config
        )
        return state.replace(params=surfels)

    return DensityControl(adapt=adapt)


def relocate(
    key: jax.Array, surfels: Surfels, alive: jax.Array, config: McmcConfig
) -> tuple[Surfels, jax.Array, jax.Array]:
    """Move dead surfels onto living ones and bring new ones to life.

    Where n - 1 surfels join one of opacity o, the n coincident surfels get opacity
    1 - (1 - o)^(1/n) and smaller scales, so that together they absorb as much light, integrated
    over the disc's area, or over the ellipse that a volumetric Gaussian has in an image, as the one
    did. The published rule keeps the integral along a line.

    Args:
      key: random key; consumed.
      surfels: `N` surfels.
      alive: `[N]` bool.
      config: static.

    Returns:
      Surfels, `alive [N]`, and `[N]` bool, True where a surfel changed and the optimizer must
      forget it.
    """
    count = alive.shape[0]
    opacity = jax.nn.sigmoid(surfels.opacity_logits)
    donor = alive & (opacity > config.min_opacity)
    newborn = _newborn(alive, config.growth)
    receiver = ((alive & ~donor) | newborn) & jnp.any(donor)

    # Dead surfels join living ones in proportion to opacity, as published.
    source = _draw_donors(key, jnp.where(donor, opacity, 0), donor)
    copies = jnp.zeros(count, jnp.int32).at[source].add(receiver.astype(jnp.int32))
    copies = jnp.minimum(copies + 1, MAX_COPIES)  # with the donor itself
    thinner, smaller = split_opacity(opacity, copies)
    thinner = jnp.clip(thinner, config.min_opacity, _MAX_OPACITY)
    shared = surfels.replace(
        opacity_logits=jnp.where(
            copies > 1, jnp.log(thinner) - jnp.log1p(-thinner), surfels.opacity_logits
        ),
        log_scales=surfels.log_scales + jnp.where(copies > 1, jnp.log(smaller), 0)[:, None],
    )
    # Copies take every parameter of their donor, after the donor has become one of them.
    index = jnp.where(receiver, source, jnp.arange(count))
    return (
        jax.tree.map(lambda leaf: leaf[index], shared),
        alive | (newborn & receiver),
        receiver | (copies > 1),
    )


def _newborn(alive: jax.Array, growth: float) -> jax.Array:
    """Return the free rows `[N]` that come to life."""
    number = jnp.sum(alive, dtype=jnp.int32)
    target = (number.astype(jnp.float32) * growth).astype(jnp.int32)
    # Grow by at least one when counts are tiny.
    target = jnp.maximum(target, number + int(growth > 1))
    added = jnp.minimum(target, alive.shape[0]) - number
    return ~alive & (jnp.cumsum(~alive, dtype=jnp.int32) <= added)


def _draw_donors(key: jax.Array, weight: jax.Array, donor: jax.Array) -> jax.Array:
    """Return `N` random indices of donors, drawn with probability proportional to `weight[N]`."""
    count = donor.shape[0]
    # The inverse of the cumulative distribution, with one sort-free search for each draw.
    cumulative = jnp.cumsum(weight)
    draws = jax.random.uniform(key, (count,)) * cumulative[-1]
    source = jnp.searchsorted(cumulative, draws, side="right")
    # Rounding may point past the last donor; the most opaque donor replaces it.
    return jnp.where(donor[jnp.minimum(source, count - 1)], source, jnp.argmax(weight))


def split_opacity(opacity: jax.Array, copies: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the opacity and scale factor `[N]` of coincident surfels that replace one.

    The opacity is that of equation 9 of Kheradmand et al. n coincident discs of peak opacity p
    absorb sum_{i=1..n} (1 - (1 - p)^i) / i times the light of a disc of peak opacity 1, integrated
    over their plane; the factor keeps that. The published factor keeps the integral along a line,
    by an alternating sum of binomials that loses its digits for many copies.

    Args:
      opacity: `[N]` opacity of the replaced surfel.
      copies: `[N]` number of coincident surfels, 1 to `MAX_COPIES`.
    """
    copies = copies.astype(opacity.dtype)
    # 1 - (1 - o)^(1/n), without cancellation where o is small.
    each = -jnp.expm1(jnp.log1p(-jnp.minimum(opacity, _MAX_OPACITY)) / copies)

    def add(i: jax.Array, total: jax.Array) -> jax.Array:
        i = i.astype(opacity.dtype)
        term = -jnp.expm1(i * jnp.log1p(-each)) / i
        return total + jnp.where(i <= copies, term, 0)

    light = jax.lax.fori_loop(1, MAX_COPIES + 1, add, jnp.zeros_like(opacity))
    return each, jnp.sqrt(safe_divide(opacity, light, fill=1.0))


def add_position_noise(
    key: jax.Array, surfels: Surfels, alive: jax.Array, learning_rate: jax.Array, config: McmcConfig
) -> Surfels:
    """Move means by Gaussian noise within their discs or ellipsoids, faint ones most.

    The noise of Kheradmand et al., equation 8, has the shape of the covariance, not of its root, so
    that it moves needles along themselves alone. A disc's stays in its plane.

    Args:
      key: random key; consumed.
      surfels: `N` surfels.
      alive: `[N]` bool; dead surfels do not move.
      learning_rate: `[]` learning rate of the means in world units.
      config: static.
    """
    opacity = jax.nn.sigmoid(surfels.opacity_logits)
    # A switch at the opacity below which surfels are dead.
    faint = jax.nn.sigmoid(-100 * (opacity - config.min_opacity))
    amount = jnp.where(alive, faint * learning_rate * config.noise, 0)
    variance = jnp.exp(2 * surfels.log_scales)
    step = jax.random.normal(key, surfels.log_scales.shape, surfels.means.dtype) * variance
    axes = quaternion_to_matrix(surfels.quaternions)[..., : step.shape[1]]
    moved = jnp.sum(axes * step[:, None], axis=-1) * amount[:, None]
    return surfels.replace(means=surfels.means + moved)
