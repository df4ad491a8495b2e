"""Compiled programs of one field, and stages: steps in chunks, with rates and the time left."""

import functools
import math
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from orbax.checkpoint.multihost import sync_global_processes

from experiments.methods.presets import Preset, make_field, make_optimizer, make_train_config
from experiments.training.logs import TrainLog
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.field import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.union_warp import SourceBlocks
from jaxcloseup.photographs import Views
from jaxcloseup.pseudo import PseudoSettings
from jaxcloseup.scenes import Scene
from jaxcloseup.train import TrainState, labeled_step, pseudo_step, run_steps, train_step


HOSTS_WAIT = 24 * 3600  # seconds
PERSISTENT = 10  # steps on end whose loss is not finite


class TrainingError(Exception):
    """Training cannot go on; the message says why, in one sentence."""


class Programs:
    """What is compiled for one field on one scene.

    A rasterizer has room for a fixed number of (tile, splat) pairs. Where an image needs more it
    is discarded, the room is doubled, everything is compiled anew and the work done again: nothing
    is ever learnt from, or shown of, a truncated image.
    """

    def __init__(self, preset: Preset, scene: Scene) -> None:
        """Compile for a preset's field on a scene."""
        self.preset, self.scene = preset, scene
        self.optimizer: optax.GradientTransformation = make_optimizer(preset, scene)
        self.growth = 1
        self._meetings = 0
        self._compile()

    def _compile(self) -> None:
        self.field = make_field(self.preset, self.scene, growth=self.growth)
        bound = {
            "field": self.field,
            "optimizer": self.optimizer,
            "config": make_train_config(self.preset),
        }

        def label_step(
            state: TrainState,
            views: Views,
            depths: jax.Array,
            settings: PseudoSettings,
            sources: SourceBlocks,
        ) -> Any:
            return pseudo_step(state, views, depths, settings, sources=sources, **bound)

        steps = {
            "photographs": functools.partial(train_step, **bound),
            "virtual": label_step,
            "targets": functools.partial(labeled_step, **bound),
        }
        # The number of steps is traced; the input state is left alone.
        runners = {name: functools.partial(run_steps, step) for name, step in steps.items()}
        # The arms of a sweep share the step, so that what is due at a step is no question of arms,
        # and the views. Each device has arms of its own and nothing to say to the others.
        arms_states = TrainState(step=None, params=0, buffers=0, opt_state=0, key=0)
        arms_step = jax.vmap(
            label_step, in_axes=(arms_states, None, 0, 0, 0), out_axes=(arms_states, 0)
        )
        shared, split = PartitionSpec(), PartitionSpec("arms")
        states = TrainState(step=shared, params=split, buffers=split, opt_state=split, key=split)

        mesh = Mesh(np.array(jax.devices()), ("arms",))
        self._on_devices = jax.tree.map(
            lambda spec: NamedSharding(mesh, spec),
            (states, shared, split),
            is_leaf=lambda leaf: isinstance(leaf, PartitionSpec),
        )

        def run_arms(states_now: TrainState, *data: Any, count: jax.Array | int) -> Any:
            return jax.shard_map(
                lambda *args: run_steps(arms_step, *args[:-1], count=args[-1]),
                mesh=mesh,
                in_specs=(states, shared, split, split, split, shared),
                out_specs=(states, split),
                check_vma=False,
            )(states_now, *data, count)

        self._runners = {name: jax.jit(run) for name, run in (runners | {"arms": run_arms}).items()}
        self._render = jax.jit(
            lambda state, camera, key: self.field.render(
                state.params, state.buffers, camera, None, key
            )
        )

    def make_room(self, growth: int) -> None:
        """Have room for `growth` times as many pairs as the preset has, or more."""
        if growth > self.growth:
            self.growth = growth
            self._compile()

    def _grow(self) -> None:
        self.make_room(2 * self.growth)
        print(f"an image has more (tile, splat) pairs than fit: room for {self.growth} times more")

    def run(
        self, kind: str, state: TrainState, *data: Any, count: int
    ) -> tuple[TrainState, dict[str, Any]]:
        """Take `count` steps on "photographs", and with labels of "virtual" or "targets" views.

        `data` is what `train_step`, `pseudo_step` (with its sources) and `labeled_step` take.
        "arms" are those of a sweep, one on each device or several: all of the state but its step,
        and all data but the views, have a leading axis of arms. Metrics are then means over arms,
        but for `skipped`, how many steps were skipped because loss or gradient was not finite, a
        list of all arms' numbers.
        """
        if kind == "arms":
            if jax.process_count() > 1:
                # One host may be minutes behind, but collectives wait for half a minute only.
                self._meetings += 1
                sync_global_processes(
                    f"arms {self._meetings}",
                    processes=set(range(jax.process_count())),
                    timeout=HOSTS_WAIT,
                )
            # What comes out of a checkpoint lies on one device.
            views, *of_arms = data
            of_states, shared, split = self._on_devices
            state = jax.tree.map(_place, of_states, state)
            data = (_place(shared, views), *(_place(split, one) for one in of_arms))
        while True:
            after, metrics = self._runners[kind](state, *data, count=count)
            if kind == "arms" and jax.process_count() > 1:
                after, metrics = _gather((after, metrics))
            metrics = jax.device_get(metrics)
            # Means of counts: positive if any step had an overflow.
            overflow = [metrics.pop(key, np.zeros(())) for key in ("overflow", "label_overflow")]
            if not any(np.any(values) for values in overflow):
                skipped = np.round(metrics.pop("skipped") * count).astype(int)
                if skipped.any():
                    whose = f", by arm: {skipped.tolist()}" if kind == "arms" else ""
                    print(f"warning: {skipped.max()} of {count} steps skipped, not finite{whose}")
                # The PSNR of no label at all is infinite.
                values = {key: float(np.mean(v)) for key, v in metrics.items()}
                values = {key: v for key, v in values.items() if math.isfinite(v)}
                return after, values | {"skipped": skipped.tolist()}
            self._grow()

    def render(self, state: TrainState, camera: Camera, key: jax.Array | None = None) -> Rendering:
        """Render a whole image; without a key, as ever, deterministically."""
        while True:
            rendering = self._render(state, camera, key)
            surfels = getattr(rendering.aux, "surfels", None)
            if surfels is None or not int(surfels.overflow):
                return rendering
            self._grow()


def _place(sharding: NamedSharding, tree: Any) -> Any:
    """Arrays that every host has whole, each host's part on its devices."""
    if jax.process_count() == 1:
        return jax.device_put(tree, sharding)

    def place(leaf):
        leaf = np.asarray(leaf)
        return jax.make_array_from_callback(leaf.shape, sharding, leaf.__getitem__)

    return _map_keys_as_numbers(place, tree)


def _gather(tree: Any) -> Any:
    """Arrays that are spread over several hosts, whole on each."""

    def gather(leaf):
        return jnp.asarray(multihost_utils.process_allgather(leaf, tiled=True))

    return _map_keys_as_numbers(gather, tree)


def _map_keys_as_numbers(change, tree):
    def one(leaf):
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(change(jax.random.key_data(leaf)))
        return change(leaf)

    return jax.tree.map(one, tree)


def run_stage(
    name: str,
    programs: Programs,
    kind: str,
    state: TrainState,
    *data: Any,
    steps: int,
    checkpoints: Checkpoints,
    save_every: int,
    log: TrainLog | None = None,
) -> tuple[TrainState, list[dict[str, Any]]]:
    """Take `steps` steps, reporting ten times or at least every 500 steps.

    Goes on from the newest checkpoint of the stage, if there is one, with the same next steps.

    Args:
      name: of the stage.
      programs: what is compiled.
      kind: of step, as `Programs.run` knows it.
      state: to begin with.
      *data: as `Programs.run` takes it.
      steps: how many.
      checkpoints: where states are kept.
      save_every: steps after which a state is kept, rounded up to when progress is reported; the
        last one always is.
      log: is told of what is printed.

    Returns:
      The state, and for each chunk its metrics with `step`, counted within the stage.

    Raises:
      TrainingError: `PERSISTENT` steps on end, or all of the stage's, were not finite; what was
        good is kept.
    """
    chunk = max(1, min(-(-steps // 10), 500))
    history: list[dict[str, Any]] = []
    begun = done = 0
    kept = checkpoints.load(name, state)
    if kept is not None:
        begun, state, progress = kept
        done, history = begun, progress["history"]
        programs.make_room(progress["growth"])
        print(f"{name:>9} {done}/{steps}  resumed")
    saved = done
    if log is not None:
        log.begin(name, history)

    def keep():
        progress = {"history": history, "growth": programs.growth}
        checkpoints.save(name, done, state, progress)

    start = time.perf_counter()
    failing, good = 0, (done, state)
    while done < steps:
        count = min(chunk, steps - done)
        state, values = programs.run(kind, state, *data, count=count)
        done += count
        failing = failing + count if values["skipped"] == count else 0
        if failing >= min(PERSISTENT, steps):
            done, state = good
            history = [entry for entry in history if entry["step"] <= done]
            if done > saved:
                keep()
            where = f", whose state is kept in {checkpoints.folder}" if done else ""
            raise TrainingError(
                f"{name} stopped after {done} good steps{where}: loss or gradient was not finite "
                f"in each of the next {failing}: lower the learning rate, or look for broken "
                "photographs or poses"
            )
        if not failing:
            good = done, state
        history.append({"step": done} | values)
        rate = (done - begun) / (time.perf_counter() - start)
        left = (steps - done) / rate
        numbers = {key: value for key, value in values.items() if isinstance(value, float)}
        shown = "  ".join(f"{key} {value:.4g}" for key, value in numbers.items())
        print(
            f"{name:>9} {done:>{len(str(steps))}}/{steps}  {rate:6.1f} steps/s  "
            f"{int(left // 60)}:{int(left % 60):02d} left  {shown}",
            flush=True,
        )
        if log is not None:
            log.write(history[-1])
        if done == steps or (done - saved >= save_every and not failing):
            keep()
            saved = done
    return state, history
