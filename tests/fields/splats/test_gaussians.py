"""Surfels converted to 3-D Gaussians, against the definition of a covariance."""

import jax.numpy as jnp
import numpy as np
import pytest
from reference_splats import rotation_of, sh_color
from splat_scenes import random_scene, to_surfels

from jaxcloseup.artifacts.viewer_gaussians import as_gaussians


@pytest.mark.parametrize("num_scales", [2, 3])
def test_covariances_match_ellipsoids_which_of_discs_are_thin(num_scales):
    scene = random_scene(2, num_scales=num_scales)
    found = as_gaussians(to_surfels(scene), jnp.ones(16, bool))
    for i in range(16):
        scales = [*np.exp(scene["log_scales"][i])]
        scales += [min(scales) / 1000] if num_scales == 2 else []
        rotation = rotation_of(scene["quaternions"][i])
        expected = rotation @ np.diag(np.square(scales)) @ rotation.T
        largest = max(scales) ** 2
        np.testing.assert_allclose(found.covariances[i], expected, rtol=0, atol=1e-5 * largest)
    np.testing.assert_allclose(found.opacities, 1 / (1 + np.exp(-scene["opacity_logits"])), 1e-5)


def test_colors_are_the_clipped_constant_ones():
    surfels = to_surfels(random_scene(3))
    sh = jnp.zeros((16, 4, 3)).at[:, 1:].set(9.0).at[:, 0].set(jnp.array([-9.0, 0.0, 9.0]))
    found = as_gaussians(surfels.replace(sh=sh), jnp.ones(16, bool))
    np.testing.assert_allclose(found.rgb, [[0, 0.5, 1]] * 16, atol=1e-6)


def test_only_alive_and_finite_surfels_are_kept():
    surfels = to_surfels(random_scene(4))
    broken = surfels.replace(log_scales=surfels.log_scales.at[1, 0].set(jnp.nan))
    found = as_gaussians(broken, jnp.arange(16) != 0)
    np.testing.assert_array_equal(found.means, surfels.means[2:])
    assert all(len(array) == 14 for array in found)


def test_colors_from_a_position_are_those_of_all_degrees():
    scene = random_scene(5)
    surfels, position = to_surfels(scene), np.array([0.3, -0.2, 5.0])
    bent = surfels.replace(sh=surfels.sh.at[3, 1, 0].set(jnp.nan))
    found = as_gaussians(bent, jnp.ones(16, bool), position)
    assert len(found.rgb) == len(as_gaussians(bent, jnp.ones(16, bool)).rgb) == 15
    kept = np.arange(16) != 3
    means, sh = (np.asarray(a, np.float64)[kept] for a in (surfels.means, surfels.sh))
    expected = [
        sh_color(terms, (mean - position) / np.linalg.norm(mean - position))
        for mean, terms in zip(means, sh, strict=True)
    ]
    np.testing.assert_allclose(found.rgb, np.clip(expected, 0, 1), atol=1e-5)
