"""The page of `experiments.view`: a run's scene, its photographs and buttons. Needs Viser."""

import functools
import pathlib
import queue
import time
import traceback

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from viser.transforms import SO3

from experiments.training.detail import find_detail
from experiments.training.fine_tuning import fine_tune
from experiments.training.loop import TrainingError
from experiments.training.programs import Programs
from experiments.training.setup import LabelStart, start_labels
from experiments.viewing.camera_paths import focus_point
from experiments.viewing.frames import render_pictures
from experiments.viewing.orientation import up_direction
from experiments.viewing.picking import (
    closeup_camera,
    rank_views,
    ray_camera,
    vertical_fov,
    viewer_camera,
)
from experiments.viewing.server import Server
from jaxcloseup.artifacts.images import encode_png, to_uint8
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.label_rules import label_depth
from jaxcloseup.train import TrainState


_HELP = """Click on the scene to place the red close-up camera in front of that point.
Click on a training camera to move there.
"Render" renders what the red camera sees, or your own view if there is no red camera."""
_BUSY = "The viewer is still busy: wait until it has finished, and try again."
_THUMBNAIL = 80  # width of a photograph's thumbnail, in pixels
_MIN_WIDTH = 360  # the page enlarges narrower pictures to at least this width, in pixels


class ViewError(Exception):
    """A visitor's request cannot be met. The message is one sentence that says what to do."""


class Viewer:
    """The contents of the page and the actions of its buttons.

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
        seed: int,
        kept: pathlib.Path | None = None,
    ) -> None:
        """Fill the page.

        Args:
          server: Viser's server.
          programs: the run's compiled programs.
          state: the state to show; every fine-tuning starts from it.
          stage: name of the state's stage.
          seed: the run's seed.
          kept: file that keeps the state's detail, or None.
        """
        self._server, self._programs, self._state = server, programs, state
        self._scene, self._stage, self._seed = programs.scene, stage, seed
        self._jobs: queue.Queue = queue.Queue(maxsize=1)
        self._start: LabelStart | None = None
        self._kept, self._detail = kept, None
        self._camera: Camera | None = None  # the close-up camera
        self._aim: tuple[Camera, np.ndarray] | None = None  # source camera, point
        self._picture: np.ndarray | None = None
        self._visited = -np.inf  # time of the last visit to a camera, seconds
        cameras = self._scene.train.cameras
        positions, rotations = (np.asarray(a) for a in (cameras.position, cameras.rotation))
        near, far = self._scene.near, self._scene.far
        center = focus_point(positions, rotations[..., 2], near=near, far=far)
        self._distance = float(np.median(np.linalg.norm(positions - center, axis=1)))
        gaps = np.linalg.norm(positions[:, None] - positions, axis=-1)
        gap = np.median(np.sort(gaps)[:, 1]) if len(gaps) > 1 else np.inf
        self._size = float(min(0.2 * gap, 0.04 * self._distance)) or 0.01 * self._distance
        server.scene.set_up_direction(up_direction(self._scene))
        self._add_scene()
        self._cameras = server.scene.add_frame("/cameras", show_axes=False)
        self._frustums = [self._add_photograph(i) for i in range(len(positions))]
        self._add_controls()
        server.on_client_connect(lambda client: self._visit(client, 0))
        server.scene.on_click()(self._on_click)

    def work(self, timeout: float | None = None) -> None:
        """Wait for one job, and run it.

        Args:
          timeout: longest wait in seconds; None waits forever.

        Raises:
          queue.Empty: no job arrived within `timeout` seconds.
        """
        what, job = self._jobs.get(timeout=timeout)
        self._say(f"{what} ...")
        start = time.perf_counter()
        try:
            self._say(f"{job()} ({time.perf_counter() - start:.1f} s)")
        except (ViewError, TrainingError) as error:
            self._say(str(error))
        except Exception as error:  # a bug must not end the page for its visitors
            traceback.print_exc()
            self._say(f"{what} failed ({type(error).__name__}): see the terminal for details.")

    def _add_scene(self):
        scene, params = self._server.scene, self._state.params
        method, config = self._programs.method, self._programs.preset.field
        if method.gaussians is not None:
            found = method.gaussians(params, self._state.buffers)
            # Viser stores covariances in 16 bits, so scale the largest radius to 100 units.
            variances = np.trace(found.covariances, axis1=1, axis2=2)
            unit = np.sqrt(variances.max(initial=1e-18)) / 100
            scene.add_gaussian_splats(
                "/surfels",
                found.means / unit,
                found.covariances / unit**2,
                found.rgb,
                found.opacities[:, None],
                scale=unit,
            )
            # The background that the run's own renderer uses.
            scene.set_background_image(to_uint8(np.full((1, 1), method.background(config))))
        elif len(self._scene.points):
            size = 0.003 * self._distance
            points, rgb = self._scene.points, to_uint8(self._scene.rgb[None])[0]
            scene.add_point_cloud("/points", points, rgb, point_size=size)

    def _add_photograph(self, index):
        camera = self._scene.camera("train", index)
        photograph = to_uint8(self._scene.train.rgb[index, : camera.height, : camera.width])
        height = max(1, round(_THUMBNAIL * photograph.shape[0] / photograph.shape[1]))
        photograph = cv2.resize(photograph, (_THUMBNAIL, height), interpolation=cv2.INTER_AREA)
        name = f"/cameras/{self._scene.names['train'][index]}"
        frustum = self._add_frustum(name, camera, photograph)
        frustum.on_click(lambda event: self._visit(event.client, index))
        return frustum

    def _add_frustum(self, name, camera, image=None):
        return self._server.scene.add_camera_frustum(
            name,
            vertical_fov(camera),
            camera.width / camera.height,
            scale=self._size,
            thickness=1.5,
            thickness_units="screen",
            color=(150, 150, 150) if image is not None else (220, 0, 0),
            image=image,
            wxyz=_quaternion(camera),
            position=np.asarray(camera.position),
        )

    def _add_controls(self):
        gui = self._server.gui
        gui.set_panel_label(f"{self._scene.name}, {self._stage}")
        # What is said and rendered comes first, so that nobody has to scroll to it.
        black = np.zeros((1, 1, 3), np.uint8)
        self._status = gui.add_markdown("")
        self._image = gui.add_image(black, label="rendered", format="png", visible=False)
        self._nearer = gui.add_slider("times nearer", 1, 16, 0.5, 4)
        self._nearer.on_update(lambda event: self._place(event.client))
        self._sharpen = gui.add_checkbox("detail of the photographs", initial_value=True)
        shown = gui.add_checkbox("training cameras", initial_value=True)
        shown.on_update(lambda _: setattr(self._cameras, "visible", shown.value))
        buttons = {
            "Place camera here": self._on_here,
            "Render": functools.partial(self._on_render, tuned=False),
            "Fine-tune and render": functools.partial(self._on_render, tuned=True),
            "Download PNG": self._on_download,
        }
        for name, call in buttons.items():
            gui.add_button(name).on_click(call)
        self._support = gui.add_image(black, label="support", format="png", visible=False)
        gui.add_markdown(_HELP)

    def _say(self, sentence):
        self._status.content = sentence
        print(sentence, flush=True)

    def _say_steps(self, done, steps):
        self._status.content = f"fine-tuning for this camera: {done} of {steps} steps ..."

    def _later(self, what, job):
        try:
            self._jobs.put_nowait((what, job))
        except queue.Full:
            self._status.content = _BUSY

    def _visit(self, client, index):
        """Move a visitor to a training camera; hide its photograph, which would cover the scene."""
        self._visited = time.monotonic()
        for i, frustum in enumerate(self._frustums):
            frustum.visible = i != index
        _bring(client, self._scene.camera("train", index), self._distance)

    def _on_click(self, event):
        # Viser reports a click on a training camera a second time, as a click on the scene.
        if time.monotonic() - self._visited > 0.5:
            ray = np.array(event.ray_origin), np.array(event.ray_direction)
            self._later("finding that surface", lambda: self._aim_at(event.client, *ray))

    def _on_here(self, event):
        self._aim, self._camera = None, self._seen_by(event.client)
        self._show_camera()

    def _on_render(self, event, *, tuned):
        camera = self._camera if self._camera is not None else self._seen_by(event.client)
        what = "fine-tuning for this camera" if tuned else "rendering"
        self._later(what, lambda: self._render(camera, tuned))

    def _on_download(self, event):
        if self._picture is None:
            self._status.content = "There is no picture yet: render one first."
        else:
            name = f"{self._scene.name}_{self._stage}.png"
            event.client.send_file_download(name, encode_png(self._picture), save_immediately=True)

    def _aim_at(self, client, origin, direction):
        """Put the close-up camera in front of the first surface along a ray."""
        views = self._scene.train
        focal = float(np.median(np.asarray(views.cameras.intrinsics)[:, 1]))
        ray = ray_camera(origin, direction, focal)
        seen = label_depth(self._programs.render(self._state, ray), near=0, far=np.inf)
        depth = float(seen[1, 1])
        if depth <= 0:
            raise ViewError("There is no surface at that pixel: click on the scene.")
        point = np.asarray(ray.position) + depth * np.asarray(ray.rotation)[:, 2]
        data = (jnp.asarray(a, jnp.float32) for a in (point, direction))
        ranks = np.asarray(rank_views(views, self._label_start().sources.depths, *data))
        if not ranks.any():
            raise ViewError("No photograph shows that point: click somewhere else.")
        best = int(ranks.argmax())
        self._aim = self._scene.camera("train", best), point
        self._place(client)
        shown = f"{np.count_nonzero(ranks)} of {len(ranks)} photographs show that point"
        return f"{shown}; the close-up camera starts from {self._scene.names['train'][best]}"

    def _place(self, client):
        """Put the close-up camera as near to the point as the slider says."""
        aim = self._aim  # read once: another thread may reset it
        if aim is None:
            return
        source, point = aim
        self._camera = closeup_camera(source, point, self._nearer.value)
        self._show_camera()
        if client is not None:
            _bring(client, self._camera, np.linalg.norm(point - np.asarray(self._camera.position)))

    def _show_camera(self):
        self._add_frustum("/closeup", self._camera)

    def _render(self, camera, tuned):
        start, state = self._label_start(), self._state
        if tuned:
            cameras = jax.tree.map(lambda leaf: leaf[None], camera)
            kept = self._kept if start.state is self._state else None
            state = fine_tune(
                *(self._programs, start, cameras), most=None, kept=kept, tell=self._say_steps
            )
        # A state tuned for one camera differs from the one whose detail is known.
        detail = self._find_detail() if self._sharpen.value and state is self._state else None
        images = render_pictures(
            self._programs, state, camera, sources=start.sources, detail=detail
        )
        self._picture = picture = to_uint8(images["rgb"])
        factor = -(-_MIN_WIDTH // picture.shape[1])
        self._image.image = picture.repeat(factor, axis=0).repeat(factor, axis=1)
        self._support.image = images["support"]
        self._image.visible = self._support.visible = True
        if tuned and state is start.state:
            return "The gate let no labels in for this camera, so nothing was fine-tuned; rendered"
        return "Fine-tuned and rendered" if tuned else "Rendered"

    def _label_start(self):
        if self._start is None:
            expected = self._programs.preset.labels.expected_depth
            self._start = start_labels(
                self._programs, self._state, self._seed, expected_depth=expected
            )
        return self._start

    def _find_detail(self):
        if self._detail is None:
            self._detail, _ = find_detail(self._programs, self._state, self._kept)
        return self._detail

    def _seen_by(self, client):
        """Return a visitor's camera, with the first photograph's image size."""
        rotation = SO3(client.camera.wxyz).as_matrix()
        like = self._scene.camera("train", 0)
        return viewer_camera(rotation, client.camera.position, client.camera.fov, like)


def _bring(client, camera, distance):
    """Give a visitor a camera's pose and field of view; orbit a point `distance` ahead of it."""
    position, forward = np.asarray(camera.position), np.asarray(camera.rotation)[:, 2]
    with client.atomic():
        client.camera.position = position
        client.camera.look_at = position + distance * forward
        client.camera.wxyz = _quaternion(camera)
        client.camera.fov = vertical_fov(camera)
        client.camera.near, client.camera.far = distance / 100, 1000 * distance


def _quaternion(camera):
    return SO3.from_matrix(np.asarray(camera.rotation, np.float64)).wxyz
