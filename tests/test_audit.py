"""What photographs resolve of a close-up, against waves whose attenuation is known."""

import jax.numpy as jnp
import numpy as np
import plane
import pytest

from experiments.audit import resolved_by_photographs
from jaxcloseup.geometry.cameras import pixel_grid, pixels_to_rays
from jaxcloseup.scenes import Scene
from jaxcloseup.scenes.scene import Surface


WAVELENGTH = 0.3


def striped(camera):
    """The plane z = 0 with stripes along y, from above."""
    origins, directions = pixels_to_rays(camera, pixel_grid(camera.height, camera.width))
    depth = -origins[..., 2] / directions[..., 2]
    x = origins[..., 0] + depth * directions[..., 0]
    wave = 0.5 + 0.4 * jnp.sin(2 * jnp.pi * x / WAVELENGTH)
    rgb = jnp.stack([wave] * 3, axis=-1)
    return Surface(rgb, depth, jnp.zeros_like(rgb).at[..., 2].set(1))


def scene_of(cameras):
    views, depths = plane.make_views(cameras)
    names, none = {"train": [str(i) for i in range(len(cameras))]}, np.zeros((0, 3))
    return Scene("waves", views, None, None, none, none, 0.5, 9.0, names, surface=striped), depths


@pytest.mark.parametrize("heights", [(4.0,), (4.0, 2.0), (2.0, 4.0)])
def test_waves_are_as_high_as_in_the_nearest_photograph(heights):
    scene, depths = scene_of([plane.camera_above(0.0, 0.0, height) for height in heights])
    close = plane.camera_above(0.1, 0.0, 1.0)
    resolved, seen = resolved_by_photographs(scene, close, depths)
    assert seen.all()
    # Half a pixel of the photograph is the standard deviation; the close-up's own pixel is less.
    pixel = min(heights) / plane.FOCAL
    variance = pixel**2 / 4 - (1 / plane.FOCAL) ** 2 / 12
    expected = np.exp(-2 * np.pi**2 * variance / WAVELENGTH**2)
    inner = resolved[6:-6, 6:-6] - 0.5
    assert np.abs(inner).max() / 0.4 == pytest.approx(expected, rel=0.1)


def test_nothing_is_resolved_where_no_photograph_looks():
    views, depths = plane.make_views([plane.camera_above(1.0, 0.0, 1.0)])
    none = np.zeros((0, 3))
    scene = Scene(
        "waves", views, None, None, none, none, 0.5, 9.0, {"train": ["0"]}, surface=striped
    )
    close = plane.camera_above(0.0, 0.0, 1.0)
    _, seen = resolved_by_photographs(scene, close, depths)
    # The photograph is 30 pixels, 1 unit, to the right.
    x = np.asarray(pixel_grid(plane.HEIGHT, plane.WIDTH))[..., 0]
    np.testing.assert_array_equal(seen, x > 30)
