"""Residuals of photographs with masks say the same of what the masks leave."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.detail.residuals import _match, reproduced
from jaxcloseup.photos.pyramids import Pyramid


HEIGHT, WIDTH = 40, 50


def pyramid_of(values):
    """One level of some views, int8 `[V, H, W, 6]`."""
    count = len(values)
    extents = np.tile(np.array([HEIGHT, WIDTH], np.int32), (count, 1, 1))
    flat = jnp.asarray(values.reshape(-1, 6).astype(np.int8))
    return Pyramid(flat, jnp.ones((count, 1, 4)), jnp.asarray(extents))


@pytest.mark.parametrize("masked", [0.3, 0.55, 0.7])
def test_masks_do_not_change_how_far_photographs_are_reproduced(masked):
    rng = np.random.default_rng(0)
    values = rng.normal(scale=4, size=(3, HEIGHT, WIDTH, 6))
    values[:, 3:7, :4, :3] = 90  # which the model does not reproduce
    values[..., 3:] = 40
    whole = np.asarray(reproduced(pyramid_of(values)))
    rows = round((1 - masked) * HEIGHT)
    values[:, rows:] = 0
    found = np.asarray(reproduced(pyramid_of(values)))
    np.testing.assert_allclose(found[:, : rows - 4], whole[:, : rows - 4], atol=0.02)
    assert found[:, rows - 4 : rows].mean() > 0.9 and whole[:, 4:6, :2].max() < 0.1
    assert np.isfinite(reproduced(pyramid_of(np.zeros_like(values)))).all()


def test_masks_do_not_change_the_match_of_exposures():
    """Photograph and render are black where masked, and alike there."""
    rng = np.random.default_rng(1)
    rgb = rng.uniform(0.2, 0.7, (HEIGHT, WIDTH, 3))
    photograph = np.concatenate([1.15 * rgb, np.ones((HEIGHT, WIDTH, 1))], -1)
    shown = np.arange(WIDTH) < 0.4 * WIDTH
    photograph, rgb = (np.where(shown[None, :, None], a, 0) for a in (photograph, rgb))
    photograph, rgb = (jnp.asarray(a, jnp.float32) for a in (photograph, rgb))
    matrix, offset = _match(photograph, rgb, jnp.ones((HEIGHT, WIDTH)))
    changed = np.array([0.46, 0.46, 0.46]) @ np.asarray(matrix) + np.asarray(offset)
    np.testing.assert_allclose(changed, 0.4, atol=0.01)
