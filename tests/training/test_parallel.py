"""Steps of several draws: in one loop, in threads, and over eight devices."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import plane
import pytest
from jax.sharding import Mesh
from tiny_runs import TINY_SURFELS, write_plane
from tiny_training import RATE, fresh_state, one_color_field, settings

from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.step_data import TrainData
from jaxcloseup.captures.load import load_scene
from jaxcloseup.labels.make import label_sources
from jaxcloseup.photos.views import sample_image, sample_pixels
from jaxcloseup.training.config import TrainConfig
from jaxcloseup.training.parallel import in_a_loop, in_threads, over_devices
from jaxcloseup.training.sampling import draw_keys, sample_closeup
from jaxcloseup.training.state import init_state
from jaxcloseup.training.steps import closeup_step, train_step


DRAWS = 8


@pytest.fixture(scope="module")
def capture():
    return plane.make_views([plane.camera_above(x, 0.0, 4.0) for x in (-0.5, 0.0, 0.5)])


def spread_over(count):
    return over_devices(Mesh(np.array(jax.devices()[:count]), ("draws",)))


WAYS = {
    "loop": (jax.jit, in_a_loop),
    "threads": (lambda step: step, in_threads(3)),
    "turns": (lambda step: step, in_threads(1)),
    "devices": (jax.jit, spread_over(8)),
    "four devices": (jax.jit, spread_over(4)),
}


def bind(step, way, **config):
    compiled, spread = WAYS[way]
    config = TrainConfig(num_windows=DRAWS, **config)
    bound = {"field": one_color_field(), "optimizer": optax.sgd(RATE), "config": config}
    return compiled(functools.partial(step, **bound, spread=spread))


@pytest.mark.parametrize(("count", "way"), [*((64, way) for way in WAYS), (None, "devices")])
def test_a_step_moves_by_the_mean_gradient_of_its_draws(capture, count, way):
    views, _ = capture
    state = fresh_state()
    after, metrics = bind(train_step, way, num_rays=count)(state, views)
    keys, _ = draw_keys(state.key, state.step, DRAWS)
    drawn = [
        sample_image(key, views) if count is None else sample_pixels(key, views, count)
        for key in keys.batch
    ]
    means = np.array([batch.rgb.reshape(-1, 3).mean(axis=0) for batch in drawn], np.float64)
    assert len(np.unique(means[:, 0])) > 2  # draws differ
    color = np.asarray(state.params, np.float64)
    # d/dc mean |c - t|^2 = 2 (c - mean t)
    np.testing.assert_allclose(after.params, color - RATE * 2 * (color - means.mean(0)), atol=1e-6)
    losses = [np.mean(np.sum((np.asarray(b.rgb) - color) ** 2, axis=-1)) for b in drawn]
    np.testing.assert_allclose(metrics["loss"], np.mean(losses), rtol=1e-5)


def test_each_draw_has_a_close_up_of_its_own(capture):
    views, depths = capture
    sources, state = label_sources(views, depths), fresh_state()
    data = views, sources, settings()
    rays = {"num_rays": 64, "num_label_rays": 256}
    results = [bind(closeup_step, way, **rays)(state, *data) for way in ("loop", "devices")]
    for after, metrics in results:
        np.testing.assert_allclose(after.params, results[0][0].params, atol=1e-6)
        np.testing.assert_allclose(metrics["label_coverage"], results[0][1]["label_coverage"])
    keys, _ = draw_keys(state.key, state.step, DRAWS)
    cameras = [sample_closeup(key, sources, settings(), None).camera for key in keys.label]
    assert len({tuple(np.asarray(camera.position).tolist()) for camera in cameras}) == DRAWS


def test_one_draw_takes_the_keys_of_the_step():
    key, step = jax.random.key(3), jnp.int32(7)
    keys, after = draw_keys(key, step, 1)
    batch, render, adapt, label = jax.random.split(jax.random.fold_in(key, step), 4)
    for mine, theirs in zip((*keys, after), (batch, render, label, adapt), strict=True):
        np.testing.assert_array_equal(jax.random.key_data(mine), jax.random.key_data(theirs))


def test_surfels_learn_the_same_on_one_device_and_on_eight(tmp_path, monkeypatch):
    write_plane(tmp_path)
    train = dataclasses.replace(TINY_SURFELS.train, num_windows=DRAWS)
    preset = dataclasses.replace(TINY_SURFELS, train=train)
    scene = load_scene(str(tmp_path))
    points = 2 * jax.random.uniform(jax.random.key(1), (300, 3)) - 1
    points = points.at[:, 2].set(0)
    states = []
    for devices in (8, 1):
        monkeypatch.setattr(jax, "devices", lambda count=devices: jax.local_devices()[:count])
        programs = Programs(preset, scene)
        begin = functools.partial(init_state, field=programs.field, optimizer=programs.optimizer)
        state = begin(jax.random.key(0), points, jnp.full_like(points, 0.5))
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers and floats
            state, metrics = programs.run(state, TrainData(scene.train), count=3)
        assert metrics["skipped"] == 0 and state.step == 3
        states.append(state)
        assert all(len(leaf.devices()) == 1 for leaf in jax.tree.leaves(state.params))
    eight, one = (jax.device_get((state.params, state.opt_state)) for state in states)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), eight, one)


def test_windows_that_would_leave_devices_of_other_hosts_idle_are_refused(tmp_path, monkeypatch):
    write_plane(tmp_path)
    train = dataclasses.replace(TINY_SURFELS.train, num_windows=3)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    with pytest.raises(ValueError, match="--windows=3 leaves devices of some hosts without work"):
        Programs(dataclasses.replace(TINY_SURFELS, train=train), load_scene(str(tmp_path)))
