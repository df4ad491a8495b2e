"""Pairs of tiles and surfels that are worth listing, against every pixel of every tile."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splat_scenes import CROWDS, HEIGHT, NEAR, WIDTH, drawn, footprints_of, to_camera, to_surfels

from jaxcloseup.fields.splats.layout import pack
from jaxcloseup.fields.splats.tile_test import reaches


_reaches = jax.jit(reaches, static_argnames=("tile", "near"))


def pixels_of(corners, at):
    """Points `[T, P, 2]` of tiles with these corners, at steps along both sides."""
    x, y = np.meshgrid(at, at)
    return corners[:, None] + np.stack([x.ravel(), y.ravel()], axis=-1)[None]


@pytest.mark.parametrize("antialias", [False, True], ids=["low-pass", "antialiased"])
@pytest.mark.parametrize("tile", [4, 8])
@pytest.mark.parametrize("name", CROWDS)
def test_a_surfel_is_listed_where_it_draws_and_hardly_elsewhere(name, tile, antialias):
    scene = CROWDS[name]
    footprints = footprints_of(to_surfels(scene), to_camera(), antialias)
    corners = np.stack(np.meshgrid(range(0, WIDTH, tile), range(0, HEIGHT, tile)), -1)
    corners = corners.reshape(-1, 2)
    splat, where = np.mgrid[: len(scene["means"]), : len(corners)].reshape(2, -1)
    splat, corner = jnp.asarray(splat), jnp.asarray(corners[where])
    found = _reaches(pack(footprints), splat, corner, tile=tile, near=NEAR)
    visible = np.asarray(footprints.opacity) > 0  # the boxes of others are empty
    found = np.asarray(found).reshape(-1, len(corners)) & visible[:, None]

    at_pixels = drawn(scene, pixels_of(corners, np.arange(tile) + 0.5), antialias).any(-1)
    assert at_pixels.any() and not np.any(at_pixels & ~found)
    # The test is about all points between pixel centers, of surfels that end before the near plane.
    fine = np.linspace(0.5, tile - 0.5, 4 * tile + 1)
    nearby = drawn(scene, pixels_of(corners, fine), antialias).any(-1)
    whole = np.asarray(footprints.inverse_depth[1]) < 0.99 / NEAR
    assert np.mean(found[whole] & ~nearby[whole]) < 0.03 * np.mean(found[whole])


def test_no_tile_lists_a_surfel_that_misses_it():
    """A thin disc along the diagonal of an image: its box has every tile, it draws in few."""
    tile, tiles = 8, 8
    table = np.zeros((1, 16), np.float32)
    table[0, :2] = tile * tiles / 2
    # u along the diagonal, v across it, standard deviations of 12 and 0.15 pixels, depth 1.
    table[0, 2:11] = np.ravel([[0, 1 / 17, 1 / 17], [0, 4.71, -4.71], [1, 0, 0]])
    table[0, 11:15] = 0.9, 1e9, 0.5, 1
    corners = tile * np.stack(np.mgrid[:tiles, :tiles], -1).reshape(-1, 2)
    zeros = jnp.zeros(len(corners), jnp.int32)
    found = _reaches(jnp.asarray(table), zeros, jnp.asarray(corners), tile=tile, near=0.1)
    expected = np.eye(tiles, dtype=bool)
    np.testing.assert_array_equal(np.asarray(found).reshape(tiles, tiles), expected)
