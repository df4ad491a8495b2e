"""Images of discs that face the camera or are tilted, against geometry, and of antialiased ones."""

import jax.numpy as jnp
import numpy as np
import pytest
import reference_splats as reference
from splat_scenes import (
    ANTIALIASED,
    CONFIG,
    COUNT,
    HEIGHT,
    INTRINSICS,
    NEAR,
    WIDTH,
    oracle,
    pixel_centers,
    random_scene,
    render,
    to_camera,
    to_surfels,
)

from jaxcloseup.fields.splats import RasterizeConfig


def facing_discs(z, scale, opacity_logit):
    """`COUNT` discs on the camera's axis that face the camera."""
    scene = random_scene(0)
    scene["means"] = np.stack([0 * z, 0 * z, z], axis=1).astype(np.float32).astype(np.float64)
    scene["log_scales"] = np.full((COUNT, 2), np.log(scale))
    scene["quaternions"] = np.tile([1.0, 0, 0, 0], (COUNT, 1))
    scene["opacity_logits"] = np.full(COUNT, opacity_logit)
    return scene


def test_one_disc_facing_the_camera_is_a_gaussian():
    scene = facing_discs(np.full(COUNT, 2.0), 0.25, 0.0)
    only = jnp.arange(COUNT) == 3
    images = render(to_surfels(scene), to_camera(), only)
    x, y = pixel_centers().T.reshape(2, HEIGHT, WIDTH)
    squared = ((x - 14.5) * 2 / 30 / 0.25) ** 2 + ((y - 13) * 2 / 34 / 0.25) ** 2
    expected = 0.5 * np.exp(-squared / 2)
    expected = np.where(expected < 1 / 255, 0, expected)
    np.testing.assert_allclose(images["alpha"], expected, atol=1e-6)
    np.testing.assert_allclose(images["depth"], np.where(expected > 0, 2, 0), atol=1e-6)
    np.testing.assert_allclose(images["normal"], expected[..., None] * [0, 0, -1], atol=1e-6)
    assert np.all(images["distortion"] == 0)


def test_a_tilted_disc_has_the_depth_of_its_plane():
    scene = facing_discs(np.full(COUNT, 2.0), 40.0, 0.0)
    tilt = np.array([np.cos(0.5), np.sin(0.5) * 0.6, np.sin(0.5) * 0.8, 0])
    scene["quaternions"][:] = tilt
    images = render(to_surfels(scene), to_camera())
    normal = reference.rotation_of(tilt)[:, 2]
    x, y = pixel_centers().T.reshape(2, HEIGHT, WIDTH)
    rays = np.stack([(x - 14.5) / 30, (y - 13) / 34, np.ones_like(x)], axis=-1)
    expected = 2 * normal[2] / (rays @ normal)
    seen = np.asarray(images["alpha"] > 0)
    assert seen.mean() > 0.5
    for name in ("depth", "median_depth"):
        np.testing.assert_allclose(images[name][seen], expected[seen], rtol=5e-6)


def test_distortion_keeps_its_digits_on_a_converged_surface():
    z = 2 * (1 + 1e-3 * np.random.default_rng(0).uniform(-1, 1, COUNT))
    scene = facing_discs(z, 0.5, -1.5)
    images, expected = render(to_surfels(scene), to_camera()), oracle(scene)
    np.testing.assert_allclose(images["distortion"], expected["distortion"], rtol=5e-3, atol=1e-11)


@pytest.mark.parametrize("num_scales", [2, 3])
def test_an_antialiased_image_is_the_mean_of_a_finer_one(num_scales):
    """Reduced pixels and splats of a finer image show the same, which published splats do not."""
    scene = random_scene(7, log_scale=(-5.0, -3.0), num_scales=num_scales)
    surfels, fine = to_surfels(scene), to_camera(intrinsics=8 * INTRINSICS, size=(192, 256))
    config = RasterizeConfig(capacity=2**15, near=NEAR)
    sharp = np.asarray(render(surfels, fine, config=config)["rgb"])
    expected = sharp.reshape(HEIGHT, 8, WIDTH, 8, 3).mean((1, 3))
    ours, published = (
        np.abs(np.asarray(render(surfels, to_camera(), config=c)["rgb"]) - expected).max()
        for c in (ANTIALIASED, CONFIG)
    )
    assert ours < 0.03 and published > 5 * ours
