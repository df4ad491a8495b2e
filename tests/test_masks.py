import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.masks import depth_consistent, in_bounds, rgb_consistent


def test_in_bounds_is_half_open_and_refuses_nan():
    pixels = jnp.array([[0, 0], [3.99, 1.99], [4, 1], [1, 2], [-0.01, 1], [jnp.nan, 1]])
    np.testing.assert_array_equal(in_bounds(pixels, 2, 4), [True, True, False, False, False, False])


def test_depth_agreement_is_relative_and_needs_a_defined_depth():
    observed = jnp.array([2.0, 2.1, 2.11, 1.9, 0.0, 2.0, 2.0, jnp.nan])
    expected = jnp.array([2.0, 2.0, 2.0, 2.0, 2.0, 0.0, -1.0, 2.0])
    agree = [True, True, False, True, False, False, False, False]
    np.testing.assert_array_equal(depth_consistent(observed, expected, 0.0501), agree)


def test_infinite_tolerance_accepts_every_point_in_front():
    observed, expected = jnp.array([9.0, 0.0, 1.0]), jnp.array([2.0, 2.0, -1.0])
    np.testing.assert_array_equal(
        depth_consistent(observed, expected, jnp.inf), [True, True, False]
    )


def test_colours_agree_in_every_channel_or_not_at_all():
    a = jnp.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    b = jnp.array([[0.54, 0.46, 0.5], [0.5, 0.5, 0.56], [0.5, 0.55, 0.5]])
    np.testing.assert_array_equal(rgb_consistent(a, b, 0.049), [True, False, False])
