"""Fill the page of one visitor of the viewer: a scene, buttons, a camera and pictures."""

import functools
import threading
import time
from typing import Any

import numpy as np
from viser.transforms import SO3

from jaxcloseup.app.view.picking import closeup_camera, vertical_fov, viewer_camera
from jaxcloseup.app.view.server import Server
from jaxcloseup.app.view.viewer import Viewer
from jaxcloseup.artifacts.images import color_counts, encode_png, to_uint8
from jaxcloseup.geometry.cameras import Camera


_HELP = """Click on the scene to place the red close-up camera in front of that point.
Click on a training camera to move there.
"Render" renders what the red camera sees, or your own view if there is no red camera."""
_MIN_WIDTH = 360  # the page enlarges narrower pictures to at least this width, in pixels
_REST = 0.3  # seconds without a move before colors change to those of the new position
_TINT = 0.7  # share of the colors of support, if these are shown


def welcome_visitors(server: Server, viewer: Viewer) -> "dict[int, Visitor]":
    """Fill the page of each client that connects to a server; return the present visitors.

    Args:
      server: Viser's server.
      viewer: the run that all of them see.
    """
    visitors: dict[int, Visitor] = {}

    def welcome(client: Any) -> None:
        visitors[client.client_id] = Visitor(viewer, client)

    def forget(client: Any) -> None:
        visitor = visitors.pop(client.client_id, None)
        if visitor is not None:
            visitor.leave()

    server.on_client_connect(welcome)
    server.on_client_disconnect(forget)
    return visitors


class Visitor:
    """Page of one visitor. Visitors share only the viewer."""

    def __init__(self, viewer: Viewer, client: Any) -> None:
        """Fill the page of a client of Viser's server."""
        self._viewer, self._client = viewer, client
        self._camera: Camera | None = None  # the close-up camera
        self._aim: tuple[Camera, np.ndarray] | None = None  # source camera, point
        self._picture: np.ndarray | None = None
        self._visited = -np.inf  # time of the last visit to a camera, seconds
        self._rest: threading.Timer | None = None
        self._counts: np.ndarray | None = None  # numbers of photographs, while support is shown
        self._drawing = threading.Lock()
        self._gone = False
        self._drawn = self._add_scene()
        self._cameras = client.scene.add_frame("/cameras", show_axes=False)
        self._frustums = [self._add_photograph(i) for i in range(len(viewer.thumbnails))]
        self._add_controls()
        self._visit(0)
        client.scene.on_click()(self._on_click)
        client.camera.on_update(self._on_move)

    def leave(self) -> None:
        """Stop drawing for a visitor who is gone."""
        self._gone = True
        if self._rest is not None:
            self._rest.cancel()

    def _say(self, sentence: str) -> None:
        self._status.content = sentence

    def _say_steps(self, done: int, steps: int) -> None:
        self._say(f"fine-tuning for this camera: {done} of {steps} steps ...")

    def _add_scene(self) -> Any:
        scene, viewer = self._client.scene, self._viewer
        gaussians = viewer.drawn()
        if gaussians is not None:
            # Viser stores covariances in 16 bits, so scale the largest radius to 100 units.
            variances = np.trace(gaussians.covariances, axis1=1, axis2=2)
            unit = np.sqrt(variances.max(initial=1e-18)) / 100
            return scene.add_gaussian_splats(
                "/surfels",
                gaussians.means / unit,
                gaussians.covariances / unit**2,
                gaussians.rgb,
                gaussians.opacities[:, None],
                scale=unit,
            )
        if len(viewer.scene.points):
            size = 0.003 * viewer.distance
            points, rgb = viewer.scene.points, to_uint8(viewer.scene.rgb[None])[0]
            return scene.add_point_cloud("/points", points, rgb, point_size=size)
        return None

    def _on_move(self, _: Any) -> None:
        """Draw the colors of the new position once the camera rests: Viser has one color each."""
        if self._rest is not None:
            self._rest.cancel()
        self._rest = threading.Timer(_REST, self._draw)
        self._rest.daemon = True
        self._rest.start()

    def _draw(self) -> None:
        with self._drawing:
            if self._drawn is None or self._gone:
                return
            gaussians, counts = self._viewer.drawn(self._client.camera.position), self._counts
            rgb = to_uint8(self._viewer.scene.rgb[None])[0] if gaussians is None else gaussians.rgb
            if counts is not None:
                tint, plain = color_counts(counts)[0], to_uint8(rgb[None])[0]
                rgb = np.rint(_TINT * tint + (1 - _TINT) * plain).astype(np.uint8)
            if gaussians is None:
                self._drawn.colors = rgb
            else:
                self._drawn.rgbs = rgb

    def _add_photograph(self, index: int) -> Any:
        viewer = self._viewer
        camera = viewer.scene.camera("train", index)
        name = f"/cameras/{viewer.scene.names['train'][index]}"
        frustum = self._add_frustum(name, camera, viewer.thumbnails[index])
        frustum.on_click(lambda _: self._visit(index))
        return frustum

    def _add_frustum(self, name: str, camera: Camera, image: np.ndarray | None = None) -> Any:
        return self._client.scene.add_camera_frustum(
            name,
            vertical_fov(camera),
            camera.width / camera.height,
            scale=self._viewer.size,
            thickness=1.5,
            thickness_units="screen",
            color=(150, 150, 150) if image is not None else (220, 0, 0),
            image=image,
            wxyz=_quaternion(camera),
            position=np.asarray(camera.position),
        )

    def _add_controls(self) -> None:
        gui = self._client.gui
        # Status and picture come first, so that nobody has to scroll to them.
        black = np.zeros((1, 1, 3), np.uint8)
        self._status = gui.add_markdown("")
        self._image = gui.add_image(black, label="rendered", format="png", visible=False)
        self._nearer = gui.add_slider("times nearer", 1, 16, 0.5, 4)
        self._nearer.on_update(lambda _: self._place())
        self._sharpen = gui.add_checkbox("detail of the photographs", initial_value=True)
        shown = gui.add_checkbox("training cameras", initial_value=True)
        shown.on_update(lambda _: setattr(self._cameras, "visible", shown.value))
        self._supported = gui.add_checkbox("support", initial_value=False)
        self._supported.on_update(lambda _: self._on_support())
        _, legend = color_counts(np.zeros(1))
        self._legend = gui.add_image(
            legend, label="photographs that saw it", format="png", visible=False
        )
        buttons = {
            "Place camera here": self._on_here,
            "Render": functools.partial(self._on_render, tuned=False),
            "Fine-tune and render": functools.partial(self._on_render, tuned=True),
            "Download PNG": self._on_download,
        }
        for name, call in buttons.items():
            gui.add_button(name).on_click(call)
        self._support = gui.add_image(black, label="support", format="png", visible=False)
        self._error = gui.add_image(
            black, label="expected error, in gray levels of 255", format="png", visible=False
        )
        gui.add_markdown(_HELP)

    def _visit(self, index: int) -> None:
        """Move to a training camera; hide its photograph, which would cover the scene."""
        self._visited = time.monotonic()
        for i, frustum in enumerate(self._frustums):
            frustum.visible = i != index
        self._bring(self._viewer.scene.camera("train", index), self._viewer.distance)

    def _on_click(self, event: Any) -> None:
        # Viser reports a click on a training camera a second time, as a click on the scene.
        if time.monotonic() - self._visited > 0.5:
            ray = np.array(event.ray_origin), np.array(event.ray_direction)
            self._viewer.later("finding that surface", lambda: self._aim_at(*ray), self._say)

    def _on_here(self, _: Any) -> None:
        self._aim = None
        self._show_camera(self._own_camera())

    def _on_support(self) -> None:
        self._legend.visible = self._supported.value
        if self._supported.value:
            self._viewer.later("counting photographs", self._show_counts, self._say)
        else:
            self._counts = None
            self._draw()

    def _show_counts(self) -> str:
        self._counts = self._viewer.counts
        self._draw()
        return "Colors show how many photographs saw the surface"

    def _on_render(self, _: Any, *, tuned: bool) -> None:
        here = self._own_camera()
        what = "fine-tuning for this camera" if tuned else "rendering"

        def render() -> str:  # by then, an earlier click may have moved the close-up camera
            return self._render(here if self._camera is None else self._camera, tuned)

        self._viewer.later(what, render, self._say)

    def _on_download(self, _: Any) -> None:
        if self._picture is None:
            self._say("There is no picture yet: render one first.")
        else:
            name = f"{self._viewer.title.replace(', ', '_')}.png"
            self._client.send_file_download(name, encode_png(self._picture), save_immediately=True)

    def _aim_at(self, origin: np.ndarray, direction: np.ndarray) -> str:
        """Put the close-up camera in front of the first surface along a ray."""
        best, point, shown = self._viewer.find_surface(origin, direction)
        scene = self._viewer.scene
        self._aim = scene.camera("train", best), point
        self._place()
        return f"{shown}; the close-up camera starts from {scene.names['train'][best]}"

    def _place(self) -> None:
        """Put the close-up camera as near to the point as the slider says."""
        aim = self._aim  # read once: another thread may reset it
        if aim is None:
            return
        source, point = aim
        camera = closeup_camera(source, point, self._nearer.value)
        self._show_camera(camera)
        self._bring(camera, float(np.linalg.norm(point - np.asarray(camera.position))))

    def _show_camera(self, camera: Camera) -> None:
        self._camera = camera
        self._add_frustum("/closeup", camera)

    def _render(self, camera: Camera, tuned: bool) -> str:
        images, said = self._viewer.render(
            camera, tuned=tuned, detail=self._sharpen.value, say_steps=self._say_steps
        )
        self._picture = picture = to_uint8(images["rgb"])
        factor = -(-_MIN_WIDTH // picture.shape[1])
        self._image.image = picture.repeat(factor, axis=0).repeat(factor, axis=1)
        self._support.image = images["support"]
        self._image.visible = self._support.visible = True
        self._error.visible = "error" in images
        if self._error.visible:
            self._error.image = images["error"]
        return said

    def _own_camera(self) -> Camera:
        """Return the visitor's camera, with the first photograph's image size."""
        camera = self._client.camera
        rotation = SO3(camera.wxyz).as_matrix()
        like = self._viewer.scene.camera("train", 0)
        return viewer_camera(rotation, camera.position, camera.fov, like)

    def _bring(self, camera: Camera, distance: float) -> None:
        """Move the visitor to a camera; dragging then orbits a point `distance` ahead."""
        position, forward = np.asarray(camera.position), np.asarray(camera.rotation)[:, 2]
        client = self._client
        with client.atomic():
            client.camera.position = position
            client.camera.look_at = position + distance * forward
            client.camera.wxyz = _quaternion(camera)
            client.camera.fov = vertical_fov(camera)
            client.camera.near, client.camera.far = distance / 100, 1000 * distance


def _quaternion(camera: Camera) -> np.ndarray:
    return SO3.from_matrix(np.asarray(camera.rotation, np.float64)).wxyz
