"""Frustums of cones: moments and encodings against Monte Carlo."""

import jax
import numpy as np
import pytest
import reference_volume as reference

from jaxcloseup.fields.volume import samplers
from jaxcloseup.fields.volume.cones import (
    RADIUS,
    frustum_gaussians,
    frustum_moments,
    frustum_samples,
    integrated_encoding,
)
from jaxcloseup.fields.volume.rays import Rays
from jaxcloseup.fields.volume.regularizers import antialiased_proposal_penalty


EDGES = np.array([[0.5, 0.6, 1.5, 4.0]])
PIXEL = 0.2


def rays(direction=(0.3, -0.2, 1.0)):
    one = np.ones(1, np.float32)
    origin = np.float32([[0.1, 0.2, 0.3]])
    return Rays(origin, np.float32([direction]), one, PIXEL * one)


def points_in(numbers, begin, end, radius, count=400_000):
    """Points uniform in a frustum about the z axis, `[count, 3]`."""
    z = np.cbrt(numbers.uniform(begin**3, end**3, count))
    angle, away = numbers.uniform(0, 2 * np.pi, count), np.sqrt(numbers.uniform(0, 1, count))
    return np.stack([away * radius * z * np.cos(angle), away * radius * z * np.sin(angle), z], 1)


def test_moments_are_those_of_points_in_a_frustum():
    numbers, radius = np.random.default_rng(0), np.float32([0.3])
    ours = jax.jit(frustum_moments)(np.float32(EDGES), radius)
    for i in range(3):
        points = points_in(numbers, EDGES[0, i], EDGES[0, i + 1], 0.3)
        np.testing.assert_allclose(ours.mean[0, i], points[:, 2].mean(), rtol=2e-3)
        np.testing.assert_allclose(ours.along[0, i], points[:, 2].var(), rtol=1e-2)
        np.testing.assert_allclose(ours.across[0, i], points[:, :2].var(), rtol=1e-2)


def test_a_rays_gaussians_have_the_covariance_of_its_points():
    """A slanted ray with unit camera-z: z-depths stretch by its length, radii do not."""
    mean, variance = jax.jit(frustum_gaussians)(rays(), np.float32(EDGES))
    direction = np.array([0.3, -0.2, 1.0])
    unit = direction / np.linalg.norm(direction)
    first = np.cross(unit, [1.0, 0, 0])
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(unit, first), direction])
    points = points_in(np.random.default_rng(1), 1.5, 4.0, RADIUS * PIXEL) @ frame
    np.testing.assert_allclose(mean[:, 0, 2], np.add(points.mean(0), [0.1, 0.2, 0.3]), rtol=5e-3)
    np.testing.assert_allclose(variance[:, 0, 2], points.var(0), rtol=1e-2)


def test_the_integrated_encoding_is_the_mean_of_encodings():
    numbers = np.random.default_rng(2)
    mean, deviation = numbers.uniform(-1, 1, (3, 2)), np.array([[0.05, 0.4], [0.2, 0.1], [0, 0.3]])
    ours = jax.jit(integrated_encoding, static_argnums=2)(
        np.float32(mean), np.float32(deviation**2), 4
    )
    for i in range(2):
        x = mean[:, i] + deviation[:, i] * numbers.normal(size=(200_000, 3))
        np.testing.assert_allclose(ours[:, i], reference.positional(x, 4)[:, 3:].mean(0), atol=5e-3)


@pytest.mark.parametrize("count", [6, 3])
@pytest.mark.parametrize("turned", [False, True])
def test_points_have_their_frustums_moments(turned, count):
    """Along the ray and, in the mean of both coordinates, across."""
    key = jax.random.key(0) if turned else None
    straight = rays((0.0, 0.0, 1.0))
    sample = jax.jit(frustum_samples, static_argnums=3)
    points, deviation = sample(key, straight, np.float32(EDGES), count)
    points = np.asarray(points) - np.array([0.1, 0.2, 0.3])[:, None, None, None]
    for i in range(3):
        mean, along, across = reference.frustum(*EDGES[0, i : i + 2], RADIUS * PIXEL)
        x, y, z = points[:, 0, i]
        np.testing.assert_allclose(z.mean(), mean, rtol=1e-5)
        np.testing.assert_allclose(z.var(), along, rtol=1e-4)
        np.testing.assert_allclose((np.mean(x**2) + np.mean(y**2)) / 2, across, rtol=1e-4)
        np.testing.assert_allclose(deviation[0, i], 0.5 * np.hypot(x, y), rtol=1e-4)


def test_a_single_point_has_its_frustums_mean_depth():
    """Its place about the ray is random, and not biased."""
    many = jax.tree.map(lambda leaf: np.repeat(leaf, 4000, axis=0), rays((0.0, 0.0, 1.0)))
    edges = np.tile(np.float32(EDGES[:1]), (4000, 1))
    points, _ = jax.jit(frustum_samples, static_argnums=3)(jax.random.key(1), many, edges, 1)
    points = np.asarray(points)[..., 0] - np.array([0.1, 0.2, 0.3])[:, None, None]
    for i in range(3):
        mean, _, across = reference.frustum(*EDGES[0, i : i + 2], RADIUS * PIXEL)
        np.testing.assert_allclose(points[2, :, i], mean, rtol=1e-5)
        for axis in points[:2, :, i]:
            np.testing.assert_allclose(np.mean(axis**2), across, rtol=0.1)
            assert abs(axis.mean()) < 0.1 * across**0.5


def test_a_single_point_that_nothing_turns_lies_on_its_ray():
    """A rendering without a key would otherwise be that of rays beside its own."""
    slanted = rays()
    sample = jax.jit(frustum_samples, static_argnums=3)
    points, deviation = sample(None, slanted, np.float32(EDGES), 1)
    depth = np.asarray(points)[2, 0, :, 0] - slanted.origins[0, 2]
    on_ray = slanted.origins.T + slanted.directions.T * depth
    np.testing.assert_allclose(points[:, 0, :, 0], on_ray, atol=1e-6)
    np.testing.assert_allclose(deviation[0, :, 0], RADIUS * PIXEL * depth / 8**0.5, rtol=1e-5)


def test_weights_widen_as_the_oracle_says():
    weights = np.random.default_rng(3).dirichlet(np.ones(6), 2)
    ours = jax.jit(samplers.widen)(np.float32(weights))
    np.testing.assert_allclose(ours, [reference.widen(w) for w in weights], rtol=1e-5)


@pytest.mark.parametrize("pulse", [0.03, 0.003])
def test_the_smooth_penalty_is_a_blur_and_its_gradient_the_finite_difference(pulse):
    numbers = np.random.default_rng(4)
    edges, proposed_edges = (np.sort(numbers.uniform(0, 1, n)) for n in (8, 12))
    edges[3] = edges[2] + 1e-7  # nearly nothing between them
    weights, proposed = numbers.dirichlet(np.ones(7)), numbers.dirichlet(np.ones(11))
    along = numbers.normal(size=11)
    expected = reference.blurred_penalty(edges, weights, proposed_edges, proposed, pulse)
    with jax.enable_x64(True):

        @jax.jit
        @jax.value_and_grad
        def penalty(step):
            moved = proposed + step * along
            return antialiased_proposal_penalty(edges, weights, proposed_edges, moved, pulse)

        value, slope = penalty(0.0)
        up, down = (float(penalty(h)[0]) for h in (1e-7, -1e-7))
    np.testing.assert_allclose(value, expected, rtol=2e-3)
    np.testing.assert_allclose(slope, (up - down) / 2e-7, rtol=1e-4)
    assert expected > 0
