"""Tests of warped pixels: inside the image, same depth, same color. Elementwise over `[...]`."""

import chex
import jax
import jax.numpy as jnp


def in_bounds(pixels: jax.Array, height: int, width: int) -> jax.Array:
    """Return whether continuous pixels `[..., 2]` lie on an image: `[...]` bool.

    The image covers [0, width) x [0, height); NaN is outside.
    """
    chex.assert_axis_dimension(pixels, -1, 2)
    x, y = pixels[..., 0], pixels[..., 1]
    return (x >= 0) & (x < width) & (y >= 0) & (y < height)


def depth_consistent(
    observed: jax.Array, expected: jax.Array, tolerance: jax.Array | float
) -> jax.Array:
    """Return whether a depth map confirms a depth: |observed - expected| <= tolerance * expected.

    Args:
      observed: `[...]` z-depth read from a depth map; 0 is undefined.
      expected: `[...]` z-depth of the point in that view.
      tolerance: relative, such as 0.05; infinity accepts every point in front of the camera.

    Returns:
      `[...]` bool, False where `expected` is not positive and finite.
    """
    defined = (expected > 0) & jnp.isfinite(expected)
    return defined & (jnp.abs(observed - expected) <= tolerance * jnp.where(defined, expected, 1))


def rgb_consistent(a: jax.Array, b: jax.Array, tolerance: jax.Array | float) -> jax.Array:
    """Return whether colors `[..., 3]` differ by less than a tolerance in every channel: `[...]`.

    This is the paper's mask M = |I' - I*| < epsilon.
    """
    chex.assert_equal_shape([a, b])
    apart = jnp.where(a > b, a - b, b - a)  # differences of unsigned integers wrap
    return jnp.all(apart < tolerance, axis=-1)
