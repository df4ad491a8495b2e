"""Antialiased images against convolved discs in NumPy, and against finer images."""

import numpy as np
import pytest
from splat_scenes import (
    ANTIALIASED,
    CONFIG,
    HEIGHT,
    INTRINSICS,
    NEAR,
    OUTPUTS,
    SCENES,
    WIDTH,
    oracle,
    random_scene,
    render,
    to_camera,
    to_surfels,
)

from jaxcloseup.fields.splats.config import RasterizeConfig


def test_antialiased_images_agree_with_convolved_discs():
    for name in ("in front", "far and small"):
        expected = oracle(SCENES[name], antialias=True)
        images = render(to_surfels(SCENES[name]), to_camera(), config=ANTIALIASED)
        assert expected["alpha"].max() > 0.1
        for output in OUTPUTS:
            np.testing.assert_allclose(images[output], expected[output], atol=2e-5, rtol=0)


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
