"""Fill the page of one visitor of the viewer: a scene, buttons, a camera and pictures."""

import functools
import threading
import time
from typing import Any

import jax.numpy as jnp
import numpy as np
from viser.transforms import SO3

from jaxcloseup.app.view.camera_paths import CameraError
from jaxcloseup.app.view.drawn_scene import add_frustum, add_scene, quaternion, same
from jaxcloseup.app.view.photograph_pixels import pinhole_pixel
from jaxcloseup.app.view.picking import closeup_camera, vertical_fov, viewer_camera, window_size
from jaxcloseup.app.view.viewer import PICTURE, SHOWN, Prepared, Viewer
from jaxcloseup.artifacts.images import encode_png
from jaxcloseup.geometry.cameras import Camera, pixels_to_points


_HELP = """Click on the scene, or give a pixel of a photograph, to come near to that point.
Drag to move; click on a training camera to move there.
When you rest, the window shows the scene as the run renders it, with detail."""
_REST = 0.3  # seconds without a move before the window is rendered
_SAME = 1e-4  # of the distance from the scene, up to which positions are one
_TINT = 0.7  # share of the colors of support, if these are shown


class Visitor:
    """Page of one visitor. Visitors share only the viewer."""

    def __init__(self, viewer: Viewer, client: Any) -> None:
        """Fill the page of a client of Viser's server."""
        self._viewer, self._client = viewer, client
        self._aim: tuple[Camera, np.ndarray] | None = None  # source camera, point
        self._history: list[tuple[Camera, float]] = []  # cameras, and how far ahead their point is
        self._at_photograph = False  # whether a visit to a photograph has left the close-up
        self._prepared: Prepared | None = None  # what rendered the window last
        self._rendered: Camera | None = None  # the window's camera while its render is shown
        self._size = (0, 0)  # of the rendered window
        self._visited = -np.inf  # time of the last visit to a camera, seconds
        self._rest: threading.Timer | None = None
        self._drawing, self._showing = threading.Lock(), threading.Lock()
        self._gone = False
        self._drawn = add_scene(client.scene, viewer)
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

    def _on_move(self, _: Any) -> None:
        """Show the drawn scene while the camera moves, and render the window once it rests."""
        rendered = self._rendered
        if rendered is not None:
            if self._still(rendered):
                return
            self._hide_render()
        if self._rest is not None:
            self._rest.cancel()
        self._rest = threading.Timer(_REST, self._on_rest)
        self._rest.daemon = True
        self._rest.start()

    def _still(self, camera: Camera) -> bool:
        """Return whether the visitor has the camera that was rendered."""
        return same(camera, self._own_camera(), within=_SAME * self._viewer.distance)

    def _on_rest(self) -> None:
        self._draw()  # Viser has one color of each surfel, that of one position
        rendered = self._rendered
        shown = rendered is not None and self._still(rendered)
        if self._gone or shown or not self._automatic.value:
            return
        if self._viewer.busy:
            self._on_move(None)  # try again later
        else:
            self._viewer.later(
                "rendering the window", self._render_window, self._say, yielding=True
            )

    def _hide_render(self) -> None:
        with self._showing:
            if self._rendered is None:
                return
            self._rendered = self._prepared = None
            self._set_window(self._viewer.background(), drawn=True)

    def _set_window(self, picture: np.ndarray | None, *, drawn: bool, **how: Any) -> None:
        """Show a picture behind the drawn scene, or in its place."""
        with self._client.atomic():
            self._client.scene.set_background_image(picture, **how)
            if self._drawn is not None:
                self._drawn.visible = drawn

    def _render_window(self, *, tuned: bool = False) -> str:
        """Render what the window shows, and show it until the camera moves."""
        camera, viewer, rendered = self._own_camera(), self._viewer, self._rendered
        if not tuned and rendered is not None and self._still(rendered):
            return "Rendered"  # a click has rendered it meanwhile
        prepared = viewer.prepare(camera, tuned=tuned, say_steps=self._say_steps)
        self._show(prepared, camera)
        return prepared.said

    def _show(self, prepared: Prepared, camera: Camera) -> None:
        picture, legend = self._viewer.look(
            prepared, camera, detail=self._sharpen.value, shown=self._shown.value
        )
        with self._showing:  # a move meanwhile hides this picture, not what was there before
            self._prepared, self._rendered = prepared, camera
            self._set_window(picture, drawn=False, format="jpeg", jpeg_quality=95)
        self._legend.visible = legend is not None
        if legend is not None:
            self._legend.image = legend
        if not self._still(camera):  # the camera moved on meanwhile
            self._on_move(None)

    def _show_again(self, _: Any) -> None:
        """Show the window's render with what the switches say now."""
        prepared, camera = self._prepared, self._rendered
        if prepared is None or camera is None:
            self._on_move(None)
            return

        def show() -> str:
            self._show(prepared, camera)
            return "Rendered"

        self._viewer.later("rendering the window", show, self._say)

    def _draw(self) -> None:
        """Color the drawn surfels as they are seen from here."""
        with self._drawing:
            if self._drawn is None or self._gone:
                return
            gaussians = self._viewer.drawn(self._client.camera.position)
            if gaussians is not None:
                self._drawn.rgbs = gaussians.rgb

    def _add_photograph(self, index: int) -> Any:
        viewer = self._viewer
        camera = viewer.scene.camera("train", index)
        name = f"/cameras/{viewer.scene.names['train'][index]}"
        scene = self._client.scene
        frustum = add_frustum(scene, name, camera, viewer.size, viewer.thumbnails[index])
        frustum.on_click(lambda _: self._visit(index))
        return frustum

    def _add_controls(self) -> None:
        gui, viewer = self._client.gui, self._viewer
        self._status = gui.add_markdown("")  # first, so that nobody has to scroll to it
        self._nearer = gui.add_slider("times nearer", 1, 16, 0.5, 4)
        self._nearer.on_update(lambda _: self._place())
        self._automatic = gui.add_checkbox("render when at rest", initial_value=True)
        self._sharpen = gui.add_checkbox("detail of the photographs", initial_value=True)
        self._shown = gui.add_dropdown("window shows", SHOWN, initial_value=PICTURE)
        for control in (self._automatic, self._sharpen, self._shown):
            control.on_update(self._show_again)
        none = np.zeros((1, 1, 3), np.uint8)
        self._legend = gui.add_image(none, label="colors", format="png", visible=False)
        cameras = gui.add_checkbox("training cameras", initial_value=True)
        cameras.on_update(lambda _: setattr(self._cameras, "visible", cameras.value))
        names, first = viewer.scene.names["train"], viewer.scene.own_camera("train", 0)
        self._photograph = gui.add_dropdown("photograph", names, initial_value=names[0])
        middle = (first.width / 2, first.height / 2)
        self._pixel = gui.add_vector2("pixel x, y", initial_value=middle, min=(0, 0), step=1)
        buttons = {
            "Go to the pixel": self._on_pixel,
            "Back": self._on_back,
            "Fine-tune and render": self._on_tune,
            "Download PNG": self._on_download,
        }
        for name, call in buttons.items():
            gui.add_button(name).on_click(call)
        gui.add_markdown(_HELP)

    def _visit(self, index: int) -> None:
        """Move to a training camera; hide its photograph, which would cover the scene."""
        self._visited = time.monotonic()
        for i, frustum in enumerate(self._frustums):
            frustum.visible = i != index
        self._bring(self._viewer.scene.camera("train", index), self._viewer.distance)
        self._at_photograph = True

    def _on_click(self, event: Any) -> None:
        # Viser reports a click on a training camera a second time, as a click on the scene.
        if time.monotonic() - self._visited > 0.5:
            ray = np.array(event.ray_origin), np.array(event.ray_direction)
            self._viewer.later("finding that surface", lambda: self._aim_at(*ray), self._say)

    def _on_pixel(self, _: Any) -> None:
        scene = self._viewer.scene
        view = scene.names["train"].index(self._photograph.value)
        try:
            pixel = pinhole_pixel(scene, view, self._pixel.value, given="")
        except CameraError as error:
            self._say(f"The pixel {error}.")
            return
        camera, at = scene.own_camera("train", view), jnp.asarray(pixel, jnp.float32)
        start = np.asarray(camera.position)
        ray = start, np.asarray(pixels_to_points(camera, at, jnp.float32(1))) - start
        self._viewer.later("finding that surface", lambda: self._aim_at(*ray), self._say)

    def _on_back(self, _: Any) -> None:
        """Go back to the close-up before this one, or before the visit to a photograph."""
        visiting = self._at_photograph
        if len(self._history) < (1 if visiting else 2):
            self._say("There is no earlier close-up.")
            return
        if not visiting:
            self._history.pop()
            self._aim = None  # the slider moves along the ray of the newest click alone
        self._bring(*self._history[-1])

    def _on_tune(self, _: Any) -> None:
        tune = functools.partial(self._render_window, tuned=True)
        self._viewer.later("fine-tuning for this camera", tune, self._say)

    def _on_download(self, _: Any) -> None:
        self._viewer.later("rendering at the photographs' size", self._download, self._say)

    def _download(self) -> str:
        viewer, prepared = self._viewer, self._prepared
        camera = self._own_camera(viewer.scene.own_camera("train", 0))
        if prepared is None:
            prepared = viewer.prepare(camera, tuned=False, say_steps=self._say_steps)
        shown, detail = self._shown.value, self._sharpen.value
        picture, _ = viewer.look(prepared, camera, detail=detail, shown=shown)
        name = f"{viewer.title.replace(', ', '_')}.png"
        self._client.send_file_download(name, encode_png(picture), save_immediately=True)
        return f"Sent {camera.width} x {camera.height} pixels"

    def _aim_at(self, origin: np.ndarray, direction: np.ndarray) -> str:
        """Come near to the first surface along a ray."""
        best, point, shown = self._viewer.find_surface(origin, direction)
        scene = self._viewer.scene
        self._aim = scene.camera("train", best), point
        self._history.append(self._place() or (self._own_camera(), 1.0))
        prepared = self._viewer.prepare(self._own_camera(), tuned=False, say_steps=self._say_steps)
        if self._automatic.value:
            self._show(prepared, self._own_camera())
        return f"{shown}; this close-up starts from {scene.names['train'][best]}"

    def _place(self) -> tuple[Camera, float] | None:
        """Move as near to the point as the slider says; return the camera, and how far it is."""
        aim = self._aim  # read once: another thread may reset it
        if aim is None:
            return None
        source, point = aim
        camera = closeup_camera(source, point, self._nearer.value)
        distance = float(np.linalg.norm(point - np.asarray(camera.position)))
        self._bring(camera, distance)
        return camera, distance

    def _own_camera(self, like: Camera | None = None) -> Camera:
        """Return the visitor's camera, with the window's size or that of another camera."""
        camera = self._client.camera
        if like is None:
            asked = camera.image_width, camera.image_height
            self._size = width, height = window_size(*asked, self._size)
            like = self._viewer.scene.camera("train", 0).replace(width=width, height=height)
        rotation = SO3(camera.wxyz).as_matrix()
        return viewer_camera(rotation, camera.position, camera.fov, like)

    def _bring(self, camera: Camera, distance: float) -> None:
        """Move the visitor to a camera; dragging then orbits a point `distance` ahead."""
        position, forward = np.asarray(camera.position), np.asarray(camera.rotation)[:, 2]
        client, self._at_photograph = self._client, False
        with client.atomic():
            client.camera.position = position
            client.camera.look_at = position + distance * forward
            client.camera.wxyz = quaternion(camera)
            client.camera.fov = vertical_fov(camera)
            client.camera.near, client.camera.far = distance / 100, 1000 * distance
