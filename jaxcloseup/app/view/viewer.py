"""Render and fine-tune one run for all visitors of the viewer. Needs Viser."""

import contextlib
import functools
import pathlib
import queue
import threading
import time
import traceback
from collections.abc import Callable
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.run.exposed import expose
from jaxcloseup.app.run.fine_tuning import fine_tune, tuned_detail
from jaxcloseup.app.run.kept_detail import detail_getter, detailed
from jaxcloseup.app.run.labels import LabelStart, start_labels
from jaxcloseup.app.run.loop import TrainingError
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.view.camera_paths import training_focus
from jaxcloseup.app.view.orientation import up_direction
from jaxcloseup.app.view.picking import rank_views, ray_camera
from jaxcloseup.app.view.server import Server
from jaxcloseup.artifacts.images import color_counts, color_errors, to_uint8
from jaxcloseup.artifacts.viewer_gaussians import Gaussians, as_gaussians
from jaxcloseup.detail.add import Detail
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.support import find_support
from jaxcloseup.training.state import TrainState


_BUSY = "The viewer is still busy: wait until it has finished, and try again."
_THUMBNAIL = 80  # width of a photograph's thumbnail, in pixels

_find_support = jax.jit(find_support)


PICTURE, SUPPORT, TRUST, ERROR = SHOWN = (
    "picture",
    "photographs that saw it",
    "trust in detail",
    "expected error",
)
_TINT = 0.6  # share of colors that are laid over a picture


class Prepared(NamedTuple):
    """What renders cameras: a state, a function that finds its detail, and a sentence about it."""

    state: TrainState
    detail: Callable[[], Detail]
    said: str


class _Job(NamedTuple):
    """A job of a visitor, see `Viewer.later`."""

    what: str
    work: Callable[[], str]
    say: Callable[[str], None]
    yielding: bool


def _laid_over(
    picture: np.ndarray, colors: np.ndarray, legend: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    return to_uint8((_TINT * colors + (1 - _TINT) * picture) / 255), legend


class ViewError(Exception):
    """A visitor's request cannot be met. The message is one sentence that says what to do."""


class Viewer:
    """A run that all visitors share, and the queue of their jobs.

    Viser calls back in its own threads. Each callback puts its work into a queue that holds one
    job, and the main thread runs the job. So only one job runs at a time, and the page never waits.
    """

    def __init__(
        self,
        server: Server,
        programs: Programs,
        state: TrainState,
        *,
        stage: str,
        kept: pathlib.Path | None = None,
    ) -> None:
        """Show the scene on the server's pages; `welcome_visitors` fills them.

        Args:
          server: Viser's server.
          programs: the run's compiled programs.
          state: the state to show; every fine-tuning starts from it.
          stage: name of the state's stage.
          kept: file that keeps the state's detail, or None.
        """
        self.programs, self.state, self.scene = programs, state, programs.scene
        self.title = f"{self.scene.name}, {stage}"
        self._find = detail_getter(programs, state, kept)
        self._jobs: queue.Queue[_Job] = queue.Queue(maxsize=1)
        self._queueing = threading.Lock()
        _, positions = training_focus(self.scene)
        self.distance = float(np.median(np.linalg.norm(positions, axis=1)))
        gaps = np.linalg.norm(positions[:, None] - positions, axis=-1)
        gap = np.median(np.sort(gaps)[:, 1]) if len(gaps) > 1 else np.inf
        self.size = float(min(0.2 * gap, 0.04 * self.distance)) or 0.01 * self.distance
        self.thumbnails = [self._thumbnail(i) for i in range(len(positions))]
        server.scene.set_up_direction(up_direction(self.scene))
        server.scene.set_background_image(self.background())
        server.gui.set_panel_label(self.title)

    def work(self, timeout: float | None = None) -> None:
        """Wait for one job, and run it.

        Args:
          timeout: longest wait in seconds; None waits forever.

        Raises:
          queue.Empty: no job arrived within `timeout` seconds.
        """
        what, job, say, _ = self._jobs.get(timeout=timeout)

        def tell(sentence: str) -> None:
            say(sentence)
            print(sentence, flush=True)

        tell(f"{what} ...")
        start = time.perf_counter()
        try:
            tell(f"{job()} ({time.perf_counter() - start:.1f} s)")
        except (ViewError, TrainingError) as error:
            tell(str(error))
        except Exception as error:  # a bug must not close the page for its visitors
            traceback.print_exc()
            tell(f"{what} failed ({type(error).__name__}): see the terminal for details.")

    @property
    def busy(self) -> bool:
        """Return whether a job already waits, so that no other one can."""
        return self._jobs.full()

    def later(
        self,
        what: str,
        job: Callable[[], str],
        say: Callable[[str], None],
        *,
        yielding: bool = False,
    ) -> None:
        """Queue a job for the main thread, or say that the viewer is busy.

        Args:
          what: description of the job.
          job: does the work, and returns a sentence.
          say: shows a sentence to the visitor who asked.
          yielding: whether the next job may take this one's place while it waits.
        """
        with self._queueing:
            with contextlib.suppress(queue.Empty):
                waiting = self._jobs.get_nowait()
                if not waiting.yielding:
                    self._jobs.put_nowait(waiting)
                    say(_BUSY)
                    return
            self._jobs.put_nowait(_Job(what, job, say, yielding))

    def _thumbnail(self, index: int) -> np.ndarray:
        camera = self.scene.camera("train", index)
        photograph = to_uint8(self.scene.train.rgb[index, : camera.height, : camera.width])
        height = max(1, round(_THUMBNAIL * photograph.shape[0] / photograph.shape[1]))
        return cv2.resize(photograph, (_THUMBNAIL, height), interpolation=cv2.INTER_AREA)

    def find_surface(
        self, origin: np.ndarray, direction: np.ndarray
    ) -> tuple[int, np.ndarray, str]:
        """Find the first surface along a ray.

        Returns:
          The index of the photograph that shows it best, the point `[3]`, and a phrase that says
          how many photographs show it.

        Raises:
          ViewError: there is no surface, or no photograph shows it.
        """
        views = self.scene.train
        focal = float(np.median(np.asarray(views.cameras.intrinsics)[:, 1]))
        ray = ray_camera(origin, direction, focal)
        seen = label_depth(self.programs.render(self.state, ray), near=0, far=np.inf)
        depth = float(seen[1, 1])
        if depth <= 0:
            raise ViewError("There is no surface at that pixel: click on the scene.")
        point = np.asarray(ray.position) + depth * np.asarray(ray.rotation)[:, 2]
        data = (jnp.asarray(a, jnp.float32) for a in (point, direction))
        ranks = np.asarray(rank_views(views, self.labels.sources.depths, *data))
        if not ranks.any():
            raise ViewError("No photograph shows that point: click somewhere else.")
        shown = f"{np.count_nonzero(ranks)} of {len(ranks)} photographs show that point"
        return int(ranks.argmax()), point, shown

    def prepare(
        self, camera: Camera, *, tuned: bool, say_steps: Callable[[int, int], None]
    ) -> Prepared:
        """Return what renders a camera, with the detail of the photographs.

        Args:
          camera: the camera.
          tuned: whether to fine-tune a copy of the state for this camera first.
          say_steps: takes the number of finished steps of fine-tuning, and of all.
        """
        if not tuned:
            return Prepared(self.state, lambda: self._find()[0], "Rendered")
        start, cameras = self.labels, jax.tree.map(lambda leaf: leaf[None], camera)
        same = start.state is self.state
        find = self._find if same else detail_getter(self.programs, start.state)
        state = fine_tune(self.programs, start, cameras, find, report=say_steps)
        if state is start.state:
            said = "The gate let no labels in for this camera, so nothing was fine-tuned; rendered"
            return Prepared(state, lambda: self._find()[0], said)
        detail = tuned_detail(self.programs, state, cameras, self._find()[0])
        return Prepared(state, lambda: detail, "Fine-tuned and rendered")

    def look(
        self, prepared: Prepared, camera: Camera, *, detail: bool, shown: str = PICTURE
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return what a camera sees, uint8 `[H, W, 3]`, and a legend if colors need one.

        Args:
          prepared: what renders.
          camera: the camera.
          detail: whether to add the photographs' detail.
          shown: one of `SHOWN`; what is not the picture itself is laid over it.
        """
        seen = self.programs.render(prepared.state, camera)
        sharper = None
        if detail or shown in (TRUST, ERROR):
            sharper = detailed(self.programs, prepared.detail(), camera, seen)
        rgb = sharper.rgb if sharper is not None and detail else seen.rgb
        picture = to_uint8(expose(self.programs, rgb, seen))
        if shown == SUPPORT:
            sources = self.labels.sources
            depth = label_depth(seen, near=0, far=self.scene.far)
            pixels = pixel_grid(camera.height, camera.width)
            counts = _find_support(camera, pixels, depth, sources.views, sources.depths).count
            return _laid_over(picture, *color_counts(counts))
        if sharper is not None and shown == TRUST:
            return to_uint8(sharper.weight), None
        if sharper is not None and shown == ERROR:
            return _laid_over(picture, *color_errors(sharper.error))
        return picture, None

    def drawn(self, position: np.ndarray | None = None) -> Gaussians | None:
        """Return the Gaussians that represent the state, colored as seen from a position `[3]`."""
        splats = self.programs.method.splats
        if splats is None:
            return None
        return as_gaussians(*splats(self.state.params, self.state.buffers), position)

    def background(self) -> np.ndarray | None:
        """Return what is behind the drawn scene, as the run's own renderer has it."""
        method = self.programs.method
        if method.splats is None:
            return None
        return to_uint8(np.full((1, 1), method.background(self.programs.preset.field)))

    @functools.cached_property
    def labels(self) -> LabelStart:
        """Start of fine-tuning, with the depths that support needs; made once."""
        expected = self.programs.preset.labels.expected_depth
        return start_labels(self.programs, self.state, expected_depth=expected)
