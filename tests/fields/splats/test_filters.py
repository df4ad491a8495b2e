"""The smoothing filter in space: how finely photographs see points, and what it makes of splats."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_splats import rotation_of
from splat_scenes import random_scene, to_surfels

from jaxcloseup.fields.splats.filters import SMOOTHING_VARIANCE, sampling_intervals, smoothed
from jaxcloseup.geometry.cameras import Camera


@pytest.fixture(scope="module")
def cameras():
    """Three cameras of different focal lengths at different places, all looking along z."""
    poses = np.tile(np.eye(4)[:3], (3, 1, 1))
    poses[:, :, 3] = [[0, 0, 0], [0.5, 0, 1.0], [-2.0, 0, -3.0]]
    intrinsics = np.array([[30, 34, 16, 12], [60, 60, 10, 13], [90, 80, 16, 12]], float)
    return poses, intrinsics, Camera(*map(jnp.float32, (poses, intrinsics)), height=24, width=32)


def test_a_point_is_sampled_by_the_photograph_that_shows_it_finest(cameras):
    poses, intrinsics, stacked = cameras
    points = np.random.default_rng(0).uniform([-4, -3, -1], [4, 3, 6], (200, 3))
    expected = np.full(200, np.inf)
    for pose, (fx, fy, cx, cy) in zip(poses, intrinsics, strict=True):
        x, y, z = (points - pose[:, 3]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = fx * x / z + cx, fy * y / z + cy
        # 15% of the image more on each side.
        seen = (z > 0.2) & (u > -4.8) & (u < 36.8) & (v > -3.6) & (v < 27.6)
        expected = np.where(seen, np.minimum(expected, z / np.sqrt(fx * fy)), expected)
    unseen = ~np.isfinite(expected)
    assert 20 < unseen.sum() < 180
    expected[unseen] = expected[~unseen].max()
    found = sampling_intervals(jnp.float32(points), stacked, near=0.2)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    nothing = sampling_intervals(jnp.float32([[0, 0, -9]]), stacked, near=0.2)
    np.testing.assert_array_equal(nothing, [0])


@pytest.mark.parametrize("num_scales", [2, 3])
def test_smoothing_convolves_and_keeps_the_integral(num_scales):
    scene = random_scene(3, num_scales=num_scales, log_scale=(-6.0, -1.0))
    interval = np.random.default_rng(1).uniform(0.01, 0.2, 16)
    found = smoothed(to_surfels(scene), jnp.float32(interval))
    for i in range(16):
        axes = rotation_of(scene["quaternions"][i])[:, :num_scales]
        before, after = np.exp(scene["log_scales"][i]), np.exp(np.float64(found.log_scales[i]))
        added = SMOOTHING_VARIANCE * interval[i] ** 2 * axes @ axes.T
        expected = axes @ np.diag(before**2) @ axes.T + added
        np.testing.assert_allclose(axes @ np.diag(after**2) @ axes.T, expected, atol=1e-6)
        logits = scene["opacity_logits"][i], float(found.opacity_logits[i])
        old, new = (
            np.prod(scales) / (1 + np.exp(-logit))
            for logit, scales in zip(logits, (before, after), strict=True)
        )
        assert new == pytest.approx(old, rel=1e-4)
    for name in ("means", "quaternions", "sh"):
        np.testing.assert_array_equal(getattr(found, name), jnp.float32(scene[name]))


def test_without_an_interval_nothing_is_smoothed():
    surfels = to_surfels(random_scene(4))
    assert smoothed(surfels, None) is surfels
    still = smoothed(surfels, jnp.zeros(16))
    np.testing.assert_allclose(still.log_scales, surfels.log_scales, rtol=1e-5)
    np.testing.assert_allclose(still.opacity_logits, surfels.opacity_logits, rtol=1e-3, atol=1e-5)


def test_extreme_splats_are_smoothed_with_finite_gradients():
    scene = random_scene(5, num_scales=3)
    scene["log_scales"][:3] = [[-60, -60, -60], [60, 60, 60], [-60, 0, 60]]
    scene["opacity_logits"][3:6] = [100, -100, 30]

    def total(surfels):
        found = smoothed(surfels, jnp.linspace(0, 1, 16))
        return jnp.sum(found.log_scales) + jnp.sum(jax.nn.sigmoid(found.opacity_logits))

    value, gradient = jax.value_and_grad(total)(to_surfels(scene))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((value, gradient)))
