import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxcloseup.geometry.cameras import (
    Camera,
    pixel_grid,
    pixels_to_points,
    pixels_to_rays,
    points_to_pixels,
)
from jaxcloseup.geometry.rotations import euler_to_matrix


HEIGHT, WIDTH = 5, 7


def make_camera(angles=(0.3, -0.4, 0.2), position=(0.5, -1.0, 2.0)):
    rotation = euler_to_matrix(jnp.array(angles))
    camtoworld = jnp.concatenate([rotation, jnp.array(position)[:, None]], axis=1)
    return Camera(camtoworld, jnp.array([9.0, 11.0, 3.2, 2.9]), HEIGHT, WIDTH)


def test_pixel_grid_holds_centers_as_x_y():
    grid = pixel_grid(HEIGHT, WIDTH)
    assert grid.shape == (HEIGHT, WIDTH, 2)
    np.testing.assert_array_equal(grid[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(grid[-1, -1], [WIDTH - 0.5, HEIGHT - 0.5])


@pytest.mark.parametrize("jit", [False, True])
def test_projection_matches_the_oracle_and_opencv(key, jit):
    camera = make_camera()
    offsets = jax.random.uniform(key, (20, 3), minval=-1, maxval=1) + jnp.array([[0, 0, 3.0]])
    points = camera.position[None] + offsets @ camera.rotation.T
    project = jax.jit(points_to_pixels) if jit else points_to_pixels
    pixels, depth = project(camera, points)
    expected_pixels, expected_depth = reference.project(
        camera.camtoworld, camera.intrinsics, points
    )
    np.testing.assert_allclose(pixels, expected_pixels, atol=1e-4)
    np.testing.assert_allclose(depth, expected_depth, rtol=1e-5)

    rotation = np.asarray(camera.rotation, np.float64).T
    translation = -rotation @ np.asarray(camera.position, np.float64)
    fx, fy, cx, cy = np.asarray(camera.intrinsics, np.float64)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    from_opencv, _ = cv2.projectPoints(
        np.asarray(points, np.float64), cv2.Rodrigues(rotation)[0], translation, matrix, None
    )
    np.testing.assert_allclose(pixels, from_opencv.reshape(-1, 2), atol=1e-4)


def test_lifting_and_projecting_are_inverse(key):
    camera = make_camera()
    pixels = pixel_grid(HEIGHT, WIDTH)
    depth = jax.random.uniform(key, (HEIGHT, WIDTH), minval=0.5, maxval=4)
    points = pixels_to_points(camera, pixels, depth)
    np.testing.assert_allclose(
        points.reshape(-1, 3),
        reference.unproject(
            camera.camtoworld, camera.intrinsics, pixels.reshape(-1, 2), depth.ravel()
        ),
        atol=1e-5,
    )
    again, depth_again = points_to_pixels(camera, points)
    np.testing.assert_allclose(again, pixels, atol=1e-4)
    np.testing.assert_allclose(depth_again, depth, rtol=1e-5)


def test_ray_directions_have_unit_camera_z():
    camera = make_camera()
    origins, directions = pixels_to_rays(camera, pixel_grid(HEIGHT, WIDTH))
    np.testing.assert_allclose(directions @ camera.rotation[:, 2], 1, rtol=1e-5)
    np.testing.assert_array_equal(origins[2, 3], camera.position)


def test_batching_by_vmap_equals_one_camera_at_a_time(key):
    cameras = [make_camera(angles=(0.1 * i, 0.2, -0.3 * i)) for i in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    points = jax.random.normal(key, (6, 3))
    pixels, depth = jax.vmap(points_to_pixels, (0, None))(stacked, points)
    for index, camera in enumerate(cameras):
        one_pixels, one_depth = points_to_pixels(camera, points)
        np.testing.assert_allclose(depth[index], one_depth, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(pixels[index], one_pixels, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("depth", [-1.0, 0.0, 1e-30, 1e-6])
def test_values_and_gradients_are_finite_behind_and_in_the_camera(depth):
    camera = make_camera()
    point = camera.position + depth * camera.rotation[:, 2] + 0.1 * camera.rotation[:, 0]

    def total(camera, point):
        pixels, z = points_to_pixels(camera, point)
        return jnp.sum(pixels) + z

    value, gradients = jax.value_and_grad(total, argnums=(0, 1))(camera, point)
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((value, gradients)))


def test_a_wrong_shape_is_refused():
    camera = make_camera()
    with pytest.raises(AssertionError):
        points_to_pixels(camera, jnp.zeros((4, 2)))
    with pytest.raises(AssertionError):
        pixels_to_rays(camera.replace(camtoworld=jnp.eye(4)), jnp.zeros((4, 2)))
