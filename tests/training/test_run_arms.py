"""Arms trained together equal arms trained alone, on one device and on several."""

import functools

import jax
import numpy as np
import optax
import plane
import pytest
from jax.sharding import Mesh
from tiny_training import RATE, fresh_state, one_color_field, settings

import jaxcloseup
from jaxcloseup.labels.make import label_sources
from jaxcloseup.training.arms import arm_state, run_arms, stack_arms, stack_states
from jaxcloseup.training.config import TrainConfig
from jaxcloseup.training.steps import closeup_step, pseudo_step, run_steps


TOLERANCES = 0.0, 0.05, 0.15, 0.5
STATIC = {
    "field": one_color_field(),
    "optimizer": optax.sgd(RATE),
    "config": TrainConfig(num_rays=64, num_label_rays=256),
}


@pytest.fixture(scope="module")
def capture():
    return plane.make_views([plane.camera_above(x, 0.0, 4.0) for x in (-0.5, 0.0, 0.5)])


@pytest.fixture(scope="module")
def alone(capture):
    """The states of arms that train one after the other."""
    views, depths = capture
    sources = label_sources(views, depths)
    step = functools.partial(closeup_step, **STATIC)

    @jax.jit
    def run(state, settings):
        return run_steps(lambda state: step(state, views, sources, settings), state, count=2)

    return [run(fresh_state(), settings(rgb_tolerance=t)) for t in TOLERANCES]


def depths_of_each_arm(views, depths):
    """Sources with an axis of arms, which need not be equal; photographs without."""
    sources = [label_sources(views, depths)] * len(TOLERANCES)
    return stack_arms(sources).replace(views=views)


WAYS = {
    "shared sources": (closeup_step, label_sources, False, {"sequential": True}),
    "depths alone": (pseudo_step, lambda views, depths: depths, False, {}),
    "an arm's own sources, on two devices": (closeup_step, depths_of_each_arm, True, {}),
}


@pytest.mark.parametrize("way", WAYS)
def test_four_tolerances_train_in_one_program(capture, alone, way):
    step, sources_of, sharded, static = WAYS[way]
    mesh = Mesh(np.array(jax.devices()[:2]), ("arms",)) if sharded else None
    run = jax.jit(
        functools.partial(run_arms, functools.partial(step, **STATIC, **static), mesh=mesh)
    )
    states, metrics = run(
        stack_states([fresh_state()] * len(TOLERANCES)),
        capture[0],
        sources_of(*capture),
        stack_arms([settings(rgb_tolerance=t) for t in TOLERANCES]),
        count=2,
    )
    assert int(states.step) == 2 and metrics["loss"].shape == (len(TOLERANCES),)
    for arm, (state, values) in enumerate(alone):
        np.testing.assert_allclose(arm_state(states, arm).params, state.params, rtol=1e-5)
        np.testing.assert_allclose(metrics["loss"][arm], values["loss"], rtol=1e-5)
    coverage = np.asarray(metrics["label_coverage"])
    assert coverage[0] == 0 and np.all(np.diff(coverage) >= 0) and coverage[-1] > 0


def test_the_package_exports_what_a_sweep_needs():
    assert jaxcloseup.run_arms is run_arms and jaxcloseup.stack_states is stack_states
