"""Compiled programs of one preset on one scene: kinds of steps, and rendering."""

import contextlib
import dataclasses
import functools
import math
import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from orbax.checkpoint.multihost import sync_global_processes

from jaxcloseup.app import progress
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.labels.make import LabelSources, PseudoSettings
from jaxcloseup.photos.pyramids import Pyramid, scene_pyramid
from jaxcloseup.photos.scene import Scene, SceneError
from jaxcloseup.photos.views import Views
from jaxcloseup.photos.windows import Windows, in_quarters, photograph_windows
from jaxcloseup.training.sampling import in_a_loop, in_threads, over_devices
from jaxcloseup.training.steps import TrainState, closeup_step, labeled_step, run_steps, train_step


HOSTS_WAIT = 24 * 3600  # seconds
# Images 2^2 times as wide as training's are rendered in quarters on a CPU: that is as fast, and
# needs no program of their own. Wider ones are faster whole.
_QUARTERED = 2


class Programs:
    """What is compiled for one preset on one scene.

    A field may have room for a fixed amount of work. Where an image needs more, `Programs` discards
    it, doubles the room, compiles everything anew and does the work again: no step learns from a
    truncated image, and no render shows one.
    """

    def __init__(self, preset: Preset, scene: Scene, *, width: int | None = None) -> None:
        """Compile for a preset on a scene, for images as large as its photographs or `width`."""
        self.preset, self.scene, self.method = preset, scene, METHODS[preset.method]
        self.optimizer = self.method.make_optimizer(preset.field, scene)
        self.growth = 1
        self._growing = threading.Lock()
        self._meetings = 0
        self._width = width or scene.train.cameras.width
        self._larger: dict[int, Programs] = {}
        self._pyramids: dict[int, tuple[Pyramid, int]] = {}
        self._compile()

    def _compile(self) -> None:
        self._compiled: set[str] = set()
        self.field = self.method.make_field(self.preset.field, self.scene, self.growth)
        bound = {"field": self.field, "optimizer": self.optimizer, "config": self.preset.train}
        steps = {
            "photographs": functools.partial(train_step, **bound),
            "random_closeups": functools.partial(closeup_step, **bound),
            "target_views": functools.partial(labeled_step, **bound),
        }
        self._mesh = _mesh_of_windows(self.preset.train.num_windows)
        spread = in_a_loop if self._mesh is None else over_devices(self._mesh)
        in_parts = not self.method.renders_pixels and self._mesh is None
        # The number of steps is traced; the input state is left alone.
        self._runners = {
            kind: functools.partial(_take_steps, step)
            if in_parts
            else jax.jit(functools.partial(run_steps, functools.partial(step, spread=spread)))
            for kind, step in steps.items()
        }
        self._runners["arms"] = jax.jit(self._run_arms(steps["random_closeups"]))
        # What renders whole images is compiled by itself, and steps share it.
        render = self._render_whole
        self._render = jax.jit(render) if self.method.renders_pixels else render

    def _render_whole(self, state: TrainState, camera: Camera, key: jax.Array | None) -> Rendering:
        return self.field.render(state.params, state.buffers, camera, None, key)

    def _run_arms(self, step: Callable[..., Any]) -> Callable[..., Any]:
        """Steps of all arms of a sweep together, spread over the devices.

        Arms share the photographs and the count of steps, so all of them change what is due at a
        step together. Each device has its own arms and exchanges nothing with the others.
        """
        arms_states = TrainState(step=None, params=0, buffers=0, opt_state=0, key=0)
        arms_sources = LabelSources(views=None, depths=0, blocks=0)
        arms_step = jax.vmap(
            step, in_axes=(arms_states, None, arms_sources, 0), out_axes=(arms_states, 0)
        )
        shared, split = PartitionSpec(), PartitionSpec("arms")
        states = TrainState(step=shared, params=split, buffers=split, opt_state=split, key=split)
        sources = LabelSources(views=shared, depths=split, blocks=split)
        mesh = Mesh(np.array(jax.devices()), ("arms",))
        self._on_devices = jax.tree.map(
            lambda spec: NamedSharding(mesh, spec),
            (states, shared, sources, split),
            is_leaf=lambda leaf: isinstance(leaf, PartitionSpec),
        )

        def run_arms(
            states_now: TrainState,
            views: Views | Windows,
            sources_now: LabelSources,
            settings: PseudoSettings,
            count: jax.Array | int,
        ) -> Any:
            return jax.shard_map(
                lambda *data: run_steps(arms_step, *data[:-1], count=data[-1]),
                mesh=mesh,
                in_specs=(states, shared, sources, split, shared),
                out_specs=(states, split),
                check_vma=False,
            )(states_now, views, sources_now, settings, count)

        return run_arms

    def pyramid(self, finest: int = 1) -> tuple[Pyramid, int]:
        """The training photographs from the finest size that fits, and its divisor; made once.

        Args:
          finest: smallest divisor of their own size.
        """
        if finest not in self._pyramids:
            scene = self.scene
            with progress.saying("reading photographs at their own size, or drawing them"):
                try:
                    found = scene_pyramid(scene, finest=finest)
                except SceneError as error:  # such as full-size photographs that were not kept
                    print(f"only the photographs reduced for training are read: {error}")
                    found = scene_pyramid(dataclasses.replace(scene, photographs_at=None))
            self._pyramids[finest] = found
        return self._pyramids[finest]

    @functools.cached_property
    def coarse(self) -> "Programs":
        """What trains the preset's coarse model; all seeds share it."""
        field = self.preset.coarse.field
        preset = dataclasses.replace(self.preset, field=field, coarse=None, windows=None)
        return Programs(preset, self.scene)

    @functools.cached_property
    def photographs(self) -> Views | Windows:
        """What steps learn from: reduced photographs, or windows or pixels of finer ones."""
        views, windows = self.scene.train, self.preset.windows
        if windows is None or windows.finest >= self.preset.downscale:
            return views
        pyramid, divisor = self.pyramid(windows.finest)
        if len(pyramid.sizes) == 1:
            return views
        parts = "pixels" if self.method.renders_pixels else "windows"
        print(f"learning from {parts} of {describe_photographs(pyramid, divisor)}")
        return photograph_windows(views.cameras, pyramid, whole_share=windows.whole_share)

    def make_room(self, growth: int) -> None:
        """Grow the room to at least `growth` times the preset's."""
        if growth > self.growth:
            self.growth = growth
            self._compile()

    def _for_doublings(self, doublings: int) -> "Programs":
        """Larger images have programs of their own: their room must not slow training."""
        if doublings <= 0:
            return self
        if doublings not in self._larger:
            large = Programs(self.preset, self.scene, width=self._width * 2**doublings)
            large.make_room(self.growth * 4**doublings // 2)
            self._larger[doublings] = large
        return self._larger[doublings]

    def _grow(self, too_small: int) -> None:
        """Double the room, unless another thread found it too small too and already did."""
        with self._growing:
            if self.growth > too_small:
                return
            self.make_room(2 * self.growth)
        print(
            f"an image needs more room than there is: growing to {self.growth} times the preset's"
        )

    def run(
        self, kind: str, state: TrainState, *data: Any, count: int
    ) -> tuple[TrainState, dict[str, Any]]:
        """Take `count` steps of a kind.

        Args:
          kind: "photographs" (`train_step`), "random_closeups" (`closeup_step`), "target_views"
            (`labeled_step`), or "arms": random close-ups of all arms of a sweep, one on each device
            or several. Then the state, but for its step, and all data, but for the photographs,
            have a leading axis of arms.
          state: what is trained.
          *data: what the step takes after its state.
          count: how many steps.

        Returns:
          The next state and the means of the steps' metrics, over arms too; `skipped` counts the
          steps that were skipped because loss or gradient was not finite (of "arms" a list of
          counts). A mean that is not finite, such as the PSNR without any label, is left out.
        """
        arrays = self._share_out(kind, (state, *data))
        while True:
            growth = self.growth
            with self._compiling(kind, "compiling the steps"):
                after, metrics = self._collect(kind, self._runners[kind](*arrays, count=count))
                metrics = jax.device_get(metrics)
            # Means of counts: positive if any step had an overflow.
            overflow = [metrics.pop(key, np.zeros(())) for key in ("overflow", "label_overflow")]
            if not any(np.any(values) for values in overflow):
                return after, _checked(metrics, kind, count)
            self._grow(growth)

    def _compiling(self, kind: str, what: str) -> contextlib.AbstractContextManager[None]:
        """Says that a kind of step, or rendering, is compiled, when it is called first."""
        if kind in self._compiled:
            return contextlib.nullcontext()
        self._compiled.add(kind)
        return progress.saying(what)

    def _share_out(self, kind: str, arrays: tuple[Any, ...]) -> tuple[Any, ...]:
        """State and data of a step on the devices that take it."""
        # What comes out of a checkpoint lies on one device.
        if kind == "arms":
            self._meet()
            return jax.tree.map(_place, self._on_devices, arrays)
        if self._mesh is None:
            return arrays
        self._meet()
        return _place(NamedSharding(self._mesh, PartitionSpec()), arrays)

    def _collect(self, kind: str, result: Any) -> Any:
        """What steps on several devices gave, whole on this host."""
        if kind == "arms":
            return _gather(result) if jax.process_count() > 1 else result
        return result if self._mesh is None else _one_copy(result)

    def _meet(self) -> None:
        if jax.process_count() > 1:
            # One host may be minutes behind, but collectives wait for half a minute only.
            self._meetings += 1
            sync_global_processes(
                f"arms {self._meetings}",
                processes=set(range(jax.process_count())),
                timeout=HOSTS_WAIT,
            )

    def render(self, state: TrainState, camera: Camera, key: jax.Array | None = None) -> Rendering:
        """Render a whole image; without a key, deterministically.

        `aux` is for the field alone, and images in quarters have none.
        """
        doublings = math.floor(math.log2(camera.width / self._width) + 0.4)
        if doublings == _QUARTERED and key is None and jax.default_backend() == "cpu":
            # The rest of a rendering is not per pixel, and cannot be joined.
            per_pixel = {"aux": (), "overflow": None}
            return in_quarters(lambda part: self.render(state, part)._replace(**per_pixel), camera)
        programs = self._for_doublings(doublings)
        while True:
            growth = programs.growth
            with programs._compiling("render", "compiling the renderer"):
                rendering = programs._render(state, camera, key)
            if rendering.overflow is None or not int(rendering.overflow):
                return rendering
            programs._grow(growth)


def _mesh_of_windows(windows: int) -> Mesh | None:
    """The devices that share the windows of a step evenly; None where that is one.

    Raises:
      ValueError: several hosts have devices that would get no window.
    """
    devices = jax.devices()
    count = math.gcd(windows, len(devices))
    if jax.process_count() > 1 and windows > 1 and count < len(devices):
        raise ValueError(
            f"--windows={windows} leaves devices of some hosts without work: choose a multiple of "
            f"their {len(devices)} devices"
        )
    return Mesh(np.array(devices[:count]), ("windows",)) if count > 1 else None


def _take_steps(
    step: Callable[..., tuple[TrainState, dict[str, Any]]],
    state: TrainState,
    *data: Any,
    count: int,
) -> tuple[TrainState, dict[str, Any]]:
    """`run_steps` of steps whose parts are compiled, and shared by all kinds of steps.

    To compile the rendering of an image, with its derivative, takes as long as hundreds of steps.
    """
    total = None
    for i in range(count):
        # Two threads would compile the same parts, so the first step takes one.
        state, metrics = step(state, *data, spread=in_threads(progress.workers() if i else 1))
        # No step begins before the last one ends: what waits would hold memory.
        total = metrics if total is None else jax.tree.map(jnp.add, total, metrics)
        jax.block_until_ready(total)
    return state, jax.tree.map(lambda leaf: leaf / count, total)


def describe_photographs(pyramid: Pyramid, divisor: int) -> str:
    """What the finest level of `Programs.pyramid` is, in words."""
    height, width = pyramid.sizes[0]
    share = f"1 / {divisor} of their size" if divisor > 1 else "their own size"
    return f"photographs of {width} x {height} pixels, {share}"


def _checked(metrics, kind, count):
    """Finite means as numbers, and counts of skipped steps, with a warning if there are any."""
    skipped = np.round(metrics.pop("skipped") * count).astype(int)
    if skipped.any():
        by_arm = f", by arm: {skipped.tolist()}" if kind == "arms" else ""
        print(f"warning: {skipped.max()} of {count} steps skipped, not finite{by_arm}")
    values = {key: float(np.mean(value)) for key, value in metrics.items()}
    values = {key: value for key, value in values.items() if math.isfinite(value)}
    return values | {"skipped": skipped.tolist()}


def _place(sharding: NamedSharding, tree: Any) -> Any:
    """Arrays that every host has whole, each host's part on its devices."""
    if jax.process_count() == 1:
        return jax.device_put(tree, sharding)

    def place(leaf):
        leaf = np.asarray(leaf)
        return jax.make_array_from_callback(leaf.shape, sharding, leaf.__getitem__)

    return _map_keys_as_numbers(place, tree)


def _one_copy(tree: Any) -> Any:
    """This host's first copy of arrays that every device has whole."""
    return _map_keys_as_numbers(lambda leaf: leaf.addressable_data(0), tree)


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
