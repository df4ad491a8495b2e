import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxcloseup.geometry.cameras import (
    Camera,
    crop_camera,
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


def from_matrices(make):
    """The camera of `make_camera`, from a 4x4 pose in OpenCV's or OpenGL's convention and K."""
    camera = make_camera()
    pose = np.vstack([camera.camtoworld, [0, 0, 0, 1]])
    if make == Camera.from_opengl:  # the camera looks along -z, with y up
        pose = pose @ np.diag([1.0, -1, -1, 1])
    fx, fy, cx, cy = camera.intrinsics.tolist()
    return make(pose, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], height=HEIGHT, width=WIDTH)


@pytest.mark.parametrize("make", [None, Camera.from_matrix, Camera.from_opengl])
@pytest.mark.parametrize("jit", [False, True])
def test_projection_matches_the_oracle_and_opencv(key, jit, make):
    camera = from_matrices(make) if make else make_camera()
    assert (camera.height, camera.width) == (HEIGHT, WIDTH)
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


def test_the_angle_of_view_is_that_between_the_edges():
    pose = make_camera().camtoworld
    for fov, vertical in ((0.9, False), (1.7, False), (0.6, True)):
        camera = Camera.from_fov(pose, fov, height=HEIGHT, width=WIDTH, vertical=vertical)
        x, y = (0, np.tan(fov / 2)) if vertical else (np.tan(fov / 2), 0)
        edge = camera.position + 3 * camera.rotation @ jnp.array([x, y, 1.0])
        pixel, _ = points_to_pixels(camera, edge)
        at = [WIDTH / 2, HEIGHT] if vertical else [WIDTH, HEIGHT / 2]
        np.testing.assert_allclose(pixel, at, atol=1e-4)
        assert camera.intrinsics[0] == camera.intrinsics[1]


@pytest.mark.parametrize("up", [(0.0, 0.0, 2.0), (0.3, -1.0, 0.2)])
def test_a_camera_looks_at_its_target_with_up_on_top(up):
    position, target = np.array([1.0, -2.0, 0.5]), np.array([-0.5, 1.0, 1.5])
    camera = Camera.look_at(position, target, 0.8, height=HEIGHT, width=WIDTH, up=up)
    pixels, depth = points_to_pixels(camera, jnp.stack([target, target + 0.1 * np.array(up)]))
    np.testing.assert_allclose(pixels[0], [WIDTH / 2, HEIGHT / 2], atol=1e-5)
    np.testing.assert_allclose(depth[0], np.linalg.norm(target - position), rtol=1e-6)
    np.testing.assert_allclose(pixels[1, 0], WIDTH / 2, atol=1e-4)
    assert pixels[1, 1] < HEIGHT / 2
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-6)
    assert jnp.linalg.det(camera.rotation) > 0


def test_a_camera_may_look_straight_along_up():
    def rotation(target):
        return Camera.look_at((0, 0, 3), target, 0.8, height=HEIGHT, width=WIDTH).rotation

    down = rotation(jnp.zeros(3))
    np.testing.assert_allclose(down @ down.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(down[:, 2], [0, 0, -1], atol=1e-6)
    assert jnp.all(jnp.isfinite(jax.jacobian(rotation)(jnp.zeros(3))))


def test_a_wrong_shape_is_refused():
    camera = make_camera()
    with pytest.raises(AssertionError):
        points_to_pixels(camera, jnp.zeros((4, 2)))
    with pytest.raises(AssertionError):
        pixels_to_rays(camera.replace(camtoworld=jnp.eye(4)), jnp.zeros((4, 2)))


def test_rays_have_the_type_of_their_camera():
    """With 64 bits, a pixel grid has them; what follows must not change its type for that."""
    with jax.enable_x64(True):
        camera = Camera(
            jnp.eye(3, 4, dtype=jnp.float32), jnp.array([9, 9, 3, 2], jnp.float32), 4, 6
        )
        grid = pixel_grid(4, 6)
        depth = jnp.ones((4, 6), jnp.float32)
        assert grid.dtype == jnp.float64
        assert pixels_to_points(camera, grid, depth).dtype == jnp.float32
        assert crop_camera(camera, jnp.array([1, 2]), height=2, width=2).intrinsics.dtype == "f4"
