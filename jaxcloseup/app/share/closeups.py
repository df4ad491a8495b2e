"""Close-ups at pixels of photographs: cameras, pictures, and what can be said of them."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.exposed import expose
from jaxcloseup.app.run.kept_detail import detailed
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.share.places import Place
from jaxcloseup.app.view.camera_paths import CameraError, resized
from jaxcloseup.app.view.photograph_pixels import file_pixel
from jaxcloseup.app.view.picking import closeup_camera, surface_depth
from jaxcloseup.artifacts.images import color_errors, to_uint8
from jaxcloseup.detail.add import Detail
from jaxcloseup.geometry.cameras import Camera, pixels_to_points
from jaxcloseup.training.state import TrainState


_SMALL = 480  # width in pixels of close-ups that are compared
_UNKNOWN = 0.3  # error of what no photograph shows
_DOUBT = 0.05  # least trust of what is compared, so that something is chosen


class CloseUp(NamedTuple):
    """A finished close-up."""

    name: str  # of its files: the photograph, the pixel and how many times nearer
    camera: Camera
    point: np.ndarray  # `[3]` surface at the pixel, which is in the middle
    picture: np.ndarray  # uint8 `[H, W, 3]`
    error: np.ndarray  # uint8 `[H, W, 3]`, colors of the expected error
    said: str  # where it is
    said_of_error: str  # by how much colors may be off


def make_closeups(
    programs: Programs, state: TrainState, detail: Detail, places: Sequence[Place], *, near: float
) -> list[CloseUp]:
    """Render close-ups with detail, as large as the photographs whose pixels they are of.

    Args:
      programs: the run's compiled programs.
      state: the state to render.
      detail: of the state.
      places: pixels of photographs.
      near: how many times nearer than the photograph.

    Raises:
      CameraError: the state shows no surface at a pixel.
    """

    def make(place: Place) -> CloseUp:
        return _closeup(programs, state, detail, place, near)

    cameras = [programs.scene.own_camera("train", place.view) for place in places]
    pixels = max((camera.height * camera.width for camera in cameras), default=1)
    return list(progress.each(make, places, "close-ups", pixels=pixels))


def choose_places(
    programs: Programs,
    state: TrainState,
    detail: Detail,
    places: Sequence[Place],
    *,
    near: float,
    count: int,
) -> list[Place]:
    """Return the places whose small close-ups have most contrast that photographs confirm.

    Contrast counts as far as detail is trusted, beside the expected error: where depth is rough,
    photographs are torn to fine swirls that are not there.

    Arguments are as for `make_closeups`; places without a surface are left out.
    """

    def merit(place: Place) -> float:
        photograph = programs.scene.own_camera("train", place.view)
        photograph = resized(photograph, min(_SMALL, photograph.width), None)
        try:
            camera, _ = _look(programs, state, photograph, place, near)
        except CameraError:
            return 0.0
        sharper = detailed(programs, detail, camera, programs.render(state, camera))
        gray = np.asarray(sharper.rgb).mean(axis=-1)
        fine = np.abs(gray - cv2.GaussianBlur(gray, (0, 0), 2))
        fine = fine * np.maximum(np.asarray(sharper.weight), _DOUBT)
        return float(fine.mean() / np.mean(np.nan_to_num(np.asarray(sharper.error), nan=_UNKNOWN)))

    merits = list(progress.each(merit, places, "places to look at"))
    best = sorted(range(len(places)), key=lambda i: -merits[i])[:count]
    return [places[i] for i in best if merits[i] > 0]


def _closeup(
    programs: Programs, state: TrainState, detail: Detail, place: Place, near: float
) -> CloseUp:
    scene = programs.scene
    photograph, name = scene.own_camera("train", place.view), scene.names["train"][place.view]
    at = place.x * photograph.width, place.y * photograph.height
    x, y = file_pixel(scene, place.view, at)
    try:
        camera, point = _look(programs, state, photograph, place, near)
    except CameraError:
        raise CameraError(
            f"--at={name}:{x},{y}: there is no surface at this pixel: choose another pixel"
        ) from None
    seen = programs.render(state, camera)
    sharper = detailed(programs, detail, camera, seen)
    error = np.asarray(sharper.error)
    shown = np.isfinite(error)
    said = f"{near:g} times nearer than {name}, at its pixel {x}, {y}"
    off = f"{np.mean(error[shown]):.3f}" if shown.any() else "unknown"
    return CloseUp(
        f"{name}_{x}_{y}_{near:g}x".replace("/", "_"),
        camera,
        point,
        to_uint8(expose(programs, sharper.rgb, seen)),
        color_errors(sharper.error)[0],
        said,
        f"Expected error of colors: {off} of 1 on average; photographs show {shown.mean():.0%} of "
        "the picture",
    )


def _look(
    programs: Programs, state: TrainState, photograph: Camera, place: Place, near: float
) -> tuple[Camera, np.ndarray]:
    """Return the camera of a close-up, and the point `[3]` in its middle.

    Raises:
      CameraError: the state shows no surface there.
    """
    pixel = place.x * photograph.width, place.y * photograph.height
    render = functools.partial(programs.render, state)
    depth = surface_depth(render, photograph, pixel, far=programs.scene.far)
    if not depth > 0:
        raise CameraError("no surface")
    at = jnp.array(pixel, jnp.float32)
    point = np.asarray(pixels_to_points(photograph, at, jnp.float32(depth)))
    return closeup_camera(photograph, point, near), point
