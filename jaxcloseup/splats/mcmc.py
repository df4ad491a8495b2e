"""Density control at fixed capacity: Markov chain Monte Carlo (Kheradmand et al., NeurIPS 2024).

Surfels that have faded away are moved onto others, which share their light with the copies, and
all surfels wander a little, the fainter the more. Nothing changes shape.
"""

import dataclasses

import jax
import jax.numpy as jnp

from jaxcloseup.geometry.rotations import quaternion_to_matrix
from jaxcloseup.numerics import safe_divide
from jaxcloseup.splats.surfels import Surfels


MOST_COPIES = 51  # of one surfel at once
_OPACITY_MAX = 1 - 1e-6


@dataclasses.dataclass(frozen=True)
class McmcConfig:
    """When and how many surfels move.

    Attributes:
      every: steps between relocations.
      start: no relocation up to this step.
      stop: no relocation from this step on, and no growth.
      growth: living surfels become at most so many times as many at each relocation.
      min_opacity: a surfel this faint is dead.
      noise: how far surfels wander, times the learning rate of their means; 0 keeps them still.
    """

    every: int = 100
    start: int = 500
    stop: int = 25_000
    growth: float = 1.05
    min_opacity: float = 0.005
    noise: float = 5e5


def relocate(
    key: jax.Array, surfels: Surfels, alive: jax.Array, config: McmcConfig
) -> tuple[Surfels, jax.Array, jax.Array]:
    """Move dead surfels onto living ones and bring new ones to life; `key` is consumed.

    A surfel of opacity o that n - 1 others join becomes n coincident ones of opacity
    1 - (1 - o)^(1/n), smaller such that the light that all n take away, summed over the disc's
    area, is that which the one took: the published rule keeps the integral along a line instead.

    Args:
      key: random key.
      surfels: `N` surfels.
      alive: `[N]` bool.
      config: static.

    Returns:
      Surfels, `alive`, and `[N]` whether a surfel was changed, so that an optimizer forgets it.
    """
    count = alive.shape[0]
    opacity = jax.nn.sigmoid(surfels.opacity_logits)
    donor = alive & (opacity > config.min_opacity)
    number = jnp.sum(alive, dtype=jnp.int32)
    more = (number.astype(jnp.float32) * config.growth).astype(jnp.int32)
    # Of a few, a share rounds to none.
    more = jnp.maximum(more, number + int(config.growth > 1))
    grown = jnp.minimum(more, count) - number
    newborn = ~alive & (jnp.cumsum(~alive, dtype=jnp.int32) <= grown)
    receiver = ((alive & ~donor) | newborn) & jnp.any(donor)

    share = jnp.cumsum(jnp.where(donor, opacity, 0))
    source = jnp.searchsorted(share, jax.random.uniform(key, (count,)) * share[-1], side="right")
    # Rounding may point past the last donor; the most opaque one is as good.
    source = jnp.where(
        donor[jnp.minimum(source, count - 1)], source, jnp.argmax(jnp.where(donor, opacity, 0))
    )
    copies = jnp.zeros(count, jnp.int32).at[source].add(receiver.astype(jnp.int32))
    copies = jnp.minimum(copies + 1, MOST_COPIES)
    thinner, smaller = split_opacity(opacity, copies)
    thinner = jnp.clip(thinner, config.min_opacity, _OPACITY_MAX)
    shared = surfels.replace(
        opacity_logits=jnp.where(
            copies > 1, jnp.log(thinner) - jnp.log1p(-thinner), surfels.opacity_logits
        ),
        log_scales=surfels.log_scales + jnp.where(copies > 1, jnp.log(smaller), 0)[:, None],
    )
    index = jnp.where(receiver, source, jnp.arange(count))
    return (
        jax.tree.map(lambda leaf: leaf[index], shared),
        alive | (newborn & receiver),
        receiver | (copies > 1),
    )


def split_opacity(opacity: jax.Array, copies: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Opacity of each of `copies` coincident surfels that replace one, and its scale's factor.

    n coincident discs of peak opacity p take sum_{i=1..n} (1 - (1 - p)^i) / i times the light of a
    disc of peak opacity 1, integrated over their plane.
    """
    copies = copies.astype(opacity.dtype)
    each = -jnp.expm1(jnp.log1p(-jnp.minimum(opacity, _OPACITY_MAX)) / copies)

    def add(i, total):
        i = i.astype(opacity.dtype)
        term = -jnp.expm1(i * jnp.log1p(-each)) / i
        return total + jnp.where(i <= copies, term, 0)

    light = jax.lax.fori_loop(1, MOST_COPIES + 1, add, jnp.zeros_like(opacity))
    return each, jnp.sqrt(safe_divide(opacity, light, fill=1.0))


def wander(
    key: jax.Array, surfels: Surfels, alive: jax.Array, rate: jax.Array, config: McmcConfig
) -> Surfels:
    """Move means by Gaussian noise within their discs, faint ones most; `key` is consumed.

    Args:
      key: random key.
      surfels: `N` surfels.
      alive: `[N]` bool; others keep still.
      rate: `[]` learning rate of the means.
      config: static.
    """
    opacity = jax.nn.sigmoid(surfels.opacity_logits)
    faint = jax.nn.sigmoid(-100 * (opacity - config.min_opacity))
    amount = jnp.where(alive, faint * rate * config.noise, 0)
    variance = jnp.exp(2 * surfels.log_scales)
    step = jax.random.normal(key, surfels.log_scales.shape, surfels.means.dtype) * variance
    tangents = quaternion_to_matrix(surfels.quaternions)[..., :2]
    moved = jnp.sum(tangents * step[:, None], axis=-1) * amount[:, None]
    return surfels.replace(means=surfels.means + moved)
