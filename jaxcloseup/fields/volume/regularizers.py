"""Penalties on the distribution of light along a ray, which volumetric fields add to its loss.

A round of samples is a histogram: `weights [..., S]` in intervals with `edges [..., S + 1]`, spaced
in [0, 1]. Intervals `[..., S]` against others `[..., P]` are compared all with all: S and P are
tens.
"""

import chex
import jax
import jax.numpy as jnp


_SMALL = 1e-7


def proposal_penalty(
    edges: jax.Array, weights: jax.Array, proposed_edges: jax.Array, proposed: jax.Array
) -> jax.Array:
    """Return the last round's weights beyond what a proposal allows (mip-NeRF 360, eq. 13).

    It trains the proposal alone: no gradient flows to `weights`.

    Args:
      edges: `[..., S + 1]` of the last round.
      weights: `[..., S]` of the last round.
      proposed_edges: `[..., P + 1]` of the proposal.
      proposed: `[..., P]` weights of the proposal.

    Returns:
      `[...]`.
    """
    chex.assert_axis_dimension(edges, -1, weights.shape[-1] + 1)
    chex.assert_axis_dimension(proposed_edges, -1, proposed.shape[-1] + 1)
    edges, weights = jax.lax.stop_gradient((edges, weights))
    begins_before = proposed_edges[..., None, :-1] < edges[..., 1:, None]
    ends_after = proposed_edges[..., None, 1:] > edges[..., :-1, None]
    overlap = begins_before & ends_after  # [..., S, P]
    bound = jnp.sum(jnp.where(overlap, proposed[..., None, :], 0), axis=-1)
    excess = jnp.maximum(weights - bound, 0)
    return jnp.sum(excess**2 / (weights + _SMALL), axis=-1)


def distortion(edges: jax.Array, weights: jax.Array) -> jax.Array:
    """Return the mean distance between parts of a ray's light, `[...]` (mip-NeRF 360, eq. 15)."""
    middles = 0.5 * (edges[..., 1:] + edges[..., :-1])
    apart = jnp.abs(middles[..., :, None] - middles[..., None, :])
    between = jnp.sum(weights * jnp.sum(weights[..., None, :] * apart, axis=-1), axis=-1)
    return between + jnp.sum(weights**2 * jnp.diff(edges, axis=-1), axis=-1) / 3


def antialiased_proposal_penalty(
    edges: jax.Array,
    weights: jax.Array,
    proposed_edges: jax.Array,
    proposed: jax.Array,
    pulse: float,
) -> jax.Array:
    """Return the blurred last round's weights beyond what a proposal allows (Zip-NeRF, eq. 10).

    Unlike `proposal_penalty` it is smooth in the edges: the last round's density of light is
    blurred by a rectangular pulse, and integrated over each of the proposal's intervals. It
    trains the proposal alone.

    Args:
      edges: `[..., S + 1]` of the last round.
      weights: `[..., S]` of the last round.
      proposed_edges: `[..., P + 1]` of the proposal.
      proposed: `[..., P]` weights of the proposal.
      pulse: half of the pulse's width, positive.

    Returns:
      `[...]`.
    """
    edges, weights = jax.lax.stop_gradient((edges, weights))
    ahead = proposed_edges[..., None] - edges[..., None, :]  # [..., P + 1, S + 1]

    def share(u: jax.Array) -> jax.Array:
        # The part of a point at 0, once blurred, that lies below u.
        return jnp.clip((u + pulse) / (2 * pulse), 0, 1)

    def integral(u: jax.Array) -> jax.Array:
        return jnp.maximum(u - pulse, 0) + pulse * share(u) ** 2

    # An interval's light below a proposed edge is the mean of `share` over it; where it is narrow,
    # a difference of integrals would cancel.
    widths = jnp.diff(edges, axis=-1)[..., None, :]
    narrow = widths < 1e-2 * pulse
    exact = (integral(ahead[..., :-1]) - integral(ahead[..., 1:])) / jnp.where(narrow, 1, widths)
    below = jnp.where(narrow, share(0.5 * (ahead[..., :-1] + ahead[..., 1:])), exact)
    blurred = jnp.diff(jnp.sum(weights[..., None, :] * below, axis=-1), axis=-1)
    excess = jnp.maximum(blurred - proposed, 0)
    return jnp.sum(excess**2 / (proposed + 1e-5), axis=-1)
