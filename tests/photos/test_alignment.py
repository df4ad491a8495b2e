"""Alignment: a camera that is off by a known motion comes back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points
from jaxcloseup.photos.alignment import estimate_motion, halves_agree, move_camera, shift_between


HEIGHT, WIDTH = 67, 120


def camera():
    return Camera.look_at(
        (0.3, -0.2, -2.0), (0.0, 0.1, 0.5), 0.9, height=HEIGHT, width=WIDTH, up=(0.0, -1.0, 0.0)
    )


def shown(camera):
    """Colors and z-depths of a smooth texture on a wavy surface z = f(x, y), ray by ray."""
    grid = pixel_grid(HEIGHT, WIDTH)
    depth = jnp.full((HEIGHT, WIDTH), 2.0)
    for _ in range(40):  # fixed point: the slope of the surface is small
        points = pixels_to_points(camera, grid, depth)
        x, y, z = jnp.moveaxis(points, -1, 0)
        wanted = 0.3 * jnp.sin(2 * x) * jnp.cos(1.5 * y)
        depth = depth + 0.8 * (wanted - z)
    waves = [jnp.sin(7 * x + 2 * y), jnp.cos(5 * y - 3 * x), jnp.sin(6 * (x + y))]
    return 0.5 + 0.3 * jnp.stack(waves, axis=-1), depth


MOTION = jnp.array([0.01, -0.008, 0.012, 0.004, -0.005, 0.006])


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (1.15, -0.03)])
def test_a_moved_camera_is_found_whatever_its_exposure(gain, offset):
    given = camera()
    there = move_camera(given, MOTION)
    photograph = gain * shown(there)[0] + offset
    moved = given
    before = shift_between(given, there, shown(given)[1])
    for _ in range(4):
        rgb, depth = shown(moved)
        motion = jax.jit(estimate_motion)(photograph, rgb, depth, jnp.ones_like(depth), moved)
        moved = move_camera(moved, motion)
    after = shift_between(moved, there, shown(moved)[1])
    assert before > 0.5 and after < 0.03 * before


def test_weights_of_64_bits_are_taken_beside_cameras_of_32():
    given = camera()
    rgb, depth = shown(given)
    photograph, weight = shown(move_camera(given, MOTION))[0], np.ones(depth.shape)
    expected = estimate_motion(photograph, rgb, depth, jnp.asarray(weight, jnp.float32), given)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        found = estimate_motion(photograph, rgb, depth, jnp.asarray(weight), given)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_part_that_does_not_fit_hardly_counts():
    given = camera()
    there = move_camera(given, MOTION)
    photograph = shown(there)[0].at[:12, :20].set(1.0)  # somebody walked by
    rgb, depth = shown(given)
    motion = estimate_motion(photograph, rgb, depth, jnp.ones_like(depth), given)
    after = shift_between(move_camera(given, motion), there, depth)
    assert after < 0.35 * shift_between(given, there, depth)


def test_motion_is_zero_where_nothing_tells_it():
    gray = jnp.full((HEIGHT, WIDTH, 3), 0.5)
    depth = jnp.full((HEIGHT, WIDTH), 2.0)
    for weight in (jnp.ones_like(depth), jnp.zeros_like(depth)):
        motion = estimate_motion(gray, gray, depth, weight, camera())
        np.testing.assert_array_equal(motion, 0)


def test_a_moved_camera_is_that_of_a_matrix_exponential():
    moved = move_camera(camera(), MOTION)
    x, y, z = map(float, MOTION[3:])
    turn = jax.scipy.linalg.expm(jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    np.testing.assert_allclose(moved.rotation, camera().rotation @ turn, atol=1e-6)
    ahead = camera().position + camera().rotation @ MOTION[:3]
    np.testing.assert_allclose(moved.position, ahead, atol=1e-6)


def test_halves_agree_on_a_motion_but_not_on_noise():
    rgb, depth = shown(camera())
    weight = jnp.ones_like(depth)
    photograph = shown(move_camera(camera(), MOTION))[0]
    noise = 0.05 * jax.random.normal(jax.random.key(0), (40, *rgb.shape))
    compare = jax.jit(halves_agree)
    assert compare(photograph, rgb, depth, weight, camera()) > 0.9
    alike = [float(compare(rgb + part, rgb, depth, weight, camera())) for part in noise]
    assert abs(np.mean(alike)) < 0.25 and np.max(alike) < 0.9


def test_pixels_without_weight_say_nothing():
    rgb, depth = shown(camera())
    photograph = shown(move_camera(camera(), MOTION))[0]
    ours = jnp.arange(WIDTH)[None] < WIDTH // 2
    weight = jnp.broadcast_to(jnp.where(ours, 1.0, 0.0), depth.shape)
    other = jnp.where(ours[..., None], photograph, 0.9 - photograph)
    motions = [
        estimate_motion(image, rgb, jnp.where(weight > 0, depth, 7.0), weight, camera())
        for image in (photograph, other)
    ]
    np.testing.assert_allclose(*motions, atol=1e-6)
