"""Volumetric Gaussians as a field, with the filters of Mip-Splatting: training and its states."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from splat_scenes import trainer

from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.fields.splats import McmcConfig, RasterizeConfig, sampling_intervals
from jaxcloseup.fields.splats.config import GaussianConfig
from jaxcloseup.fields.splats.splat_field import surfel_field
from jaxcloseup.fields.splats.splat_optimizer import surfel_optimizer
from jaxcloseup.photos.views import camera_at


EVERY, STEPS = 10, 35  # relocations come at 20 and 30
CONFIG = GaussianConfig(
    capacity=340,
    sh_degree=1,
    means_lr=(2e-3, 2e-4),
    sh_lr=2e-2,
    means_lr_steps=2 * STEPS,
    density=McmcConfig(every=EVERY, start=EVERY, stop=STEPS, growth=1.1),
    raster=RasterizeConfig(capacity=2**13, near=0.2, antialias=True, chunk=4, block=12),
)
VIEWS, DEPTHS = plane.make_views(
    [plane.camera_above(x, y, 2.0) for x in (-0.6, 0.6) for y in (-0.4, 0.4)]
)
FIELD = surfel_field(CONFIG, extent=2.0, photographs=VIEWS.cameras)
OPTIMIZER = surfel_optimizer(CONFIG, extent=2.0)
start, run = trainer(FIELD, OPTIMIZER)


@pytest.fixture(scope="module")
def trained():
    """The states before the first step, after `STEPS` and after twice as many, and losses."""
    points = np.random.default_rng(0).uniform([-1.6, -1.4, -0.1], [1.6, 1.4, 0.1], (250, 3))
    begun = start(points)
    _, first = run(begun, VIEWS, 1)
    middle, _ = run(begun, VIEWS, STEPS)
    end, last = run(middle, VIEWS, STEPS)
    return begun, middle, end, (first["loss"], last["loss"])


def test_training_lowers_the_loss(trained):
    begun, _, end, (first, last) = trained
    assert last < 0.5 * first
    assert begun.params.log_scales.shape == (340, 3)
    assert end.buffers.alive.sum() == int(int(250 * 1.1) * 1.1)


def test_a_saved_state_continues_to_the_same_bits(trained, tmp_path):
    begun, middle, end, _ = trained
    Checkpoints(tmp_path, {}).save("baseline", STEPS, middle, {})
    _, kept, _ = Checkpoints(tmp_path, {}).load("baseline", begun)
    again, _ = run(kept, VIEWS, STEPS)
    jax.tree.map(np.testing.assert_array_equal, again.params, end.params)
    jax.tree.map(np.testing.assert_array_equal, again.buffers, end.buffers)


def test_sampling_intervals_follow_relocations(trained):
    """They are renewed when density control is due, and kept between."""
    begun, middle, _, _ = trained
    now = functools.partial(sampling_intervals, cameras=VIEWS.cameras, near=0.2)
    np.testing.assert_allclose(begun.buffers.interval, now(begun.params.means), rtol=1e-6)
    adapt = jax.jit(FIELD.adapt)
    moved = adapt(jax.random.key(1), middle.replace(step=jnp.int32(EVERY * 2)))
    assert np.any(moved.buffers.alive != middle.buffers.alive)
    np.testing.assert_allclose(moved.buffers.interval, now(moved.params.means), rtol=1e-6)
    still = adapt(jax.random.key(1), middle)
    np.testing.assert_array_equal(still.buffers.interval, middle.buffers.interval)


def test_what_volumes_lack_is_none(trained):
    """Normals, and without photographs the intervals of the filter in space."""
    state = trained[0]
    image = jax.eval_shape(
        lambda: FIELD.render(state.params, state.buffers, camera_at(VIEWS.cameras, 0), None, None)
    )
    assert image.normal is None and image.depth.shape == VIEWS.rgb.shape[1:3]
    field = surfel_field(CONFIG, extent=2.0)
    _, buffers = jax.eval_shape(field.init, jax.random.key(0), jnp.eye(3), jnp.eye(3))
    assert len(jax.tree.leaves(buffers)) == len(jax.tree.leaves(state.buffers)) - 1
