import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.warp import backward_warp, forward_warp


HEIGHT, WIDTH = 6, 9


@pytest.fixture
def image(key):
    return jax.random.uniform(key, (HEIGHT, WIDTH, 3))


def sources(key, count=300):
    """Random sources, several on each pixel, some outside and some behind the camera."""
    keys = jax.random.split(key, 3)
    values = jax.random.uniform(keys[0], (count, 3))
    pixels = jax.random.uniform(keys[1], (count, 2), minval=-2, maxval=jnp.array([[11.0, 8.0]]))
    return values, pixels, jax.random.uniform(keys[2], (count,), minval=-0.5, maxval=3)


@pytest.mark.parametrize("order", [0, 1])
def test_reading_pixel_centers_gives_the_image(image, order):
    np.testing.assert_allclose(
        backward_warp(image, pixel_grid(HEIGHT, WIDTH), order=order), image, atol=1e-6
    )


@pytest.mark.parametrize("jit", [False, True])
@pytest.mark.parametrize(
    ("order", "interpolation"), [(0, cv2.INTER_NEAREST), (1, cv2.INTER_LINEAR)]
)
def test_reading_matches_opencv(key, image, order, interpolation, jit):
    # Multiples of 1/32 are exact in OpenCV's fixed-point interpolation; odd ones avoid its ties.
    steps = jax.random.randint(key, (50, 2), 0, jnp.array([[WIDTH, HEIGHT]]) * 16) * 2 + 1
    pixels = steps.astype(jnp.float32) / 32
    read = jax.jit(backward_warp, static_argnames="order") if jit else backward_warp
    expected = cv2.remap(
        np.asarray(image),
        np.asarray(pixels, np.float32)[None] - 0.5,
        None,
        interpolation,
        borderMode=cv2.BORDER_REPLICATE,
    )[0]
    np.testing.assert_allclose(read(image, pixels, order=order), expected, atol=1e-5)


def test_outside_is_filled_and_nan_is_outside(image):
    pixels = jnp.array([[-0.1, 1.0], [1.0, HEIGHT + 0.1], [jnp.nan, 1.0], [WIDTH, 1.0]])
    np.testing.assert_array_equal(backward_warp(image, pixels, fill_value=0.25), 0.25)
    gradient = jax.grad(lambda p: jnp.sum(backward_warp(image, p)))(pixels)
    np.testing.assert_array_equal(gradient, 0)


def test_gradient_with_respect_to_pixels_is_the_slope(image):
    def read(x):
        return backward_warp(image, jnp.stack([x, jnp.float32(2.5)]))[0]

    slope = image[2, 4, 0] - image[2, 3, 0]
    np.testing.assert_allclose(jax.grad(read)(jnp.float32(4.1)), slope, atol=1e-6)


def test_an_unknown_order_is_refused(image):
    with pytest.raises(ValueError, match="order must be 0"):
        backward_warp(image, jnp.zeros((1, 2)), order=3)


@pytest.mark.parametrize("jit", [False, True])
def test_forward_warp_matches_the_oracle(key, jit):
    values, pixels, depth = sources(key)
    warp = jax.jit(forward_warp, static_argnames="shape") if jit else forward_warp
    result = warp(values, pixels, depth, shape=(HEIGHT, WIDTH))
    expected, buffer = reference.forward_warp(
        *map(np.asarray, (values, pixels, depth)), (HEIGHT, WIDTH)
    )
    np.testing.assert_array_equal(result.values, expected.astype(np.float32))
    np.testing.assert_array_equal(result.depth, buffer.astype(np.float32))
    np.testing.assert_array_equal(result.hit, np.isfinite(buffer))


def test_forward_warp_does_not_depend_on_the_order_of_its_sources(key):
    everything = sources(key)
    shuffled = jax.random.permutation(key, everything[2].size)
    one = forward_warp(*everything, shape=(HEIGHT, WIDTH))
    other = forward_warp(*(array[shuffled] for array in everything), shape=(HEIGHT, WIDTH))
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_drawing_in_two_parts_equals_drawing_at_once(key):
    values, pixels, depth = sources(key)
    depth = jnp.round(depth, 1)  # many exact ties, which the lower index must win
    whole = forward_warp(values, pixels, depth, shape=(HEIGHT, WIDTH))
    first = forward_warp(values[:99], pixels[:99], depth[:99], shape=(HEIGHT, WIDTH))
    both = forward_warp(values[99:], pixels[99:], depth[99:], shape=(HEIGHT, WIDTH), into=first)
    jax.tree.map(np.testing.assert_array_equal, whole, both)
    expected, _ = reference.forward_warp(*map(np.asarray, (values, pixels, depth)), (HEIGHT, WIDTH))
    np.testing.assert_array_equal(whole.values, expected.astype(np.float32))


def test_invalid_sources_are_not_drawn(key):
    values, pixels, depth = sources(key)
    valid = values[:, 0] < 0.5
    result = forward_warp(values, pixels, depth, shape=(HEIGHT, WIDTH), valid=valid)
    expected, _ = reference.forward_warp(
        *(np.asarray(array)[np.asarray(valid)] for array in (values, pixels, depth)),
        (HEIGHT, WIDTH),
    )
    np.testing.assert_array_equal(result.values, expected.astype(np.float32))
    nothing = forward_warp(values, pixels, depth, shape=(HEIGHT, WIDTH), valid=valid & False)
    assert not jnp.any(nothing.hit)
    assert jnp.all(jnp.isinf(nothing.depth))


def test_no_sources_leave_the_target_as_it_is(key):
    values, pixels, depth = sources(key)
    first = forward_warp(values, pixels, depth, shape=(HEIGHT, WIDTH))
    none = (values[:0], pixels[:0], depth[:0])
    both = forward_warp(*none, shape=(HEIGHT, WIDTH), into=first)
    jax.tree.map(np.testing.assert_array_equal, both, first)
    assert not forward_warp(*none, shape=(HEIGHT, WIDTH)).hit.any()


def test_no_step_on_the_way_is_nan(key):
    """So that programs can look for NaN of their own."""
    with jax.debug_nans(True):
        forward_warp(*sources(key), shape=(HEIGHT, WIDTH))


def test_the_same_camera_maps_every_pixel_to_itself(key, image):
    camera = Camera(jnp.eye(3, 4), jnp.array([8.0, 7, 4.4, 3.1]), HEIGHT, WIDTH)
    depth = jax.random.uniform(key, (HEIGHT, WIDTH), minval=1, maxval=2)
    points = pixels_to_points(camera, pixel_grid(HEIGHT, WIDTH), depth)
    pixels, z = points_to_pixels(camera, points)
    forward = forward_warp(image, pixels, z, shape=(HEIGHT, WIDTH))
    np.testing.assert_array_equal(forward.values, image)
    np.testing.assert_allclose(backward_warp(image, pixels), image, atol=1e-4)


def test_under_vmap_each_target_is_its_own(key):
    values, pixels, depth = (array[:240].reshape(3, 80, -1) for array in sources(key))
    depth = depth[..., 0]
    batched = jax.vmap(lambda *s: forward_warp(*s, shape=(HEIGHT, WIDTH)))(values, pixels, depth)
    for index in range(3):
        expected, _ = reference.forward_warp(
            *(np.asarray(array[index]) for array in (values, pixels, depth)), (HEIGHT, WIDTH)
        )
        np.testing.assert_array_equal(batched.values[index], expected.astype(np.float32))


def test_gradients_reach_the_values_and_depths_that_won(key):
    values, pixels, depth = sources(key)

    def total(values, depth):
        warped = forward_warp(values, pixels, depth, shape=(HEIGHT, WIDTH))
        return jnp.sum(warped.values) + jnp.sum(jnp.where(warped.hit, warped.depth, 0))

    by_value, by_depth = jax.grad(total, argnums=(0, 1))(values, depth)
    winners = forward_warp(values, pixels, depth, shape=(HEIGHT, WIDTH)).hit.sum()
    np.testing.assert_array_equal(by_value.sum(), 3 * winners)
    np.testing.assert_array_equal(by_depth, by_value[:, 0])
