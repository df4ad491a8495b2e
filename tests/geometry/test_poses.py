import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.poses import (
    PoseSettings,
    closeup_position,
    four_anchors,
    perturb_rotation,
    sample_anchor,
    sample_closeup_camera,
)
from jaxcloseup.geometry.rotations import euler_to_matrix, matrix_to_euler


HEIGHT, WIDTH = 6, 8


@pytest.fixture
def camera():
    rotation = euler_to_matrix(jnp.array([0.2, -0.5, 0.1]))
    camtoworld = jnp.concatenate([rotation, jnp.array([[1.0], [2.0], [-0.5]])], axis=1)
    return Camera(camtoworld, jnp.array([7.0, 7.0, 4.0, 3.0]), HEIGHT, WIDTH)


def settings(magnification=(2.0, 8.0), max_angle=jnp.pi / 4, anchor_tolerance=jnp.inf, look_at=0.0):
    values = magnification, max_angle, anchor_tolerance, look_at
    return PoseSettings(*map(jnp.asarray, values))


def draw(key, count, *args):
    return jax.jit(jax.vmap(sample_closeup_camera, (0, None, None, None, None)))(
        jax.random.split(key, count), *args
    )


@pytest.mark.parametrize("magnification", [1.0, 2.0, 7.5])
def test_the_camera_comes_nearer_by_the_magnification(magnification):
    anchor, position = jnp.array([1.0, -2, 3]), jnp.array([-1.0, 0.5, 0])
    moved = closeup_position(anchor, position, magnification)
    far, near = position - anchor, moved - anchor
    np.testing.assert_allclose(near, far / magnification, rtol=1e-5)


def test_anchors_follow_the_weights(key):
    weight = jnp.zeros((HEIGHT, WIDTH)).at[1, 2].set(1.0).at[4, 7].set(3.0).at[0, 0].set(5.0)
    depth = jnp.ones((HEIGHT, WIDTH)).at[0, 0].set(0)  # undefined: never drawn despite its weight
    pixels = jax.vmap(sample_anchor, (0, None, None))(jax.random.split(key, 2000), depth, weight)
    heavy = jnp.all(pixels == jnp.array([[7.5, 4.5]]), axis=1)
    light = jnp.all(pixels == jnp.array([[2.5, 1.5]]), axis=1)
    assert jnp.all(heavy | light)
    assert abs(float(jnp.mean(heavy)) - 0.75) < 0.04


def test_undefined_depth_is_never_an_anchor(key):
    depth = jnp.full((HEIGHT, WIDTH), jnp.nan).at[0].set(0).at[1].set(-1).at[2].set(jnp.inf)
    depth = depth.at[5, 3].set(2.0)
    pixel = sample_anchor(key, depth, jnp.ones((HEIGHT, WIDTH)))
    np.testing.assert_array_equal(pixel, [3.5, 5.5])


def test_with_no_defined_depth_the_camera_stays_finite(key, camera):
    sampled = sample_closeup_camera(key, camera, jnp.zeros((HEIGHT, WIDTH)), settings())
    assert jnp.all(jnp.isfinite(sampled.camtoworld))


def test_angles_change_by_at_most_the_range_and_use_it(key, camera):
    rotations = jax.vmap(perturb_rotation, (0, None, None))(
        jax.random.split(key, 500), camera.rotation, 0.3
    )
    offsets = matrix_to_euler(rotations) - matrix_to_euler(camera.rotation)[None]
    assert jnp.all(jnp.abs(offsets) <= 0.3 + 1e-5)
    assert jnp.all(jnp.abs(offsets).max(axis=0) > 0.28)
    assert jnp.all(jnp.abs(offsets.mean(axis=0)) < 0.03)
    identity = jnp.broadcast_to(jnp.eye(3), rotations.shape)
    np.testing.assert_allclose(rotations @ rotations.mT, identity, atol=1e-5)


def test_without_turning_the_anchor_stays_in_place_at_the_right_distance(key, camera):
    depth = jax.random.uniform(key, (HEIGHT, WIDTH), minval=2, maxval=3)
    weight = jnp.zeros((HEIGHT, WIDTH)).at[2, 5].set(1)
    sampled = draw(key, 100, camera, depth, settings(max_angle=0.0), weight)
    anchor = pixels_to_points(camera, jnp.array([5.5, 2.5]), depth[2, 5])
    pixels, z = jax.vmap(points_to_pixels, (0, None))(sampled, anchor)
    np.testing.assert_allclose(pixels, jnp.broadcast_to(jnp.array([5.5, 2.5]), (100, 2)), atol=1e-3)
    ratio = depth[2, 5] / z
    assert jnp.all((ratio >= 2 - 1e-4) & (ratio <= 8 + 1e-4))
    assert ratio.max() - ratio.min() > 4


def test_cameras_that_look_at_the_anchor_turn_about_it(key, camera):
    depth = jax.random.uniform(key, (HEIGHT, WIDTH), minval=2, maxval=3)
    weight = jnp.zeros((HEIGHT, WIDTH)).at[2, 5].set(1)
    orbit, still = (
        draw(key, 100, camera, depth, settings(look_at=look_at), weight) for look_at in (1.0, 0.0)
    )
    anchor = pixels_to_points(camera, jnp.array([5.5, 2.5]), depth[2, 5])
    pixels, z = jax.vmap(points_to_pixels, (0, None))(orbit, anchor)
    np.testing.assert_allclose(pixels, jnp.broadcast_to(jnp.array([5.5, 2.5]), (100, 2)), atol=1e-3)
    assert jnp.all((depth[2, 5] / z >= 2 - 1e-4) & (depth[2, 5] / z <= 8 + 1e-4))
    np.testing.assert_array_equal(orbit.rotation, still.rotation)
    # Both cameras are equally far from the anchor, but on different sides of it.
    far = [jnp.linalg.norm(one.position - anchor[None], axis=1) for one in (orbit, still)]
    np.testing.assert_allclose(*far, rtol=1e-4)
    assert jnp.linalg.norm(orbit.position - still.position, axis=1).max() > 0.5


def test_anchor_tolerance_rejects_untypical_depths(key, camera):
    depth = jnp.full((HEIGHT, WIDTH), 2.0).at[:, 0].set(6)
    typical = draw(key, 200, camera, depth, settings(anchor_tolerance=0.3, max_angle=0.0), None)
    anywhere = draw(key, 200, camera, depth, settings(max_angle=0.0), None)
    moved = [
        jnp.linalg.norm(s.position - camera.position[None], axis=1) for s in (typical, anywhere)
    ]
    furthest = jnp.linalg.norm(
        pixels_to_points(camera, pixel_grid(HEIGHT, WIDTH), jnp.full((HEIGHT, WIDTH), 2.0))
        - camera.position.reshape(1, 1, 3),
        axis=-1,
    ).max()
    assert moved[0].max() < furthest
    assert moved[1].max() > furthest


def test_four_fixed_anchors_give_four_fixed_cameras(key, camera):
    weight = four_anchors(HEIGHT, WIDTH)
    depth = jnp.full((HEIGHT, WIDTH), 2.0)
    fixed = settings(magnification=(4.0, 4.0), max_angle=0.0)
    sampled = draw(key, 64, camera, depth, fixed, weight)
    positions = np.unique(np.round(np.asarray(sampled.position), 4), axis=0)
    centers = jnp.array([[2.5, 1.5], [6.5, 1.5], [2.5, 4.5], [6.5, 4.5]])
    anchors = pixels_to_points(camera, centers, jnp.full(4, 2.0))
    expected = (3 * anchors + camera.position[None]) / 4
    np.testing.assert_allclose(positions, np.unique(np.round(expected, 4), axis=0), atol=2e-4)
    np.testing.assert_allclose(sampled.rotation - camera.rotation[None], 0, atol=1e-6)
