import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxcloseup.fields.volume import compositing


composite = jax.jit(compositing.composite)


def gray(density, depth, length=1.0):
    """Composite colorless samples along one ray."""
    density = jnp.asarray(density, jnp.float32)
    return composite(
        jnp.ones((*density.shape, 3)), density, jnp.asarray(depth), jnp.full((), length)
    )


@pytest.mark.parametrize("shape", [(), (2, 3)])
def test_compositing_matches_the_oracle(key, shape):
    key_rgb, key_density, key_depth, key_length = jax.random.split(key, 4)
    rgb = jax.random.uniform(key_rgb, (*shape, 9, 3))
    density = jnp.maximum(3 * jax.random.normal(key_density, (*shape, 9)), 0)
    depth = 1 + jnp.cumsum(jax.random.uniform(key_depth, (*shape, 9)), axis=-1)
    length = 1 + jax.random.uniform(key_length, shape)
    samples = jax.tree.map(np.asarray, (rgb, density, depth, length))
    seen = jax.tree.map(np.asarray, composite(*samples))
    for ray in np.ndindex(shape):
        expected = reference.composite_ray(*(x[ray] for x in samples))
        for ours, theirs in zip(seen, expected, strict=True):
            np.testing.assert_allclose(ours[ray], theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("length", [1.0, 1.3])
def test_constant_fog_absorbs_exponentially(length):
    depth = jnp.linspace(2.0, 5.0, 301)
    density = jnp.full(301, 0.4).at[-1].set(0)
    alpha = gray(density, depth, length).alpha
    np.testing.assert_allclose(alpha, 1 - np.exp(-0.4 * 3 * length), rtol=1e-5)


def test_an_opaque_wall_has_its_own_depth():
    depth = jnp.linspace(1.0, 2.0, 11)
    seen = gray(jnp.where(depth >= 1.45, 1e4, 0), depth)
    for value in (seen.depth, seen.expected_depth, seen.median_depth):
        np.testing.assert_allclose(value, 1.5, rtol=1e-6)
    np.testing.assert_allclose(seen.alpha, 1, rtol=1e-6)


def test_two_slabs_share_the_light():
    rgb = jnp.array([[1.0, 0, 0], [0, 0, 0], [0, 0, 1.0], [0, 0, 0]])
    density = jnp.array([1.0, 0, 2.0, 0])
    seen = composite(rgb, density, jnp.array([1.0, 1.5, 3.0, 4.0]), jnp.ones(()))
    first, second = 1 - np.exp(-0.5), np.exp(-0.5) * (1 - np.exp(-2.0))
    np.testing.assert_allclose(seen.rgb, [first, 0, second], rtol=1e-6)
    np.testing.assert_allclose(seen.expected_depth, first + 3 * second, rtol=1e-6)
    np.testing.assert_allclose(seen.depth, (first + 3 * second) / (first + second), rtol=1e-6)
    np.testing.assert_allclose(seen.median_depth, 3)


def test_empty_space_has_no_alpha_and_no_depth():
    seen = gray(jnp.zeros(4), jnp.arange(1.0, 5))
    for value in (seen.alpha, seen.depth, seen.expected_depth, seen.median_depth):
        np.testing.assert_array_equal(value, 0)


@pytest.mark.parametrize("density", [0.0, 1e-30, 1.0, 1e12, 1e25])
def test_gradients_stay_finite(density):
    depth = jnp.arange(1.0, 6)

    def total(density):
        seen = gray(density, depth)
        return seen.depth + seen.alpha + seen.rgb.sum() + seen.median_depth

    gradient = jax.jit(jax.grad(total))(jnp.full(5, density))
    assert np.all(np.isfinite(gradient)), gradient


@pytest.mark.parametrize("count", [10, 13, 26, 30])
def test_the_median_is_where_half_is_crossed_once(count):
    """Fog of which an interval's edge takes exactly half the light, up to rounding."""
    density = jnp.full(64, np.log(2) / count * 32, jnp.float32)
    edges = jnp.linspace(1.0, 3.0, 65)
    seen = compositing.composite_intervals(None, density, edges, jnp.ones(()))
    np.testing.assert_allclose(seen.median_depth, 1 + count / 32, atol=1 / 32)
