"""Every volumetric method against its oracle, and as experiments train it."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import plane
import pytest
import reference_volume as reference
from reference import nerf_network
from tiny_runs import TINY
from tiny_training import assert_same_step

from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import plain_config
from jaxcloseup.app.run.keys import run_keys
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.states import initial_state
from jaxcloseup.app.run.step_data import TrainData
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.captures.load import load_scene
from jaxcloseup.fields.volume import intervals
from jaxcloseup.fields.volume.config import (
    HashGridConfig,
    MipNerfConfig,
    NgpConfig,
    TensorfConfig,
    ZipNerfConfig,
)
from jaxcloseup.fields.volume.mipnerf import mipnerf_field
from jaxcloseup.fields.volume.ngp import ngp_field
from jaxcloseup.fields.volume.rays import Extent
from jaxcloseup.fields.volume.tensorf import TensorfBuffers, factor_products, tensorf_field
from jaxcloseup.fields.volume.zipnerf import zipnerf_field
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.training.parallel import in_a_loop
from jaxcloseup.training.state import DrawLoss, TrainState, init_state, update_state
from jaxcloseup.training.steps import train_step


GRID = HashGridConfig(levels=3, features=2, log2_entries=8, coarsest=4, finest=16)
NGP = NgpConfig(
    grid=GRID,
    proposal=dataclasses.replace(GRID, levels=2),
    width=8,
    proposal_width=4,
    color_layers=1,
    direction_octaves=1,
    num_coarse=6,
    num_middle=5,
    num_fine=4,
    spacing=-1.0,
    contracted=True,
    distortion_weight=0.1,
)
MIP = MipNerfConfig(
    depth=2,
    width=12,
    skip_after=0,
    position_octaves=3,
    direction_octaves=1,
    direction_width=6,
    num_coarse=6,
    num_fine=5,
)
ZIP = ZipNerfConfig(
    grid=GRID,
    proposal=dataclasses.replace(GRID, levels=2),
    width=8,
    color_layers=1,
    direction_octaves=1,
    num_coarse=6,
    num_middle=0,
    num_fine=4,
    proposal_points=3,
)
TENSORF = TensorfConfig(
    coarsest=3,
    finest=6,
    growths=2,
    grow_every=2,
    density_components=2,
    color_components=2,
    appearance=3,
    width=6,
    octaves=1,
    density_shift=-1.0,
    density_scale=2.0,
    sparsity_weight=0.1,
    smoothness_weight=0.2,
    num_coarse=6,
    num_fine=5,
)
VERTICES = 4  # after one growth
CENTER, SCALE, NEAR, FAR = (0.2, -0.1, 0.3), 0.6, 0.5, 4.0
# Each method: its configuration, what makes its field, and its oracle's rounds and spacing.
FIELDS = {
    "ngp": (NGP, ngp_field, reference.ngp),
    "mipnerf": (MIP, mipnerf_field, functools.partial(reference.mipnerf, network=nerf_network)),
    "zipnerf": (ZIP, zipnerf_field, reference.zipnerf),
    "tensorf": (TENSORF, tensorf_field, functools.partial(reference.tensorf, vertices=VERTICES)),
}
TRAINED = [*FIELDS, "dsnerf"]


def ngp_penalty(config, params, histograms):
    *proposals, last = histograms
    total = sum(reference.proposal_penalty(*last, *proposed) for proposed in proposals)
    return total + config.distortion_weight * reference.distortion(*last)


def zip_penalty(config, params, histograms):
    *proposals, last = histograms
    total = config.distortion_weight * reference.distortion(*last)
    for proposed, pulse in zip(proposals, (0.003,), strict=True):
        total += config.proposal_weight * reference.blurred_penalty(*last, *proposed, pulse)
    decay = 0
    for part, grid in (
        (params["fine"], config.grid),
        *((part, config.proposal) for part in params["proposal"]),
    ):
        start = 0
        for level in range(grid.levels):
            side = reference.resolution(level, grid.levels, grid.coarsest, grid.finest) + 1
            entries = min(side**3, 2**grid.log2_entries)
            decay += np.mean(part["grid"][start : start + entries] ** 2)
            start += entries
    return total + config.decay_weight * decay


def tensorf_penalty(config, params, histograms):
    total = 0
    for name in ("density", "color"):
        planes = params[name]["planes"][:, :VERTICES, :VERTICES]
        steps = [np.mean(np.diff(planes, axis=axis) ** 2) for axis in (1, 2)]
        total += config.smoothness_weight * sum(steps)
    lines, planes = params["density"]["lines"], params["density"]["planes"]
    size = np.abs(lines[:, :VERTICES]).mean() + np.abs(planes[:, :VERTICES, :VERTICES]).mean()
    return total + config.sparsity_weight * size


# What the loss adds for a ray, from its histograms.
PENALTIES = {
    "ngp": ngp_penalty,
    "mipnerf": lambda *_: None,
    "zipnerf": zip_penalty,
    "tensorf": tensorf_penalty,
}
BUFFERS = {"tensorf": TensorfBuffers(np.int32(VERTICES))}
PIXELS = np.array([[2.5, 3.5], [6.5, 1.5], [4.0, 4.25]])


def zeros_like(tree):
    return jax.tree.map(jnp.zeros_like, tree)


def camera():
    """One that looks along z from (0.3, 0, -2), with pixels that are not square."""
    pose = np.array([[1.0, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, -2]])
    return Camera(jnp.asarray(pose), jnp.array([8.0, 9, 4, 4.5]), 8, 8)


@functools.cache
def field(name):
    config, make, _ = FIELDS[name]
    return make(config, Extent(NEAR, FAR, CENTER, SCALE))


@functools.cache
def params(name):
    """Float64 parameters whose scene is not empty; drawn by NumPy, which compiles nothing."""
    shapes, _ = jax.eval_shape(field(name).init, jax.random.key(0), *[jnp.zeros((1, 3))] * 2)
    numbers = np.random.default_rng(1)
    return jax.tree.map(lambda x: 0.5 * numbers.normal(size=x.shape), shapes)


@pytest.mark.parametrize("name", FIELDS)
def test_a_rendering_matches_the_oracle(name):
    config, _, oracle = FIELDS[name]
    with jax.enable_x64(True):
        seen = jax.jit(field(name).render)(
            params(name), BUFFERS.get(name, ()), camera(), jnp.asarray(PIXELS), None
        )
    rounds = oracle(config, params(name), np.array(CENTER), SCALE, 1 / np.sqrt(8 * 9))
    blur = reference.widen if name == "mipnerf" else lambda weights: weights
    for i, pixel in enumerate(PIXELS):
        rgb, depth, alpha, histograms = reference.march(
            camera(), pixel, NEAR, FAR, rounds, spacing=config.spacing, scale=SCALE, blur=blur
        )
        assert alpha > 0.1
        np.testing.assert_allclose(seen.rgb[i], rgb, atol=1e-5)
        np.testing.assert_allclose(seen.depth[i], depth, atol=1e-5)
        np.testing.assert_allclose(seen.alpha[i], alpha, atol=1e-5)
        penalty = PENALTIES[name](config, params(name), histograms)
        if penalty is None:
            assert seen.aux.penalty is None
        else:
            np.testing.assert_allclose(seen.aux.penalty[i], penalty, rtol=1e-4)


@pytest.mark.parametrize("name", FIELDS)
def test_gradients_are_finite_differences(name, monkeypatch):
    """With intervals that stay, because no gradient flows through where rays are cut."""

    def even(key, edges, weights, count):
        return intervals.interval_quantiles(key, count, weights.shape[:-1])

    monkeypatch.setattr(intervals, "resample", even)
    numbers = np.random.default_rng(3)
    along = jax.tree.map(lambda x: numbers.normal(size=x.shape), params(name))
    with jax.enable_x64(True):
        weight, target = jnp.array([1.0, 0.5, 0.0]), jnp.full((3, 3), 0.3)

        def losses(steps):
            moved = {
                key: jax.tree.map(lambda p, d, h=step: p + h * d, params(name)[key], along[key])
                for key, step in steps.items()
            }
            seen = field(name).render(
                moved, BUFFERS.get(name, ()), camera(), jnp.asarray(PIXELS), None
            )
            plain = seen._replace(aux=seen.aux._replace(penalty=None))
            penalty = seen.aux.penalty
            penalty = jnp.zeros(()) if penalty is None else jnp.sum(penalty)
            return jnp.stack([field(name).loss(plain, target, weight)[0], penalty])

        @jax.jit
        @functools.partial(jax.value_and_grad, has_aux=True)
        def share(steps, which):
            return jnp.sum(which * losses(steps)), losses(steps)

        zero = dict.fromkeys(along, 0.0)
        slopes = [share(zero, which)[1] for which in np.eye(2)]
        for key in zero:
            up, down = (share(zero | {key: h}, np.zeros(2))[0][1] for h in (1e-6, -1e-6))
            expected = (up - down) / 2e-6
            # What teaches a proposal does not learn from it.
            learns = 1 if key == "fine" and "proposal" in zero else 2
            ours = [slope[key] for slope in slopes]
            np.testing.assert_allclose(ours[:learns], expected[:learns], rtol=1e-4, atol=1e-8)
            assert np.any(np.abs(expected[:learns]) > 1e-4)


def tiny_preset(name):
    """The quick preset, as small as its oracle's, on whole photographs of the plane."""
    quick = METHODS[name].presets["quick"]
    if name == "dsnerf":
        field = dataclasses.replace(TINY.field, depth_weight=quick.field.depth_weight)
        return dataclasses.replace(TINY, method=name, field=field)
    small = {k: v for k, v in vars(FIELDS[name][0]).items() if k not in ("chunk", "spacing")}
    field = dataclasses.replace(quick.field, **small, target_steps=2)
    return dataclasses.replace(TINY, method=name, field=field)


@functools.cache
def trained(name, capture_folder):
    """Programs of a tiny preset, and the state after three steps."""
    numbers = np.random.default_rng(0)
    points = np.float32(np.column_stack([numbers.uniform(-0.5, 0.5, (200, 2)), np.zeros(200)]))
    rgb = np.float32(plane.texture(points))
    scene = load_scene(str(capture_folder))
    points = np.float32(scene.placement.to_scene(points))
    scene = dataclasses.replace(scene, points=points, rgb=rgb)
    programs = Programs(tiny_preset(name), scene)
    state = initial_state(programs, run_keys(0))
    return programs, programs.run(state, TrainData(scene.train), count=3)[0]


@pytest.mark.parametrize("name", TRAINED)
def test_a_step_lowers_the_loss_of_what_it_saw(name, capture_folder):
    with jax.numpy_dtype_promotion("standard"):
        programs, state = trained(name, capture_folder)
        views = programs.scene.train
        after, before = programs.run(state, TrainData(views), count=1)
        _, again = programs.run(after.replace(step=state.step), TrainData(views), count=1)
    assert again["loss"] < before["loss"]


@pytest.mark.parametrize("name", TRAINED)
def test_a_resumed_training_is_the_same_to_the_last_bit(name, capture_folder, tmp_path):
    with jax.numpy_dtype_promotion("standard"):
        programs, state = trained(name, capture_folder)
        views = programs.scene.train
        whole, _ = programs.run(state, TrainData(views), count=4)
        half, _ = programs.run(state, TrainData(views), count=2)
        kept = Checkpoints(tmp_path, {"config": plain_config(programs.preset)})
        kept.save("baseline", 2, half, {"history": [], "growth": 1})
        _, half, _ = kept.load("baseline", state)
        ended, _ = programs.run(half, TrainData(views), count=2)
    jax.tree.map(np.testing.assert_array_equal, ended.params, whole.params)
    jax.tree.map(np.testing.assert_array_equal, ended.opt_state, whole.opt_state)


@pytest.mark.parametrize("name", TRAINED)
def test_a_batch_of_steps_is_these_steps_alone(name, capture_folder):
    """The arms of a sweep are such a batch; `test_sweep` has all that fields do not see of it."""
    with jax.numpy_dtype_promotion("standard"):
        programs, state = trained(name, capture_folder)
        views = programs.scene.train
        other, _ = programs.run(state, TrainData(views), count=1)
        other = other.replace(step=state.step)
        states = jax.tree.map(lambda *x: jnp.stack(x), state, other).replace(step=state.step)
        axes = TrainState(step=None, params=0, buffers=0, opt_state=0, key=0)
        bound = {"field": programs.field, "optimizer": programs.optimizer}
        step = functools.partial(train_step, **bound, config=programs.preset.train)
        batch = jax.jit(jax.vmap(step, in_axes=(axes, None), out_axes=(axes, 0)))
        together, metrics = batch(states, views)
        alone, _ = programs.run(other, TrainData(views), count=1)
    assert not np.any(metrics["skipped"])
    arm = jax.tree.map(lambda leaf: leaf[1], together.replace(step=alone.step[None]))
    assert_same_step(arm, alone, other)


def test_a_grid_that_grows_shows_the_same_scene():
    """From 3 to 5 vertices: the old ones stay, and what lies between them is on their lines."""
    config = dataclasses.replace(TENSORF, finest=5, growths=1, grow_every=4)
    grown = tensorf_field(config, Extent(NEAR, FAR))
    with jax.enable_x64(True):
        shapes, _ = jax.eval_shape(grown.init, jax.random.key(0), *[jnp.zeros((1, 3))] * 2)
        numbers = np.random.default_rng(5)
        params = jax.tree.map(lambda x: numbers.normal(size=x.shape), shapes)
        memory = optax.adam(optax.constant_schedule(0.1)).init(params)
        memory = jax.tree.map(np.ones_like, memory)
        x = numbers.uniform(-1, 1, (3, 20))

        @jax.jit
        def products(step):
            state = TrainState(step, params, TensorfBuffers(np.int32(3)), memory, None)
            after = grown.adapt(None, state)
            seen = [
                factor_products(s.params["color"], s.buffers.vertices, x) for s in (state, after)
            ]
            return after, *seen

        for step in (3, 4):
            after, before, now = products(np.int32(step))
            np.testing.assert_allclose(now, before, atol=1e-12)
            assert after.buffers.vertices == (5 if step == 4 else 3)
            adam, decay = after.opt_state
            chex.assert_trees_all_equal(adam, memory[0] if step == 3 else zeros_like(memory[0]))
            assert decay.count == 1


def test_a_skipped_step_delays_a_growth_and_changes_nothing_else():
    """Grids grow at steps 2 and 4; gradients are 0, so that growths alone change parameters."""
    grows, optimizer = field("tensorf"), optax.adam(0.1)
    draws = DrawLoss(
        draw=lambda keys, loss: loss,
        gradient=lambda params, buffers, loss: ((loss, {}), zeros_like(params)),
        cameras=lambda drawn: (),
    )
    bound = {"field": grows, "optimizer": optimizer, "draws": 1, "spread": in_a_loop}
    step = jax.jit(lambda state, loss: update_state(state, draws, loss, **bound)[0])
    points = jnp.zeros((1, 3))
    start = init_state(jax.random.key(0), points, points, field=grows, optimizer=optimizer)

    def train(*losses):
        state, vertices = start, []
        for loss in losses:
            state = step(state, jnp.float32(loss))
            vertices.append(int(state.buffers.vertices))
        return state, vertices

    with jax.numpy_dtype_promotion("standard"):
        whole, prompt = train(0, 0, 0, 0, 0)
        late, delayed = train(0, np.nan, 0, np.nan, 0)
    assert prompt == [3, 4, 4, 6, 6] and delayed == [3, 3, 4, 4, 6]
    chex.assert_trees_all_equal(late.params, whole.params)
