"""Close-up cameras for clicks on the plane z = 0."""

import jax.numpy as jnp
import numpy as np
import plane
import pytest

from jaxcloseup.app.view.picking import (
    closeup_camera,
    rank_views,
    ray_camera,
    surface_depth,
    vertical_fov,
    viewer_camera,
    window_size,
)
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import pixels_to_points, points_to_pixels


@pytest.mark.parametrize("direction", [(0, 0, -2), (1, 0.5, -1), (0, 1, 0)])
def test_a_point_on_the_ray_is_at_the_center_pixel_at_its_distance(direction):
    origin, direction = np.array([1.0, 2, 3]), np.array(direction, float)
    camera = ray_camera(origin, direction, 50.0)
    point = origin + 7 * direction / np.linalg.norm(direction)
    pixel, depth = points_to_pixels(camera, jnp.asarray(point, jnp.float32))
    np.testing.assert_allclose([*pixel, depth], [1.5, 1.5, 7], atol=1e-4)
    assert (camera.height, camera.width) == (3, 3)


@pytest.mark.parametrize("pixel", [(0.0, 0.0), (13.7, 20.2), (31.9, 23.9)])
def test_the_depth_of_one_pixel_is_that_of_the_surface_there(pixel):
    def render(camera):
        rgb, depth, _ = plane.surface(camera)
        return Rendering(rgb, depth, jnp.ones_like(depth))

    camera = plane.camera_above(0.0, 0.0, 4.0, tilt=0.2)
    center = jnp.floor(jnp.array(pixel)) + 0.5
    depth = surface_depth(render, camera, pixel)
    np.testing.assert_allclose(
        pixels_to_points(camera, center, jnp.float32(depth))[2], 0, atol=1e-4
    )
    assert surface_depth(render, camera, pixel, far=0.9 * depth) == 0


@pytest.mark.parametrize("magnification", [1.0, 4.0])
def test_a_closeup_looks_at_the_point_from_the_right_distance(magnification):
    source, point = plane.camera_above(0.5, -0.2, 4.0, tilt=0.2), np.array([0.9, 0.4, 0.0])
    camera = closeup_camera(source, point, magnification)
    pixel, depth = points_to_pixels(camera, jnp.asarray(point, jnp.float32))
    distance = np.linalg.norm(point - [0.5, -0.2, 4.0]) / magnification
    np.testing.assert_allclose([*pixel, depth], [16, 12, distance], rtol=1e-5)
    # On the same line, and not rolled: the source's up direction is perpendicular to right.
    offset = np.asarray(camera.position) - point
    np.testing.assert_allclose(offset * magnification, [0.5, -0.2, 4.0] - point, atol=1e-5)
    assert abs(float(camera.rotation[:, 0] @ source.rotation[:, 1])) < 1e-6
    assert float(camera.rotation[:, 1] @ source.rotation[:, 1]) > 0
    np.testing.assert_array_equal(camera.intrinsics, source.intrinsics)


def rank(cameras, point, direction, change=lambda depths: depths):
    views, depths = plane.make_views(cameras)
    data = (jnp.asarray(array, jnp.float32) for array in (point, direction))
    return np.asarray(rank_views(views, change(depths), *data))


def test_the_finest_photograph_from_the_clicked_direction_ranks_first():
    cameras = [
        plane.camera_above(0.0, 0.0, 4.0),
        plane.camera_above(0.0, 0.0, 2.0),
        plane.camera_above(0.0, -1.6, 1.2, tilt=0.9),
        plane.camera_above(9.0, 0.0, 4.0),
    ]
    point, down = np.zeros(3), (0, 0, -3)
    found = rank(cameras, point, down)
    # The focal length over the depth, times the cosine.
    slanted = plane.FOCAL / (1.6 * np.sin(0.9) + 1.2 * np.cos(0.9)) * 1.2 / np.hypot(1.6, 1.2)
    np.testing.assert_allclose(found, [7.5, 15, slanted, 0], rtol=1e-4)
    assert rank(cameras, point, (0, 1.6, -1.2)).argmax() == 2
    assert 0 < rank(cameras, point, (0, 0, 1))[0] < 0.01  # clicked from below
    # The second photograph shows a nearer surface there.
    hidden = rank(cameras, point, down, lambda depths: depths.at[1].multiply(0.9))
    np.testing.assert_allclose(hidden, [7.5, 0, slanted, 0], rtol=1e-4)


def test_a_viewer_camera_has_the_given_field_of_view():
    like = plane.camera_above(0, 0, 4)
    camera = viewer_camera(np.eye(3), np.array([1.0, 2, 3]), 0.8, like)
    assert vertical_fov(camera) == pytest.approx(0.8)
    # A point half of 0.8 above the optical axis is at the upper edge.
    point = jnp.array([1, 2 - np.tan(0.4), 4], jnp.float32)
    np.testing.assert_allclose(points_to_pixels(camera, point)[0], [16, 0], atol=1e-4)


def test_a_window_that_is_drawn_with_fewer_pixels_keeps_its_size():
    size = window_size(1280, 800, (0, 0))
    assert size == (1280, 800)
    assert window_size(959, 600, size) == size  # three quarters of the pixels of a side
    assert window_size(640, 399, size) == size
    assert window_size(1440, 900, size) == (1440, 900)  # grows
    assert window_size(900, 800, size) == (900, 800)  # another shape
    assert window_size(1280, 790, size) == (1280, 790)
    large = window_size(3840, 2160, size)
    assert large == (1886, 1061) and window_size(1920, 1080, large) == large
