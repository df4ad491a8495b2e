"""Steps on a part of the surfels against steps on all of them."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest

from jaxcloseup.fields.splats import RasterizeConfig, SurfelConfig, Surfels
from jaxcloseup.fields.splats.config import AdaptiveConfig, McmcConfig
from jaxcloseup.fields.splats.local import chunk_rows
from jaxcloseup.fields.splats.splat_field import surfel_field
from jaxcloseup.fields.splats.splat_optimizer import surfel_optimizer
from jaxcloseup.training.config import TrainConfig
from jaxcloseup.training.state import init_state
from jaxcloseup.training.steps import train_step


CONFIG = SurfelConfig(
    capacity=2**14,
    sh_degree=1,
    sh_every=1,
    regularize_from=0,
    selective_adam=True,
    max_scale=0.2,
    density=McmcConfig(every=4, start=0, stop=100, growth=1.0, noise=0.0),
    raster=RasterizeConfig(capacity=2**16, near=0.1, antialias=True),
)
FIELD = surfel_field(CONFIG, extent=2.0)
OPTIMIZER = surfel_optimizer(CONFIG, extent=2.0)
STEP = functools.partial(
    train_step, field=FIELD, optimizer=OPTIMIZER, config=TrainConfig(num_rays=None)
)


@pytest.fixture(scope="module")
def views():
    """Photographs of a small part of the plane, on which surfels lie far and wide."""
    cameras = [plane.camera_above(x, 0.3, 0.9, tilt=0.2) for x in (-0.5, 0.5)]
    return plane.make_views(cameras)[0]


def wide_state(seed):
    """Surfels all over a wide plane, some of them large, some faint."""
    rng = np.random.default_rng(seed)
    count = CONFIG.capacity - 100
    points = rng.uniform([-12, -12, -0.05], [12, 12, 0.05], (count, 3)).astype(np.float32)
    state = init_state(
        jax.random.key(seed), points, np.full_like(points, 0.5), field=FIELD, optimizer=OPTIMIZER
    )
    scales = rng.uniform(-4.0, -2.0, (CONFIG.capacity, 2))
    logits = rng.uniform(-6.0, 3.0, CONFIG.capacity)
    params = state.params.replace(
        log_scales=jnp.asarray(scales, jnp.float32), opacity_logits=jnp.asarray(logits, jnp.float32)
    )
    return state.replace(params=params)


def copy(tree):
    return jax.tree.map(jnp.copy, tree)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_step_on_a_part_is_a_step_on_everything(views, seed):
    """Also when relocations are due, in the third step."""
    state = FIELD.local.prepare(wide_state(seed).replace(step=jnp.int32(1)))
    whole = FIELD.local.finish(copy(state))
    for _ in range(3):
        before = whole
        whole, expected = STEP(whole, views)
        state, metrics = STEP(state, views, local=True)
        np.testing.assert_allclose(metrics["psnr"], expected["psnr"], rtol=1e-5)
        if state.step == 4:  # relocations were due, and rows are sorted anew after them
            whole = FIELD.local.prepare(whole)
        for name, new in vars(state.params).items():
            old, other = getattr(before.params, name), getattr(whole.params, name)
            np.testing.assert_allclose(new, other, atol=2e-5, err_msg=name)
            still = np.asarray(old) == np.asarray(other)
            if state.step < 4:
                assert still.mean() > 0.5, "a window sees a small part"
                np.testing.assert_array_equal(np.asarray(new)[still], np.asarray(other)[still])
    whole = FIELD.local.finish(whole)
    assert state.step == whole.step == 4
    assert jax.tree.structure(FIELD.local.finish(state)) == jax.tree.structure(whole)


def test_a_part_holds_all_that_a_view_changes(views):
    state = FIELD.local.prepare(wide_state(3))
    camera = jax.tree.map(lambda leaf: leaf[0], views.cameras)
    part, place = FIELD.local.take(state, (camera,))
    assert part.params.means.shape[0] <= CONFIG.capacity / 2

    def light(params):
        return jnp.sum(FIELD.render(params, state.buffers, camera, None, None).rgb)

    changed = np.any(np.asarray(jax.grad(light)(state.params).sh) != 0, axis=(1, 2))
    rows = chunk_rows(CONFIG.capacity)
    taken = np.zeros(CONFIG.capacity // rows + 1, bool)
    taken[np.asarray(place)] = True
    assert changed.any() and taken[np.flatnonzero(changed) // rows].all()


def test_rows_are_sorted_so_that_neighbors_lie_together():
    state = wide_state(4)
    after = FIELD.local.prepare(state)
    assert not np.any(np.diff(np.asarray(after.buffers.alive, int)) > 0), "the dead come last"
    number = int(after.buffers.alive.sum())
    assert number == int(state.buffers.alive.sum())

    def rows(state):
        return np.concatenate(
            [
                np.asarray(leaf).reshape(CONFIG.capacity, -1)
                for leaf in (state.params.means, state.params.sh, state.opt_state[0].mu.means)
            ],
            1,
        )

    np.testing.assert_array_equal(np.unique(rows(after), axis=0), np.unique(rows(state), axis=0))

    def gap(state):
        return np.linalg.norm(np.diff(state.params.means[:number], axis=0), axis=1).mean()

    assert gap(after) < 0.2 * gap(state)


def test_what_changes_everything_has_no_parts():
    def local_of(**changes):
        return surfel_field(dataclasses.replace(CONFIG, **changes), extent=1.0).local

    assert local_of() is not None
    assert local_of(selective_adam=False) is None, "Adam moves all surfels"
    assert local_of(density=McmcConfig()) is None, "noise moves all surfels"
    assert local_of(density=AdaptiveConfig()) is None, "it records all gradients"
    assert local_of(capacity=2039) is None, "a prime number has no chunks"
    assert isinstance(wide_state(0).params, Surfels)
