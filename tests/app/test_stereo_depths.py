"""Depth by stereo in a run: what training begins with, on walls drawn by ray casting."""

import jax.numpy as jnp
import numpy as np
import pytest
import textured_corner
from textured_corner import SMALL_LENS, corner_views

from jaxcloseup.app.methods.method import StereoTraining
from jaxcloseup.app.run.stereo_depths import draw_points, match_photographs
from jaxcloseup.native import library
from jaxcloseup.photos.pyramids import photograph_pyramid
from jaxcloseup.photos.scene import Scene
from jaxcloseup.stereo import StereoConfig


MATCHING = StereoConfig(neighbors=4, best=2, levels=2, sweep=24, iterations=(3, 2))
pytestmark = pytest.mark.skipif(
    not library.available(), reason="there is no native library, and loops take minutes"
)


@pytest.fixture(scope="module")
def stereo():
    views, _ = corner_views()
    none = np.zeros((0, 3), np.float32)
    names = {"train": [str(view) for view in range(len(views))]}
    scene = Scene("corner", views, None, None, none, none, 2.5, 6.0, names)
    return match_photographs(scene, photograph_pyramid(views), StereoTraining(), MATCHING)


def test_training_begins_with_points_on_the_walls(stereo):
    points, colors = draw_points(stereo, 500)
    assert points.shape == colors.shape == (500, 3)
    away = np.abs(points @ textured_corner.WALLS.T - textured_corner.OFFSETS)
    away = (away / np.linalg.norm(textured_corner.WALLS, axis=1)).min(axis=1)
    assert np.median(away) < 0.005  # some 4 away
    assert np.mean(away < 0.04) > 0.9
    # A point has the color of the photographs that show it.
    for view, pose in enumerate(np.asarray(stereo.views.cameras.camtoworld)):
        x, y, z = ((points - pose[:, 3]) @ pose[:, :3]).T
        fx, fy, cx, cy = SMALL_LENS
        column, row = x / z * fx + cx, y / z * fy + cy
        inside = (column > 0) & (row > 0) & (column < 72) & (row < 54)
        seen = np.asarray(stereo.views.rgb[view])[
            row[inside].astype(int), column[inside].astype(int)
        ]
        assert np.median(np.abs(seen - 255 * colors[inside])) < 15


def test_depth_counts_where_it_is_confident(stereo):
    sources, confidence = stereo.sources, stereo.maps.confidence
    np.testing.assert_array_equal(sources.trust, confidence)
    np.testing.assert_array_equal(sources.inverse_depth > 0, confidence > 0)
    known = np.asarray(confidence) > 0
    depth = 1 / np.asarray(sources.inverse_depth)[known]
    np.testing.assert_allclose(depth, stereo.maps.depth[known], rtol=1e-6)
    assert jnp.mean(confidence > 0) > 0.5
