"""Sample positions along rays.

Samples are z-depths, because ray directions have unit camera-z. No gradient flows through them.
"""

import chex
import jax
import jax.numpy as jnp


def stratified(
    key: jax.Array | None, near: float, far: float, num_samples: int, shape: tuple[int, ...]
) -> jax.Array:
    """Draw one sample in each of `num_samples` equal bins of [near, far] (NeRF, eq. 2).

    Args:
      key: consumed; None takes the centers of the bins.
      near: z-depth at which the first bin begins.
      far: z-depth at which the last bin ends.
      num_samples: number of bins per ray.
      shape: batch shape of the rays.

    Returns:
      `[*shape, num_samples]` ascending samples.
    """
    shape = (*shape, num_samples)
    inside = 0.5 if key is None else jax.random.uniform(key, shape)
    bins = jax.lax.broadcasted_iota(jnp.result_type(float), shape, len(shape) - 1)
    return near + (far - near) * (bins + inside) / num_samples


def importance(
    key: jax.Array | None, edges: jax.Array, weights: jax.Array, num_samples: int
) -> jax.Array:
    """Draw samples like a histogram, by inverting its piecewise linear CDF (NeRF, 5.2).

    Each weight is first raised by 1e-5, so that empty rays are sampled evenly.

    Args:
      key: consumed; None takes `num_samples` evenly spaced quantiles from 0 to 1 inclusive.
      edges: `[..., B + 1]` ascending edges of the bins.
      weights: `[..., B]` non-negative; they need not sum to 1.
      num_samples: number of samples per ray.

    Returns:
      `[..., num_samples]` samples, not sorted unless `key` is None.
    """
    edges, cdf, pdf = _cdf(edges, weights)
    shape = (*weights.shape[:-1], num_samples)
    if key is None:
        quantiles = jnp.broadcast_to(jnp.linspace(0, 1, num_samples), shape)
    else:
        quantiles = jax.random.uniform(key, shape)
    return _invert(edges, cdf, pdf, quantiles)


def interval_quantiles(
    key: jax.Array | None, num_intervals: int, shape: tuple[int, ...]
) -> jax.Array:
    """Draw edges of intervals in [0, 1]: 0, about i / `num_intervals`, and 1.

    Args:
      key: consumed, moves each inner edge by up to half of a step; None leaves it.
      num_intervals: number of intervals per ray.
      shape: batch shape of the rays.

    Returns:
      `[*shape, num_intervals + 1]` ascending edges.
    """
    half = 0.5 / num_intervals
    inner = stratified(key, half, 1 - half, num_intervals - 1, shape)
    ends = jnp.zeros((*shape, 1), inner.dtype)
    return jnp.concatenate([ends, inner, ends + 1], axis=-1)


def resample(
    key: jax.Array | None, edges: jax.Array, weights: jax.Array, num_intervals: int
) -> jax.Array:
    """Return intervals with about equal shares of a histogram; they cover all of it.

    Args:
      key: consumed, as in `interval_quantiles`.
      edges: `[..., B + 1]` ascending edges of the histogram.
      weights: `[..., B]` as in `importance`.
      num_intervals: number of new intervals per ray.

    Returns:
      `[..., num_intervals + 1]` ascending edges, without a gradient.
    """
    edges, cdf, pdf = _cdf(edges, weights)
    return _invert(edges, cdf, pdf, interval_quantiles(key, num_intervals, weights.shape[:-1]))


def widen(weights: jax.Array) -> jax.Array:
    """Widen weights `[..., S]` into the intervals beside them (mip-NeRF, section 3.1).

    The mean of the maxima over each interval and its left, and its right neighbor, plus 0.01.
    """
    ends = ((0, 0),) * (weights.ndim - 1)
    padded = jnp.pad(weights, (*ends, (1, 1)), mode="edge")
    larger = jnp.maximum(padded[..., :-1], padded[..., 1:])
    return 0.5 * (larger[..., :-1] + larger[..., 1:]) + 0.01


def _cdf(edges: jax.Array, weights: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return edges, and for each bin where the CDF of the raised weights begins and its gain."""
    chex.assert_equal_shape_prefix([edges, weights], weights.ndim - 1)
    chex.assert_axis_dimension(edges, -1, weights.shape[-1] + 1)
    edges, weights = jax.lax.stop_gradient((edges, weights))
    weights = weights + 1e-5
    pdf = weights / jnp.sum(weights, axis=-1, keepdims=True)
    return edges, jnp.cumsum(pdf, axis=-1) - pdf, pdf


def _invert(edges: jax.Array, cdf: jax.Array, pdf: jax.Array, quantiles: jax.Array) -> jax.Array:
    # The inverse is a sum of clipped ramps, one per bin, without search or gather.
    inside = jnp.clip((quantiles[..., None] - cdf[..., None, :]) / pdf[..., None, :], 0, 1)
    widths = jnp.diff(edges, axis=-1)
    return edges[..., :1] + jnp.sum(inside * widths[..., None, :], axis=-1)
