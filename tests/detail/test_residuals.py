"""Residuals of photographs with masks say the same of what the masks leave."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.detail.add import Detail, add_detail
from jaxcloseup.detail.holes import fill_holes
from jaxcloseup.detail.residuals import _match, _subtract, render_residuals, reproduced
from jaxcloseup.detail.weights import known_weights
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.photos.depth_maps import gather_sources
from jaxcloseup.photos.pyramids import Pyramid, photograph_pyramid
from jaxcloseup.photos.views import Photograph


HEIGHT, WIDTH = 40, 50


def pyramid_of(values):
    """One level of some views, int8 `[V, H, W, 6]`."""
    count = len(values)
    extents = np.tile(np.array([HEIGHT, WIDTH], np.int32), (count, 1, 1))
    flat = jnp.asarray(values.reshape(-1, 6).astype(np.int8))
    return Pyramid(flat, jnp.ones((count, 1, 4)), jnp.asarray(extents))


def stacked(camera):
    return jax.tree.map(lambda leaf: leaf[None], camera)


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


@pytest.mark.parametrize("background", [0.3, 0.55, 0.8])
def test_a_plain_background_does_not_change_how_far_the_rest_is_reproduced(background):
    """Exact pixels, such as those of a transparent background, say nothing of the object."""
    rng = np.random.default_rng(0)
    values = rng.normal(scale=8, size=(3, HEIGHT, WIDTH, 6))
    values[:, 3:5, 3:7, :3] = 120  # which the model does not reproduce
    values[..., 3:] = 40
    rows = round((1 - background) * HEIGHT)
    values[:, rows:, :, :3] = 0
    found = np.asarray(reproduced(pyramid_of(values)))
    assert found[:, : rows - 4, 12:].mean() > 0.85 and found[:, 3:5, 3:7].max() < 0.2
    assert found[:, rows + 4 :].min(initial=1) == 1


def test_what_is_brighter_than_white_stays_so():
    """At the middle exposure; a photograph that was taken darker shows it."""
    camera = Camera(jnp.eye(3, 4), jnp.array([8.0, 8, 4, 4]), 8, 8)
    rendered = jnp.full((8, 8, 3), 1.2)
    photograph = jnp.concatenate([rendered + 0.1, jnp.ones((8, 8, 1))], axis=-1)
    same = jnp.eye(3), jnp.zeros(3)
    for brightest, added in ((1.0, 0.3), (np.inf, 0.1)):
        shown = np.asarray(_subtract(photograph, rendered, same, brightest)) / 127
        np.testing.assert_allclose(shown[..., :3], added, atol=0.01)
    hole = jnp.ones((8, 8)).at[3, 3].set(0)
    seen = jnp.asarray(hole > 0)
    filled = fill_holes(rendered * hole[..., None], hole, seen, jnp.zeros((8, 8)))
    np.testing.assert_allclose(filled[seen], 1.2, atol=1e-6)
    detail = Detail(
        pyramid_of(np.zeros((1, HEIGHT, WIDTH, 6))),
        gather_sources(
            stacked(camera), jnp.zeros((1, HEIGHT, WIDTH)), jnp.zeros((1, HEIGHT, WIDTH))
        ),
        known_weights(),
        jnp.float32(0),
        jnp.float32(0),
        brightest=jnp.float32(jnp.inf),
    )
    pixels, ones = pixel_grid(8, 8), jnp.ones((8, 8))
    np.testing.assert_allclose(add_detail(detail, camera, pixels, rendered, ones, ones).rgb, 1.2)
    detail = detail.replace(brightest=jnp.float32(1))
    np.testing.assert_allclose(add_detail(detail, camera, pixels, rendered, ones, ones).rgb, 1)


def test_what_a_mask_covers_has_the_colors_beside_it():
    """A pixel of the model's size that is partly masked is trusted, and so is what is under it."""
    focal = jnp.array([8.0, 8, 4, 4])
    camera, fine = Camera(jnp.eye(3, 4), focal, 8, 8), Camera(jnp.eye(3, 4), 8 * focal, 64, 64)
    rgb, weight = np.full((64, 64, 3), 0.1, np.float32), np.ones((64, 64), np.float32)
    weight[:, 24:28] = 0  # half of a pixel of the last level
    weight[40:, 48:] = 0  # whole ones
    pyramid = photograph_pyramid([Photograph(fine, rgb, weight)], least=(8, 8))

    def render(camera):
        shape = camera.height, camera.width
        ones = jnp.ones(shape)
        return Rendering(jnp.full((*shape, 3), 0.1), ones, ones)

    found = render_residuals(render, stacked(camera), pyramid, near=0, far=9)
    assert found.shown.sizes == ((64, 64), (32, 32), (16, 16), (8, 8))
    finest = np.asarray(found.shown.image(0, 0), np.float32) / 127
    np.testing.assert_allclose(finest[:40, :, :3], 0, atol=0.01)
    np.testing.assert_allclose(finest[:40, :, 3:], -0.8, atol=0.01)
    np.testing.assert_array_equal(finest[40:, 48:], 0)


def test_masks_do_not_change_the_match_of_exposures():
    """Photograph and render are black where masked, and alike there."""
    rng = np.random.default_rng(1)
    rgb = rng.uniform(0.2, 0.7, (HEIGHT, WIDTH, 3))
    photograph = np.concatenate([1.15 * rgb, np.ones((HEIGHT, WIDTH, 1))], -1)
    shown = np.arange(WIDTH) < 0.4 * WIDTH
    photograph, rgb = (np.where(shown[None, :, None], a, 0) for a in (photograph, rgb))
    photograph, rgb = (jnp.asarray(a, jnp.float32) for a in (photograph, rgb))
    matrix, offset = _match(photograph, rgb, jnp.ones((HEIGHT, WIDTH)), 1.0)
    changed = np.array([0.46, 0.46, 0.46]) @ np.asarray(matrix) + np.asarray(offset)
    np.testing.assert_allclose(changed, 0.4, atol=0.01)
