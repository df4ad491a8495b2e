"""Tile lists against lists made one tile and one splat at a time."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.fields.splats import tiling
from jaxcloseup.fields.splats.tiling import _sort_pairs, tile_lists


HEIGHT, WIDTH, TILE = 24, 37, 8


def random_boxes(count=40):
    rng = np.random.default_rng(0)
    center = rng.uniform(-10, 50, (count, 2))
    half = rng.exponential(4, (count, 2)) - 0.3  # some are empty
    box = np.concatenate([center - half, center + half], axis=1).astype(np.float32)
    box[0] = [-np.inf, -1e30, np.inf, 1e30]
    return box, rng.integers(1, 6, count).astype(np.float32)  # many ties


def expected_lists(box, order):
    lists = []
    for top in range(0, HEIGHT, TILE):
        for left in range(0, WIDTH, TILE):
            x = np.arange(left, min(left + TILE, WIDTH)) + 0.5
            y = np.arange(top, min(top + TILE, HEIGHT)) + 0.5
            touched = [
                i
                for i in np.argsort(order, kind="stable")
                if any((box[i, 0] <= x) & (x <= box[i, 2]))
                and any((box[i, 1] <= y) & (y <= box[i, 3]))
            ]
            lists.append(touched)
    return lists


@pytest.mark.parametrize(("capacity", "shown"), [(512, 40), (60, 40), (40, 40), (512, 9)])
def test_lists_hold_the_splats_of_a_tile_nearest_first(capacity, shown, monkeypatch):
    """In parts of the room, in all of it, in too little, and of a few splats alone."""
    for name, value in {"_LARGE": 50, "_FEW": 10}.items():
        monkeypatch.setattr(tiling, name, value)
    box, order = random_boxes()
    box[shown:] = [0, 0, -1, -1]
    make = functools.partial(tile_lists, height=HEIGHT, width=WIDTH, tile=TILE, at_once=32)
    make = jax.jit(functools.partial(make, capacity=capacity))
    lists = jax.tree.map(np.asarray, make(jnp.asarray(box), jnp.asarray(order)))
    expected = expected_lists(box, order)
    total = sum(map(len, expected))
    assert lists.overflow == max(total - capacity, 0)
    assert shown == 40 or total <= 512 // 4
    if lists.overflow > 0:  # pairs of the farthest splats are missing
        pairs = sorted((order[i], i, t) for t, found in enumerate(expected) for i in found)
        kept = {(t, i) for _, i, t in pairs[:capacity]}
        expected = [[i for i in found if (t, i) in kept] for t, found in enumerate(expected)]
    for t, found in enumerate(expected):
        assert tuple(lists.origins[t]) == (t % 5 * TILE, t // 5 * TILE)
        listed = lists.splats[lists.starts[t] : lists.starts[t] + lists.counts[t]]
        np.testing.assert_array_equal(listed, found)
    assert lists.counts.sum() == min(total, capacity)


@pytest.mark.parametrize("ranks", [1000, 2**20])
def test_packed_and_unpacked_pairs_sort_alike(ranks):
    rng = np.random.default_rng(1)
    tiles = 2**13
    tile, rank = rng.integers(0, tiles, 300), rng.integers(0, ranks, 300)
    found = _sort_pairs(jnp.asarray(tile, jnp.int32), jnp.asarray(rank, jnp.int32), tiles, ranks)
    order = np.lexsort([rank, tile])
    np.testing.assert_array_equal(found[0], tile[order])
    np.testing.assert_array_equal(found[1], rank[order])


def test_more_pairs_than_int32_are_overflow():
    box = jnp.tile(jnp.array([[0.0, 0.0, 4096.0, 4096.0]]), (9000, 1))
    make = functools.partial(tile_lists, height=4096, width=4096, tile=8, capacity=64)
    assert jax.jit(make)(box, jnp.ones(9000)).overflow == 2**31 - 1
