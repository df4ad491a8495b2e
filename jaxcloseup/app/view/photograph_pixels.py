"""Pixels of photographs as their files show them, and as a pinhole camera would.

Photographs are read without their lens's distortion. Who points at a pixel has the file before
their eyes, in which it lies elsewhere: by 1 % of the width at the corners of a phone's photograph.
"""

import numpy as np

from jaxcloseup.app.view.camera_paths import CameraError, check_pixel
from jaxcloseup.captures.distortion import Distortion, from_pinhole, to_pinhole
from jaxcloseup.photos.scene import Scene


Pixel = tuple[float, float]
_ROUNDING = 1e-3  # of pixels that were divided, or distorted and back


def pinhole_pixel(scene: Scene, view: int, pixel: Pixel, *, given: str = "--pixel=") -> Pixel:
    """Return where the camera of a training photograph sees what its file has at a pixel (x, y).

    `given` is how the pixel was given, up to its numbers.

    Raises:
      CameraError: the pixel is outside the photograph, or is cut off with the distortion.
    """
    camera, distortion = scene.own_camera("train", view), _distortion(scene, view)
    check_pixel(camera, pixel, given=given)
    if distortion is None:
        return pixel
    x, y = to_pinhole(distortion, np.asarray(camera.intrinsics), pixel)
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise CameraError(
            f"{given}{pixel[0]:g},{pixel[1]:g} is cut off where the distortion of the lens is "
            "undone: choose a pixel nearer to the middle"
        )
    return x, y


def file_pixel(scene: Scene, view: int, pixel: Pixel) -> tuple[int, int]:
    """Return the column and row in a training photograph's file of its camera's pixel (x, y)."""
    distortion = _distortion(scene, view)
    if distortion is not None:
        intrinsics = np.asarray(scene.own_camera("train", view).intrinsics)
        pixel = from_pinhole(distortion, intrinsics, pixel)
    x, y = pixel
    return int(x + _ROUNDING), int(y + _ROUNDING)


def _distortion(scene: Scene, view: int) -> Distortion | None:
    """Return what of a training photograph's lens was undone in reading, if anything."""
    known = scene.metadata.get("distortions")
    return known["train"][view] if known else None
