import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxcloseup.fields.volume import samplers
from jaxcloseup.fields.volume.samplers import stratified


importance = jax.jit(samplers.importance, static_argnames="num_samples")


def test_stratified_fills_every_bin_evenly(key):
    samples = np.asarray(stratified(key, 2.0, 10.0, 16, (4000,)))
    bins = 2 + 0.5 * np.arange(17)
    assert np.all(samples >= bins[:-1]) and np.all(samples <= bins[1:])
    inside = (samples - bins[:-1]) / 0.5
    np.testing.assert_allclose(inside.mean(axis=0), 0.5, atol=0.025)  # 5 sigma
    np.testing.assert_allclose(inside.var(axis=0), 1 / 12, atol=0.007)


def test_stratified_without_a_key_takes_centers():
    samples = stratified(None, 1.0, 3.0, 4, (2, 3))
    np.testing.assert_allclose(samples, np.broadcast_to([1.25, 1.75, 2.25, 2.75], (2, 3, 4)))


def test_importance_follows_the_histogram(key):
    edges = jnp.array([0.0, 1.0, 1.5, 4.0, 4.5])
    weights = jnp.array([0.2, 0.0, 0.5, 0.1])
    count = 40_000
    samples = np.sort(importance(key, edges, weights, count))
    cdf = np.interp(samples, edges, np.cumsum([0, 0.25, 0, 0.625, 0.125]))
    # Kolmogorov-Smirnov: exceeded once in ten thousand draws, plus the floor on empty bins.
    assert np.abs(cdf - np.arange(count) / count).max() < 2.23 / count**0.5 + 1e-4


def test_importance_quantiles_match_the_oracle(key):
    key_weights, key_edges = jax.random.split(key)
    weights = jax.random.uniform(key_weights, (5, 12)) ** 4
    edges = 1 + jnp.cumsum(jax.random.uniform(key_edges, (5, 13)) + 0.01, axis=-1)
    samples = importance(None, edges, weights, 33)
    for ours, e, w in zip(*map(np.asarray, (samples, edges, weights)), strict=True):
        # In a nearly empty bin the inverse is steep: float32 rounds the CDF by up to 5e-7.
        low, high = (reference.invert_cdf(e, w, np.linspace(0, 1, 33) + r) for r in (-5e-7, 5e-7))
        np.testing.assert_array_less(ours, high * (1 + 2e-5))
        np.testing.assert_array_less(low * (1 - 2e-5), ours)


@pytest.mark.parametrize("scale", [0.0, 1e-20, 1e20])
def test_importance_accepts_weights_of_any_sum(key, scale):
    edges = jnp.linspace(1.0, 2.0, 9)
    samples = np.asarray(importance(key, edges, scale * jnp.ones(8), 100))
    assert samples.min() >= 1 and samples.max() <= 2 + 1e-6
    assert abs(samples.mean() - 1.5) < 0.15


def test_no_gradient_flows_through_samples(key):
    edges = jnp.linspace(1.0, 2.0, 5)
    gradient = jax.grad(lambda w: importance(key, edges, w, 3).sum())(jnp.arange(1.0, 5.0))
    np.testing.assert_array_equal(gradient, 0)
