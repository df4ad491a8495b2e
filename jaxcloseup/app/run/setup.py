"""Set-up that the stages of a run and the arms of a sweep share: states, labels, checkpoints."""

import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxcloseup
from jaxcloseup.app import progress
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.settings import plain_config
from jaxcloseup.app.run.kept_detail import FindDetail, detailed_views
from jaxcloseup.app.run.logs import TrainLog
from jaxcloseup.app.run.loop import TrainingError, run_stage
from jaxcloseup.app.run.manifest import hash_data, hash_targets
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.fields.splats.surfels import random_points
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.io.memory import give_back_memory, installed_memory
from jaxcloseup.labels.config import LabelConfig, pseudo_settings
from jaxcloseup.labels.make import (
    LabelSources,
    PseudoSettings,
    label_sources,
    sample_virtual_camera,
)
from jaxcloseup.labels.rules import LABEL_RULES, label_depth
from jaxcloseup.labels.target_views import label_views
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views, camera_at
from jaxcloseup.training.steps import TrainState, init_state


FEWEST_POINTS = 100  # a capture with fewer gets random points too
_MOST_CLOSEUPS = 200  # that are labeled before the first step
_CLOSEUPS = 3  # folded into a run's key
_COMPILING = tuple(
    f"/jax/core/compile/{part}_duration" for part in ("jaxpr_to_mlir_module", "backend_compile")
)


class LabelStart(NamedTuple):
    """What fine-tuning on labels begins with.

    Attributes:
      state: that of the baseline, rendering the depth that labels are made from.
      sources: the training photographs with this state's depths.
    """

    state: TrainState
    sources: LabelSources


@dataclasses.dataclass
class Training:
    """Training on one scene with one preset.

    Attributes:
      programs: what is compiled.
      checkpoints: keep the states of every stage.
      log: gets every report; None keeps none.
      save_every: steps between checkpoints.
      seconds: filled with the wall time of each part.
      history: filled with the metrics of each stage.
    """

    programs: Programs
    checkpoints: Checkpoints
    log: TrainLog | None = None
    save_every: int = 1000
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    history: dict[str, list[dict[str, Any]]] = dataclasses.field(default_factory=dict)

    def train(self, stage: str, kind: str, state: TrainState, *data: Any, steps: int) -> TrainState:
        """Run a stage, `steps` steps of a kind that `Programs.run` knows."""
        with timed(self.seconds, stage):
            state, self.history[stage] = run_stage(
                stage,
                self.programs,
                kind,
                state,
                *data,
                steps=steps,
                checkpoints=self.checkpoints,
                save_every=self.save_every,
                log=self.log,
            )
        return state

    def train_baseline(self, stage: str, seed: int) -> TrainState:
        """Stage 1 of a seed: photographs alone."""
        programs, preset = self.programs, self.programs.preset
        if preset.coarse is None:
            start = initial_state(programs, seed)
        else:
            start = self._train_coarse(stage, seed)
        return self.train(
            stage, "photographs", start, programs.photographs, steps=preset.baseline_steps
        )

    def _train_coarse(self, stage: str, seed: int) -> TrainState:
        """The state of `preset.coarse`, with the room and the detail of the preset itself."""
        programs, preset = self.programs, self.programs.preset
        coarse = dataclasses.replace(self, programs=programs.coarse)
        start = initial_state(coarse.programs, seed)
        views, steps = coarse.programs.photographs, preset.coarse.steps
        state = coarse.train(f"coarse_{stage}", "photographs", start, views, steps=steps)
        pyramid, _ = programs.pyramid(preset.windows.finest)

        def render(params, buffers, camera):
            return programs.render(state.replace(params=params, buffers=buffers), camera)

        key_fine, key_refine = jax.random.split(jax.random.fold_in(state.key, state.step))
        with timed(self.seconds, f"refine_{stage}"):
            params, buffers = programs.method.refine(
                *(key_refine, preset.field, state.params, state.buffers),
                *(render, programs.scene, pyramid),
            )
        none = jnp.zeros_like(state.step)
        moments = jax.jit(programs.optimizer.init)(params)
        return TrainState(none, params, buffers, moments, key_fine)


def identity_of(scene: Scene, preset: Preset, names: Mapping[str, str]) -> dict[str, Any]:
    """What tells one training from another, as JSON; runs and sweeps add their own entries."""
    size = scene.train.cameras
    return {
        "scene": scene.name,
        "config": plain_config(preset),
        **names,
        "resolution": [size.width, size.height],
        "version": jaxcloseup.__version__,
        "data_sha256": hash_data(scene),
        "wanted_sha256": hash_targets(scene),
    }


# One program for all seeds; without it, every array program would be compiled apart.
_init_state = jax.jit(init_state, static_argnames=("field", "optimizer"))


def initial_state(programs: Programs, seed: int) -> TrainState:
    """The state before the first step of a seed's baseline.

    Raises:
      TrainingError: it does not fit into memory.
    """
    state_shapes(programs)
    return _initial_state(programs)(*_initial_data(programs, seed))


def state_shapes(programs: Programs) -> TrainState:
    """The structure of a state, with shapes and types in place of arrays.

    Raises:
      TrainingError: such a state does not fit into memory.
    """
    shapes = jax.eval_shape(_initial_state(programs), *_initial_data(programs, seed=0))
    needed = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))
    if needed > (held := installed_memory()):
        raise TrainingError(
            f"what is trained takes {needed / 2**30:.1f} GiB, but this computer has "
            f"{held / 2**30:.1f}: choose fewer surfels or a smaller network with --set"
        )
    return shapes


def _initial_state(programs):
    return functools.partial(_init_state, field=programs.field, optimizer=programs.optimizer)


def _initial_data(programs, seed):
    key_init, _, _ = jax.random.split(jax.random.key(seed), 3)
    points, rgb = initial_points(jax.random.fold_in(key_init, 2), programs.scene)
    return key_init, points, rgb


def initial_points(key: jax.Array, scene: Scene, count: int = 5000) -> tuple[Any, Any]:
    """Points `[P, 3]` and colors to start from: the capture's; if few, random gray ones too."""
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
    first, name = (
        (preset, "capacity") if preset.coarse is None else (preset.coarse, "coarse.capacity")
    )
    most = programs.method.max_points(first.field)
    if most is not None and count > most:
        print(f"training begins with {most} of {count} points: --set {name}=N makes room for more")


def start_labels(
    programs: Programs, state: TrainState, seed: int, *, expected_depth: bool | None = None
) -> LabelStart:
    """The state whose depth labels are made from, and the photographs with its depths.

    Args:
      programs: what is compiled.
      state: the baseline's.
      seed: the run's.
      expected_depth: see `LabelConfig`.
    """
    if expected_depth is not None:
        buffers = programs.method.with_expected_depth(state.buffers, expected_depth)
        state = state.replace(buffers=buffers)
    depths = training_depths(programs, state, seed)
    return LabelStart(state, jax.jit(label_sources)(programs.scene.train, depths))


def training_depths(programs: Programs, state: TrainState, seed: int) -> jax.Array:
    """Depths `[V, H, W]` of the training views as the preset's label rule makes them."""
    scene, rule = programs.scene, LABEL_RULES[programs.preset.train.label_rule]
    key_init, _, _ = jax.random.split(jax.random.key(seed), 3)
    return rendered_depths(
        functools.partial(programs.render, state),
        scene.train.cameras,
        scene,
        near=scene.near,
        key=rule.depth_key(jax.random.fold_in(key_init, 1)),
        depth=rule.depth,
    )


def rendered_depths(
    render: Callable[..., Rendering],
    cameras: Camera,
    scene: Scene,
    *,
    near: float = 0.0,
    key: jax.Array | None = None,
    depth: Callable[..., jax.Array] = label_depth,
) -> jax.Array:
    """`render_depths` of stacked cameras, by a `render` that makes room where images need it.

    `near` is 0 by default: close-ups may be nearer to the surface than any photograph.
    """
    count = cameras.intrinsics.shape[0]
    keys = [None] * count if key is None else jax.random.split(key, count)

    def depth_of(view):
        return depth(render(camera_at(cameras, view), keys[view]), near=near, far=scene.far)

    return jnp.stack(list(progress.each(depth_of, range(count), "rendering depths")))


def label_targets(
    programs: Programs,
    start: LabelStart,
    cameras: Camera,
    labels: LabelConfig,
    settings: PseudoSettings,
    find: FindDetail,
) -> Views:
    """Labels of target views.

    Args:
      programs: the run's.
      start: what fine-tuning begins with.
      cameras: stacked `[Q]`.
      labels: says what labels are.
      settings: of warps, after the gate.
      find: finds the detail of the state that fine-tuning begins with, if labels need it.
    """
    if labels.label == "residual":
        detail, _ = find()
        return detailed_views(programs, start.state, detail, cameras)
    render = functools.partial(programs.render, start.state)
    depths = rendered_depths(render, cameras, programs.scene)
    return jax.jit(label_views)(cameras, depths, start.sources, settings)


def label_closeups(
    programs: Programs,
    start: LabelStart,
    labels: LabelConfig,
    seed: int,
    find: FindDetail,
) -> Views:
    """Labels of random close-ups with detail, made before the first step: each costs a render.

    Args:
      programs: the run's.
      start: what fine-tuning begins with.
      labels: says how close-ups are drawn.
      seed: the run's.
      find: as in `label_targets`.
    """
    settings = pseudo_settings(labels)
    count = min(programs.preset.closeup_steps, _MOST_CLOSEUPS)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), _CLOSEUPS), count)
    draw = jax.vmap(lambda key: sample_virtual_camera(key, start.sources, settings)[0])
    return label_targets(programs, start, jax.jit(draw)(keys), labels, settings, find)


@contextlib.contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Record under `name` how long the body takes, which is a part of the run."""
    start = time.perf_counter()
    with progress.part(name):
        yield
    seconds[name] = time.perf_counter() - start
    give_back_memory()


@contextlib.contextmanager
def timed_compiling(seconds: dict[str, float]) -> Iterator[None]:
    """Record under "compile" how much of the body's time, in whatever thread, goes to XLA."""
    seconds["compile"] = 0.0

    def add(event, duration, **_):
        if event in _COMPILING:
            seconds["compile"] += duration

    jax.monitoring.register_event_duration_secs_listener(add)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(add)
