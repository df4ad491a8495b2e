"""Compiled programs of one preset on one scene: kinds of steps, and rendering."""

import contextlib
import dataclasses
import functools
import math
import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from jaxcloseup.app import progress
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.run.devices import (
    gather_hosts,
    meet,
    mesh_of_arms,
    mesh_of_windows,
    one_copy,
    place,
)
from jaxcloseup.app.run.photograph_sizes import bound_filter, describe_photographs, finest_read
from jaxcloseup.app.run.read_photographs import ReadPhotographs
from jaxcloseup.app.run.step_data import ArmsData, StepData
from jaxcloseup.app.run.stereo_depths import StereoDepths
from jaxcloseup.app.run.taken_steps import check_steps, run_in_parts
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.io.memory import reusing_large_buffers
from jaxcloseup.photos.exposures import Exposures, Taken, at_middle_exposure
from jaxcloseup.photos.pyramids import Pyramid, photograph_pyramid
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views, unpadded
from jaxcloseup.photos.windows import Windows, in_quarters, photograph_windows
from jaxcloseup.training.arms import arm_specs, run_arms
from jaxcloseup.training.parallel import in_a_loop, over_devices
from jaxcloseup.training.state import Metrics, TrainState
from jaxcloseup.training.steps import closeup_step, run_steps


# Images 2^2 times as wide as training's are rendered in quarters on a CPU: that is as fast, and
# needs no program of their own. Wider ones are faster whole.
_QUARTERED = 2


class Programs:
    """The compiled programs of one preset on one scene.

    A field may have room for a fixed amount of work. Where an image needs more, `Programs` discards
    it, doubles the room, compiles everything anew and does the work again: no step learns from a
    truncated image, and no render shows one.
    """

    def __init__(
        self,
        preset: Preset,
        scene: Scene,
        *,
        width: int | None = None,
        read: ReadPhotographs | None = None,
    ) -> None:
        """Compile for a preset on a scene, for images as large as its photographs or `width`.

        `read` is what other programs of the scene made of its photographs.
        """
        self.preset, self.method = bound_filter(preset, scene), METHODS[preset.method]
        self.optimizer = self.method.make_optimizer(preset.field, scene)
        self.scene, self.growth = scene, 1
        self._growing = threading.Lock()
        self._width = width or scene.train.cameras.width
        self.taken: Taken | None = None  # how all views are taken; None: each as is known of it
        self._larger: dict[int, Programs] = {}
        self.read = read or ReadPhotographs(scene)
        self._compile()

    def _compile(self) -> None:
        self._announced: set[str] = set()
        self.field = field = self.method.make_field(self.preset.field, self.scene, self.growth)
        static = {
            "field": field,
            "optimizer": self.optimizer,
            "config": self.preset.train,
            "sequential": jax.default_backend() == "cpu",
        }
        self._static = static
        self._mesh = mesh_of_windows(self.preset.train.num_windows)
        self._arms_mesh = arms_mesh = mesh_of_arms()
        spread = in_a_loop if self._mesh is None else over_devices(self._mesh)

        # The type of `data` chooses the step, so each kind of data is compiled once. The number of
        # steps is traced; the input state is left alone.
        @jax.jit
        def run(state: TrainState, data: StepData, count: int) -> tuple[TrainState, Metrics]:
            step = functools.partial(data.step, **static, spread=spread)
            return run_steps(step, state, count=count)

        @jax.jit
        def run_together(
            states: TrainState, data: ArmsData, count: int
        ) -> tuple[TrainState, Metrics]:
            step = functools.partial(closeup_step, **static)
            return run_arms(
                step, states, data.views, data.sources, data.settings, count=count, mesh=arms_mesh
            )

        def render(state: TrainState, camera: Camera, key: jax.Array | None) -> Rendering:
            return field.render(state.params, state.buffers, camera, None, key)

        self._run, self._run_together = run, run_together
        # What renders whole images is compiled by itself, and steps share it.
        self._in_parts = not self.method.renders_pixels and self._mesh is None
        self._render = jax.jit(render) if self.method.renders_pixels else render

    def pyramid(self, finest: int = 1) -> tuple[Pyramid, int]:
        """Return the training photographs from the finest size that fits, and its divisor.

        They are read once, and shown at the middle exposure. `finest` is the smallest divisor of
        their size.
        """
        pyramid, divisor = self.read.pyramid(finest)
        return self.at_middle(pyramid), divisor

    @property
    def stereo(self) -> StereoDepths | None:
        """Return depth of the photographs by stereo; None without, or with too few to confirm."""
        return self.read.stereo(self.preset)

    @property
    def exposures(self) -> Exposures | None:
        """Return how exposures of the photographs differ; None where all have one exposure."""
        return self.read.exposures(self.preset)

    @functools.cached_property
    def train(self) -> Views:
        """Return the scene's training photographs at the middle exposure."""
        if self.exposures is None:
            return self.scene.train
        exposures = self.exposures
        curves = exposures.train_curves(self.scene.names["train"])
        return at_middle_exposure(self.scene.train, exposures.log_gains, curves)

    def at_middle(self, pyramid: Pyramid) -> Pyramid:
        """Return a pyramid of the training photographs that shows them at the middle exposure."""
        if self.exposures is None:
            return pyramid
        curves = self.exposures.train_curves(self.scene.names["train"])
        gains = jnp.exp(self.exposures.log_gains)
        return dataclasses.replace(pyramid, gains=gains, curves=curves)

    @functools.cached_property
    def coarse(self) -> "Programs":
        """Return the programs that train the preset's coarse model; all seeds share them."""
        assert self.preset.coarse is not None
        field = self.preset.coarse.field
        # The fine model begins with all that the coarse one has.
        field = dataclasses.replace(field, capacity=min(field.capacity, self.preset.field.capacity))
        preset = dataclasses.replace(self.preset, field=field, coarse=None, windows=None)
        return Programs(preset, self.scene, read=self.read)

    @functools.cached_property
    def photographs(self) -> Views | Windows:
        """Return what steps learn from: reduced photographs, or windows or pixels of finer ones."""
        views, windows = self.scene.train, self.preset.windows
        finest = finest_read(self.preset, self.scene)
        if windows is None or finest >= self.scene.metadata.get("downscale", 1):
            return self._whole()
        pyramid, divisor = self.pyramid(finest)
        if len(pyramid.sizes) == 1:
            return self._whole()
        parts = "pixels" if self.method.renders_pixels else "windows"
        print(f"learning from {parts} of {describe_photographs(pyramid, divisor)}")
        return photograph_windows(views.cameras, pyramid, whole_share=windows.whole_share)

    def _whole(self) -> Views | Windows:
        """Return reduced photographs, or windows of the size that all have where sizes differ."""
        views, sizes = self.scene.train, self.scene.sizes("train")
        if len(set(sizes)) == 1:
            return self.train
        pyramid = self.at_middle(photograph_pyramid(unpadded(views, sizes)))
        return photograph_windows(views.cameras, pyramid, whole_share=1.0)

    def make_room(self, growth: int) -> None:
        """Grow the room to at least `growth` times the preset's."""
        if growth > self.growth:
            self.growth = growth
            self._compile()

    def _for_doublings(self, doublings: int) -> "Programs":
        """Return the programs of larger images, whose room must not slow training."""
        if doublings <= 0:
            return self
        if doublings not in self._larger:
            width = self._width * 2**doublings
            large = Programs(self.preset, self.scene, width=width, read=self.read)
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
        self, state: TrainState, data: StepData | ArmsData, *, count: int
    ) -> tuple[TrainState, dict[str, Any]]:
        """Take `count` steps of the kind that learns from `data`.

        For `ArmsData`, the state is one that `stack_states` made.

        Returns:
          The next state and the means of the steps' metrics, over arms too; `skipped` counts the
          steps that were skipped because loss or gradient was not finite, by arm if there are
          several. A mean that is not finite, such as the PSNR without any label, is left out.
        """
        state, data = self._place(state, data)
        while True:
            growth = self.growth
            compiling = self._announce_compiling(type(data).__name__, "compiling the steps")
            with compiling, reusing_large_buffers():
                after, metrics = self._take_steps(state, data, count)
                metrics = jax.device_get(metrics)
            # Means of counts: positive if any step had an overflow.
            overflow = [metrics.pop(key, np.zeros(())) for key in ("overflow", "label_overflow")]
            if not any(np.any(values) for values in overflow):
                return after, check_steps(metrics, count)
            self._grow(growth)

    def _announce_compiling(self, kind: str, what: str) -> contextlib.AbstractContextManager[Any]:
        """Print what is compiled, on the first call for a kind of step or for rendering."""
        if kind in self._announced:
            return contextlib.nullcontext()
        self._announced.add(kind)
        return progress.saying(what)

    def _place(self, state: TrainState, data: Any) -> tuple[TrainState, Any]:
        """Put state and data of steps on the devices that take them."""
        # What comes out of a checkpoint lies on one device.
        if isinstance(data, ArmsData):
            meet()
            specs = arm_specs(state, data.sources, self._arms_mesh)
            state, views, sources, settings = jax.tree.map(
                lambda spec, arrays: place(NamedSharding(self._arms_mesh, spec), arrays),
                specs,
                (state, data.views, data.sources, data.settings),
                is_leaf=lambda leaf: isinstance(leaf, PartitionSpec),
            )
            return state, ArmsData(views, sources, settings)
        if self._mesh is None:
            return state, data
        meet()
        return place(NamedSharding(self._mesh, PartitionSpec()), (state, data))

    def _take_steps(
        self, state: TrainState, data: StepData | ArmsData, count: int
    ) -> tuple[TrainState, Metrics]:
        """Take the steps; the result is whole on this host."""
        if isinstance(data, ArmsData):
            return gather_hosts(self._run_together(state, data, count))
        if self._in_parts:
            step = functools.partial(data.step, **self._static)
            local = self.field.local if self.preset.train.num_windows == 1 else None
            if local is None or jax.default_backend() != "cpu":
                return run_in_parts(step, state, count=count)
            step = functools.partial(step, local=True)
            state, metrics = run_in_parts(step, local.prepare(state), count=count)
            return local.finish(state), metrics
        result = self._run(state, data, count)
        return result if self._mesh is None else one_copy(result)

    def render(self, state: TrainState, camera: Camera, key: jax.Array | None = None) -> Rendering:
        """Render a whole image; without a key, deterministically.

        `aux` is for the field alone, and images in quarters have none.
        """
        doublings = math.floor(math.log2(camera.width / self._width) + 0.4)
        if doublings == _QUARTERED and key is None and jax.default_backend() == "cpu":

            def render_part(part: Camera) -> Rendering:
                # The rest of a rendering is not per pixel, and cannot be joined.
                return self.render(state, part)._replace(aux=(), overflow=None)

            return in_quarters(render_part, camera)
        programs = self._for_doublings(doublings)
        while True:
            growth = programs.growth
            with programs._announce_compiling("render", "compiling the renderer"):
                rendering = programs._render(state, camera, key)
            if rendering.overflow is None or not int(rendering.overflow):
                return rendering
            programs._grow(growth)
