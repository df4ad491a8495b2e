"""`Frame`: the files, camera and lens of a photograph that is not decoded yet."""

import math
import pathlib
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.captures.distortion import Distortion
from jaxcloseup.captures.json_fields import number
from jaxcloseup.photos.scene import SceneError


class Frame(NamedTuple):
    """A listed photograph that is not decoded yet."""

    source: pathlib.Path  # file that lists the photograph
    listed: str  # path of the photograph as written in `source`
    file: pathlib.Path  # path of the image
    mask: pathlib.Path | None  # path of the mask
    camtoworld: np.ndarray  # `[3, 4]` float64 OpenCV pose
    # (width, height) that the intrinsics refer to; None means the image's own size
    size: tuple[int, int] | None
    # lens fields of this frame, then those of the whole file
    lens: tuple[dict[str, Any], dict[str, Any]]
    distortion: Distortion | None = None  # None for a pinhole
    # indices of the capture's points that the photograph shows; None if unknown
    seen: np.ndarray | None = None
    # path of an already shrunk copy to read instead of `file`, or None
    reduced: pathlib.Path | None = None
    # quarter turns counterclockwise of the image after reading; the camera is of the turned one
    turns: int = 0

    @property
    def label(self) -> str:
        """Name of the frame in error messages."""
        return f"{self.source}: frame {self.listed!r}"


def frame_intrinsics(
    frame: Frame, width: int, height: int, *, half_pixel: bool = False
) -> np.ndarray:
    """Compute fx, fy, cx, cy `[4]` float64 in pixels of an image of `width` x `height`.

    Focal lengths win over angles of view, and a frame's own fields win over the file's. By default
    pixels are square and the principal point is the middle of the image. `half_pixel` is for files
    with integer pixel centers: it adds 0.5 to the principal point that they give.

    Raises:
      SceneError: a field is wrong, or no field gives a focal length.
    """
    for lens in frame.lens:
        focal = _focal(frame.label, lens, width, height)
        if focal:
            break
    else:
        raise SceneError(f"{frame.label}: no focal length: give fl_x (or fx) or camera_angle_x.")
    lens = {**frame.lens[1], **frame.lens[0]}
    center = [
        number(frame.label, key, lens[key]) + 0.5 * half_pixel if key in lens else side / 2
        for key, side in (("cx", width), ("cy", height))
    ]
    return np.array([*focal, *center])


def _focal(label: str, lens: dict[str, Any], width: int, height: int) -> tuple[float, float] | None:
    def along(keys: tuple[str, str], angle: str, side: int) -> float | None:
        for key in keys:
            if key in lens:
                return number(label, key, lens[key], above=0)
        if angle not in lens:
            return None
        radians = number(label, angle, lens[angle], above=0)
        if radians >= math.pi:
            raise SceneError(f"{label}: {angle} must be in radians, below pi, got {radians}.")
        return side / 2 / math.tan(radians / 2)

    x = along(("fx", "fl_x"), "camera_angle_x", width)
    y = along(("fy", "fl_y"), "camera_angle_y", height)
    if x is None or y is None:
        focal = y if x is None else x
        return None if focal is None else (focal, focal)
    return x, y
