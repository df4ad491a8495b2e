"""Errors of depth and normals, on planes and points whose exact errors are known."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.app.score.surface_error import find_landmarks, point_depth_error, surface_error
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.fields.splats.render import SurfelAux
from jaxcloseup.fields.splats.splat_field import SurfelFieldAux
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.photos.scene import Surface


CAMERA = Camera(jnp.eye(4)[:3], jnp.array([24.0, 24.0, 24.0, 12.0]), height=24, width=48)


def tilted_plane(slope):
    """Return the depth of the plane z = 2 + slope x, and its normal towards the camera."""
    x = (pixel_grid(24, 48)[..., 0] - 24) / 24
    normal = jnp.array([slope, 0, -1]) / np.hypot(slope, 1)
    return 2 / (1 - slope * x), jnp.broadcast_to(normal, (24, 48, 3))


def test_a_tilt_is_measured_in_degrees():
    depth, _ = tilted_plane(0.0)
    _, normal = tilted_plane(np.tan(np.deg2rad(20)))
    surface = Surface(jnp.zeros((24, 48, 3)), depth, normal)
    ones = jnp.ones((24, 48))
    found = surface_error(CAMERA, Rendering(jnp.zeros((24, 48, 3)), 1.1 * depth, ones), surface)
    assert float(found["normal_error_median"]) == pytest.approx(20, abs=0.01)
    assert float(found["depth_error_median"]) == pytest.approx(0.1, rel=1e-4)
    assert float(found["depth_error_p90"]) == pytest.approx(0.1, rel=1e-4)


def test_rendered_normals_are_used_and_empty_pixels_do_not_count():
    depth, normal = tilted_plane(0.4)
    hit = jnp.arange(48)[None] < 24
    surface = Surface(jnp.zeros((24, 48, 3)), jnp.where(hit, depth, 0), normal)
    zeros = jnp.zeros((24, 48))
    rendered = jnp.where(hit[..., None], 0.3 * normal, -normal)  # composited, not normalized
    inner = SurfelAux(rendered, depth, zeros, jnp.int32(0))
    aux = SurfelFieldAux(inner, zeros, jnp.float32(0), depth, None)
    found = surface_error(CAMERA, Rendering(normal, jnp.where(hit, depth, 9), zeros, aux), surface)
    assert float(found["normal_error_p90"]) == pytest.approx(0, abs=0.05)
    assert float(found["depth_error_p90"]) == 0


def test_landmarks_are_the_visible_points():
    points = np.array(
        [
            [0.0, 0.0, 2.0],  # at pixel (24, 12)
            [0.01, 0.0, 3.0],  # hidden by the first
            [0.01, 0.0, 2.05],  # on the same surface
            [0.5, 0.2, 4.0],  # at pixel (27, 13.2), in another cell
            [0.0, 0.0, -1.0],  # behind the camera
            [9.0, 0.0, 2.0],  # outside the image
        ]
    )
    found = find_landmarks(CAMERA, points)
    np.testing.assert_array_equal(found.column, [24, 24, 27])
    np.testing.assert_array_equal(found.row, [12, 12, 13])
    np.testing.assert_allclose(found.depth, [2, 2.05, 4], rtol=1e-6)
    depth = np.full((24, 48), 2.0)
    depth[13, 27] = 5.0
    error = point_depth_error(depth, found)
    assert error["point_depth_error_median"] == pytest.approx(0.05 / 2.05)
    none = find_landmarks(CAMERA, points[4:])
    assert np.isnan(point_depth_error(depth, none)["point_depth_error_median"])
