"""Pyramids: which level is chosen for a width."""

import jax.numpy as jnp
import pytest

from jaxcloseup.photos.pyramids import Pyramid


@pytest.mark.parametrize(
    ("width", "level"), [(900, 0), (600, 1), (480, 1), (320, 2), (200, 2), (10, 2)]
)
def test_a_level_is_near_a_width_or_the_coarsest(width, level):
    extents = jnp.array([[[768, 1024], [384, 512], [192, 256]]], jnp.int32)
    pyramid = Pyramid(jnp.zeros((0, 3)), jnp.ones((1, 3, 4)), extents)
    assert pyramid.level_near(width) == level
