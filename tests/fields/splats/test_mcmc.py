"""MCMC density control: copies keep the light, dead surfels move, noise stays in the plane."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_splats import rotation_of
from splat_scenes import COUNT, HEIGHT, NEAR, WIDTH, random_scene, render, to_camera, to_surfels

from jaxcloseup.fields.splats import RasterizeConfig
from jaxcloseup.fields.splats.config import McmcConfig
from jaxcloseup.fields.splats.mcmc import add_position_noise, relocate, split_opacity


CONFIG = McmcConfig(growth=1.5)
move = jax.jit(relocate, static_argnames="config")


def logit(opacity):
    return np.log(opacity) - np.log1p(-np.asarray(opacity, float))


@pytest.mark.parametrize("opacity", [0.02, 0.5, 0.9])
@pytest.mark.parametrize("copies", [1, 2, 3, 10, 51])
def test_copies_absorb_as_much_light_as_the_original(opacity, copies):
    each, smaller = split_opacity(jnp.array([opacity]), jnp.array([copies]))
    each, smaller = float(each[0]), float(smaller[0])
    # Light that n coincident discs absorb at distance r, integrated over their plane.
    radius = np.linspace(0, 10, 20_001)
    through = (1 - each * np.exp(-0.5 * (radius / smaller) ** 2)) ** copies
    taken = np.trapezoid((1 - through) * 2 * np.pi * radius, radius)
    assert taken == pytest.approx(opacity * 2 * np.pi, rel=1e-3)
    assert 1 - (1 - each) ** copies == pytest.approx(opacity, rel=1e-4)


def scene_with_dead(dead):
    scene = random_scene(3)
    scene["opacity_logits"] = logit(np.where(np.isin(np.arange(COUNT), dead), 0.004, 0.6))
    return to_surfels(scene)


def test_dead_surfels_join_living_ones(key):
    before = scene_with_dead([0, 5, 6])
    alive = jnp.arange(COUNT) < 10
    after, now_alive, changed = move(key, before, alive, config=CONFIG)
    assert now_alive.sum() == 15  # growth by one half
    opacity = jax.nn.sigmoid(after.opacity_logits)
    assert np.all(opacity[now_alive] > CONFIG.min_opacity)
    # Every surfel now has the position of a surfel that was alive before.
    living = [i for i in range(10) if i not in (0, 5, 6)]
    source = [
        [i for i in living if np.array_equal(before.means[i], mean)]
        for mean in np.asarray(after.means)[np.asarray(now_alive)]
    ]
    assert all(len(found) == 1 for found in source)
    times = np.bincount([found[0] for found in source], minlength=COUNT)
    for row, (found,) in zip(np.nonzero(now_alive)[0], source, strict=True):
        n = times[found]
        expected = 1 - (1 - 0.6) ** (1 / n)
        assert float(opacity[row]) == pytest.approx(expected, rel=1e-4)
        _, smaller = split_opacity(jnp.array([0.6]), jnp.array([int(n)]))
        factor = np.exp(np.asarray(after.log_scales[row] - before.log_scales[found]))
        np.testing.assert_allclose(factor, float(smaller[0]), rtol=1e-4)
        np.testing.assert_array_equal(after.quaternions[row], before.quaternions[found])
        np.testing.assert_array_equal(after.sh[row], before.sh[found])
        assert bool(changed[row]) == (n > 1)


def test_tiny_counts_grow_by_one(key):
    alive = jnp.arange(COUNT) < 2
    _, now, _ = move(key, scene_with_dead([]), alive, config=McmcConfig(growth=1.1))
    assert now.sum() == 3


def test_donors_are_drawn_by_their_opacity():
    opacity = np.full(COUNT, 0.004)
    opacity[:2] = 0.2, 0.6
    scene = random_scene(3)
    scene["opacity_logits"] = logit(opacity)
    surfels = to_surfels(scene)
    joined = np.zeros(2)
    for seed in range(60):
        after, _, _ = move(jax.random.key(seed), surfels, jnp.ones(COUNT, bool), config=CONFIG)
        moved, means = np.asarray(after.means)[2:], np.asarray(surfels.means)
        joined += [np.sum(np.all(moved == means[i], axis=1)) for i in range(2)]
    assert joined.sum() == 60 * (COUNT - 2)
    assert joined[1] / joined.sum() == pytest.approx(0.75, abs=0.05)


def test_nothing_changes_when_all_or_none_are_dead(key):
    scene = random_scene(3)
    full = jnp.ones(COUNT, bool)
    for opacity in (0.001, 0.7):
        scene["opacity_logits"] = np.full(COUNT, logit(opacity))
        before = to_surfels(scene)
        after, alive, changed = move(key, before, full, config=CONFIG)
        jax.tree.map(np.testing.assert_array_equal, after, before)
        assert alive.all()
        assert not changed.any()


def test_the_image_hardly_changes(key):
    scene = random_scene(8, depth=(1.5, 1.9), log_scale=(-2.5, -1.5))
    scene["opacity_logits"] = np.full(COUNT, logit(0.5))
    alive = jnp.arange(COUNT) < 12
    before = to_surfels(scene)
    after, now_alive, _ = move(key, before, alive, config=McmcConfig(growth=1.3))
    assert now_alive.sum() == 15
    config = RasterizeConfig(capacity=2048, near=NEAR, tile=8, chunk=4, block=4)
    images = [render(s, to_camera(), a, config) for s, a in ((before, alive), (after, now_alive))]
    lost = np.abs(images[0]["alpha"] - images[1]["alpha"])
    assert lost.max() < 0.1
    assert lost.sum() < 0.03 * images[0]["alpha"].sum()
    assert images[0]["alpha"].shape == (HEIGHT, WIDTH)


@pytest.mark.parametrize("num_scales", [2, 3])
def test_noise_moves_faint_surfels_in_their_plane_and_volumes_in_space(key, num_scales):
    scene = random_scene(4, num_scales=num_scales)
    scene["opacity_logits"] = logit(np.where(np.arange(COUNT) < 8, 0.006, 0.9))
    surfels = to_surfels(scene)
    alive = jnp.arange(COUNT) < 12
    move_means = jax.jit(add_position_noise, static_argnames="config")
    moves = np.stack(
        [
            move_means(k, surfels, alive, jnp.float32(1e-3), config=McmcConfig(noise=100)).means
            - surfels.means
            for k in jax.random.split(key, 400)
        ]
    )
    assert np.all(moves[:, 12:] == 0)
    rotation = np.stack([rotation_of(q) for q in np.asarray(surfels.quaternions, float)])
    along = np.einsum("knc,nci->kni", moves, rotation)
    if num_scales == 2:
        assert np.abs(along[..., 2]).max() < 1e-5 * np.abs(along).max()
    faint = 1 / (1 + np.exp(100 * (0.006 - 0.005)))
    expected = np.exp(2 * np.asarray(surfels.log_scales)) * faint * 1e-3 * 100
    found = along[:, :8, :num_scales].std(axis=0)
    np.testing.assert_allclose(found, expected[:8], rtol=0.2)
    assert np.abs(moves[:, 8:12]).max() < 1e-6
