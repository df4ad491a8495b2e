import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.geometry.masks import depth_consistent, in_bounds, rgb_consistent


def test_the_image_covers_its_lower_edges_and_not_its_upper_ones():
    pixels = jnp.array([[0, 0], [3.9, 1.9], [4, 1], [3, 2], [-0.1, 1], [1, -0.1], [jnp.nan, 1]])
    np.testing.assert_array_equal(in_bounds(pixels, 2, 4), [True, True] + [False] * 5)


@pytest.mark.parametrize(
    ("observed", "expected", "tolerance", "consistent"),
    [
        (2.0, 2.0, 0.0, True),
        (2.25, 2.0, 0.125, True),  # the tolerance is relative, and its end counts
        (1.74, 2.0, 0.125, False),
        (0.0, 2.0, 0.5, False),  # no observed depth
        (0.0, 2.0, np.inf, True),
        (-1.0, -1.0, np.inf, False),  # behind the camera
        (np.inf, np.inf, np.inf, False),
        (1.0, np.nan, np.inf, False),
    ],
)
def test_depths_agree_within_a_relative_tolerance(observed, expected, tolerance, consistent):
    observed, expected = jnp.float32(observed), jnp.float32(expected)
    assert depth_consistent(observed, expected, tolerance) == consistent


def test_colors_agree_if_every_channel_does():
    a = jnp.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    b = jnp.array([[0.5, 0.625, 0.375], [0.5, 0.5, 0.75], [0.5, 0.5, 0.5]])
    np.testing.assert_array_equal(rgb_consistent(a, b, 0.25), [True, False, True])
    assert not jnp.any(rgb_consistent(a, a, 0.0))
    levels = jnp.array([[2, 2, 2]], jnp.uint8), jnp.array([[3, 3, 3]], jnp.uint8)
    assert rgb_consistent(*levels, 2).all() and rgb_consistent(*levels[::-1], 2).all()
