"""The states that training begins with: initial points, a coarse model, the baseline."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.run.keys import RunKeys, run_keys
from jaxcloseup.app.run.loop import Training, TrainingError, train_stage
from jaxcloseup.app.run.photograph_sizes import finest_read
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.step_data import TrainData
from jaxcloseup.app.run.stereo_depths import StereoDepths, draw_points
from jaxcloseup.app.run.timers import timed
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.fields.splats.surfels import random_points
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.io.memory import installed_memory
from jaxcloseup.photos.depth_maps import GatherSources
from jaxcloseup.photos.pyramids import photograph_pyramid
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views
from jaxcloseup.photos.windows import Windows, photograph_windows
from jaxcloseup.training.state import TrainState, init_state


FEWEST_POINTS = 100  # a capture with fewer gets random points too
COARSE = "coarse_"  # and a stage: the name of the one that trains the coarse model before it

# One program for all seeds; without it, every array program would be compiled apart.
_init_state = jax.jit(init_state, static_argnames=("field", "optimizer"))


def train_baseline(
    training: Training, stage: str, keys: RunKeys, coarse: TrainState | None = None
) -> TrainState:
    """Train stage 1 on photographs alone, from `coarse` or from what it trains before."""
    programs, preset = training.programs, training.programs.preset
    stereo = match(training)
    if stereo is None and programs.field.depth_loss is not None:
        print("depth is learned from colors alone: no photographs are matched for depth_weight")
    if preset.coarse is None:
        start = initial_state(programs, keys, stereo)
    else:
        coarse = train_coarse(training, stage, keys) if coarse is None else coarse
        with timed(training.seconds, f"refine_{stage}"):
            start = refine_state(programs, coarse, None if stereo is None else stereo.sources)
    data = TrainData(with_depths(programs, stereo))
    return train_stage(training, stage, start, data, steps=preset.baseline_steps)


def train_coarse(training: Training, stage: str, keys: RunKeys) -> TrainState:
    """Train `preset.coarse`, from which `stage` begins."""
    programs, preset, stereo = training.programs, training.programs.preset, match(training)
    assert preset.coarse is not None
    coarse = dataclasses.replace(training, programs=programs.coarse)
    return train_stage(
        coarse,
        f"{COARSE}{stage}",
        initial_state(coarse.programs, keys, stereo),
        TrainData(with_depths(coarse.programs, stereo)),
        steps=preset.coarse.steps,
    )


def match(training: Training) -> StereoDepths | None:
    """Return depth by stereo, if the preset begins with it; the first call is a part of the run."""
    stereo = training.programs.preset.stereo
    if stereo is None or not stereo.pixels:
        return None
    if "stereo" in training.seconds:
        return training.programs.stereo
    with timed(training.seconds, "stereo"):
        return training.programs.stereo


def with_depths(programs: Programs, stereo: StereoDepths | None) -> Views | Windows:
    """Return the programs' photographs, with stereo's depths if the field learns from them."""
    photographs = programs.photographs
    if stereo is None or programs.field.depth_loss is None:
        return photographs
    if isinstance(photographs, Views):
        pyramid = programs.at_middle(photograph_pyramid(programs.scene.train))
        photographs = photograph_windows(photographs.cameras, pyramid, whole_share=1.0)
    return dataclasses.replace(photographs, depths=stereo.sources)


def refine_state(
    programs: Programs, state: TrainState, depths: GatherSources | None = None
) -> TrainState:
    """Return the state of a coarse model with the room and the detail of the preset itself.

    What is added lies at measured `depths` where there are any.
    """
    preset = programs.preset
    assert programs.method.refine is not None
    pyramid, _ = programs.pyramid(finest_read(preset, programs.scene))

    def render(params: Any, buffers: Any, camera: Camera) -> Rendering:
        return programs.render(state.replace(params=params, buffers=buffers), camera)

    key_fine, key_refine = jax.random.split(jax.random.fold_in(state.key, state.step))
    old = state.params, state.buffers
    params, buffers = programs.method.refine(
        key_refine, preset.field, *old, render, programs.scene, pyramid, depths
    )
    moments = jax.jit(programs.optimizer.init)(params)
    return TrainState(jnp.zeros_like(state.step), params, buffers, moments, key_fine)


def initial_state(
    programs: Programs, keys: RunKeys, stereo: StereoDepths | None = None
) -> TrainState:
    """Return the state before the first step of a baseline, with points that stereo found.

    Raises:
      TrainingError: it does not fit into memory.
    """
    state_shapes(programs)
    points, rgb = initial_points(keys.points, programs.scene)
    if stereo is not None and programs.preset.stereo is not None:
        found = draw_points(stereo, programs.preset.stereo.points)
        points, rgb = (np.concatenate(both) for both in zip((points, rgb), found, strict=True))
    return _initialize(programs)(keys.init, points, rgb)


def state_shapes(programs: Programs) -> TrainState:
    """Return the structure of a state, with shapes and types in place of arrays.

    Raises:
      TrainingError: such a state does not fit into memory.
    """
    keys = run_keys(0)
    points, rgb = initial_points(keys.points, programs.scene)
    shapes = jax.eval_shape(_initialize(programs), keys.init, points, rgb)
    needed = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))
    if needed > (held := installed_memory()):
        raise TrainingError(
            f"what is trained takes {needed / 2**30:.1f} GiB, but this computer has "
            f"{held / 2**30:.1f}: choose fewer surfels or a smaller network with --set"
        )
    return shapes


def _initialize(programs: Programs) -> functools.partial[TrainState]:
    return functools.partial(_init_state, field=programs.field, optimizer=programs.optimizer)


def initial_points(key: jax.Array, scene: Scene, count: int = 5000) -> tuple[Any, Any]:
    """Return points `[P, 3]` and colors to start from.

    They are the capture's; if it has few, random gray ones are added.
    """
    if len(scene.points) >= FEWEST_POINTS:
        return scene.points, scene.rgb
    points = random_points(key, scene.train.cameras, near=scene.near, far=scene.far, count=count)
    gray = jnp.full_like(points, 0.5)
    if not len(scene.points):
        return points, gray
    return np.concatenate([scene.points, points]), np.concatenate([scene.rgb, gray])


def say_which_points_fit(programs: Programs) -> None:
    """Print how many of the initial points a field begins with, if not with all."""
    preset, count = programs.preset, len(programs.scene.points)
    first = preset.field if preset.coarse is None else programs.coarse.preset.field
    most = programs.method.max_points(first)
    if most is not None and count > most:
        alike = most == programs.method.max_points(preset.field)
        name = "capacity" if alike else "coarse.capacity"
        print(f"training begins with {most} of {count} points: --set {name}=N makes room for more")
