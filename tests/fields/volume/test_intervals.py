"""Intervals along rays: spacing, contraction, resampling, compositing and penalties."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_volume as reference

from jaxcloseup.fields.volume import samplers
from jaxcloseup.fields.volume.compositing import composite_intervals
from jaxcloseup.fields.volume.coordinates import contract, contraction_scale, spaced, unspaced
from jaxcloseup.fields.volume.intervals import IntervalConfig, Round, interval_field
from jaxcloseup.fields.volume.rays import Extent
from jaxcloseup.fields.volume.regularizers import distortion, proposal_penalty
from jaxcloseup.fields.volume.renderer import Samples
from jaxcloseup.geometry.cameras import Camera


resample = jax.jit(samplers.resample, static_argnums=3)
interval_quantiles = jax.jit(samplers.interval_quantiles, static_argnums=(1, 2))


def histogram(numbers, count):
    edges = np.sort(numbers.uniform(0, 1, count + 1))
    edges[[0, -1]] = 0, 1
    return edges, numbers.dirichlet(np.full(count, 0.3))


@pytest.mark.parametrize("spacing", [1.0, 0.0, 0.5, -1.0, -1.5])
def test_spacing_inverts_the_papers_power_transformation(spacing):
    s = np.linspace(0, 1, 9)
    expected = reference.unspace(s, 0.2, 7.0, spacing)

    @jax.jit
    def there_and_back(s):
        x = unspaced(s, 0.2, 7.0, spacing=spacing)
        return x, spaced(x, 0.2, 7.0, spacing=spacing)

    ours, back = there_and_back(np.float32(s))
    np.testing.assert_allclose(ours, expected, rtol=2e-6)
    np.testing.assert_allclose(back, s, atol=1e-6)


def test_space_is_contracted_into_a_ball_of_radius_2():
    x = np.random.default_rng(0).normal(size=(50, 3)) * 10.0 ** np.arange(-3, 2).repeat(10)[:, None]
    ours = jax.jit(contract)(np.float32(x.T))
    np.testing.assert_allclose(ours.T, reference.contract(x), rtol=1e-6, atol=1e-7)
    assert np.linalg.norm(ours, axis=0).max() < 2
    np.testing.assert_allclose(jax.jit(jax.jacfwd(contract))(np.zeros(3, "f4")), np.eye(3))


def test_contraction_scales_lengths_by_its_jacobian():
    with jax.enable_x64(True):
        x = np.random.default_rng(1).normal(size=(20, 3)) * 2
        jacobians = jax.jit(jax.vmap(jax.jacfwd(contract)))(x)
        expected = np.cbrt(np.linalg.det(jacobians))
        np.testing.assert_allclose(jax.jit(contraction_scale)(x.T), expected, rtol=1e-10)


def test_new_intervals_have_equal_shares(key):
    numbers = np.random.default_rng(2)
    edges, weights = histogram(numbers, 9)
    ours = resample(None, np.float32(edges), np.float32(weights), 6)
    # Where a bin is nearly empty the inverse is steep: what float32 rounds moves it.
    np.testing.assert_allclose(ours, reference.quantile_edges(edges, weights, 6), atol=1e-3)
    moved = interval_quantiles(key, 6, (2000,))
    assert np.all(np.diff(moved) >= 0)
    np.testing.assert_array_equal(moved[:, [0, -1]], np.tile([0.0, 1.0], (2000, 1)))
    inner = np.asarray(moved)[:, 1:-1] * 6 - np.arange(1, 6)
    np.testing.assert_allclose(inner.mean(axis=0), 0, atol=0.03)
    np.testing.assert_allclose(inner.var(axis=0), 1 / 12, atol=0.008)


def test_no_gradient_flows_through_new_intervals():
    edges = np.linspace(0, 1, 4, dtype=np.float32)
    gradient = jax.jit(jax.grad(lambda w: samplers.resample(None, edges, w, 3).sum()))
    np.testing.assert_array_equal(gradient(np.arange(1.0, 4, dtype=np.float32)), 0)


def test_intervals_absorb_as_the_oracle_says():
    numbers = np.random.default_rng(3)
    edges = np.sort(numbers.uniform(1, 4, (3, 8)))
    density, rgb = numbers.exponential(size=(3, 7)), numbers.uniform(size=(3, 7, 3))
    length = np.array([1.0, 1.2, 1.5])
    ours = jax.jit(composite_intervals)(*map(np.float32, (rgb, density, edges, length)))
    for ray in range(3):
        weights = reference.absorb(density[ray], edges[ray], length[ray])
        np.testing.assert_allclose(ours.weights[ray], weights, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(ours.rgb[ray], weights @ rgb[ray], rtol=1e-5)
        middles = (edges[ray, 1:] + edges[ray, :-1]) / 2
        np.testing.assert_allclose(ours.expected_depth[ray], weights @ middles, rtol=1e-5)


def test_penalties_match_the_oracle():
    numbers = np.random.default_rng(4)
    found, proposed = histogram(numbers, 7), histogram(numbers, 11)
    ours = [tuple(map(np.float32, h)) for h in (found, proposed)]
    penalty = jax.jit(proposal_penalty)
    expected = reference.proposal_penalty(*found, *proposed)
    assert expected > 0.01
    np.testing.assert_allclose(penalty(*ours[0], *ours[1]), expected, rtol=1e-5)
    np.testing.assert_allclose(
        jax.jit(distortion)(*ours[0]), reference.distortion(*found), rtol=1e-3
    )
    np.testing.assert_allclose(penalty(*ours[0], *ours[0]), 0, atol=1e-7)


@pytest.mark.parametrize("name", ["proposal", "distortion"])
def test_a_penaltys_gradient_is_the_finite_difference(name):
    numbers = np.random.default_rng(5)
    with jax.enable_x64(True):
        found, proposed = (histogram(numbers, n) for n in (7, 11))
        weights = proposed[1] if name == "proposal" else found[1]
        along = numbers.normal(size=weights.shape)

        @jax.jit
        def penalty(step):
            moved = weights + step * along
            if name == "proposal":
                return proposal_penalty(*found, proposed[0], moved)
            return distortion(found[0], moved)

        slope = jax.jit(jax.grad(penalty))(0.0)
        np.testing.assert_allclose(slope, (penalty(1e-7) - penalty(-1e-7)) / 2e-7, rtol=1e-5)
        assert abs(slope) > 1e-3


def test_a_proposal_learns_from_the_last_round_and_not_the_other_way_round():
    numbers = np.random.default_rng(6)
    found, proposed = (tuple(map(np.float32, histogram(numbers, n))) for n in (7, 11))
    gradients = jax.jit(jax.grad(proposal_penalty, argnums=(0, 1, 2, 3)))(*found, *proposed)
    assert all(np.all(gradient == 0) for gradient in gradients[:3])
    assert np.any(gradients[3] != 0)


def test_a_second_round_closes_in_on_a_wall():
    """A wall at z-depth 3 is found far better by a second round."""
    camera = Camera(jnp.eye(3, 4), jnp.array([8.0, 8, 2, 2]), 4, 4)

    def wall(params, buffers, key, rays, edges):
        density = jnp.where(edges[:, 1:] + edges[:, :-1] > 6.0, 50.0, 0.0)
        return Samples(density, jnp.full((*density.shape, 3), 0.25))

    errors = []
    for count in (1, 2):
        config, extent = IntervalConfig(spacing=-1.0, chunk=6), Extent(0.5, 10.0)
        field = interval_field(
            config, extent, init=lambda *_: ((), ()), rounds=[Round(16, wall)] * count
        )
        seen = jax.jit(functools.partial(field.render, (), (), camera, None))(None)
        np.testing.assert_allclose(seen.rgb, 0.25, atol=1e-3)
        errors.append(np.abs(np.asarray(seen.depth) - 3).max())
    assert errors[0] > 4 * errors[1]
