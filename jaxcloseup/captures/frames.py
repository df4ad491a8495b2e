"""A photograph before it is read: where it lies, its camera and its lens."""

import math
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.captures.distortion import Distortion
from jaxcloseup.captures.json_fields import number
from jaxcloseup.scene import SceneError


class Frame(NamedTuple):
    """One listed photograph, not yet read.

    Attributes:
      source: the file that lists it.
      listed: its `file_path`, as written there.
      file: the image.
      mask: its mask, or None.
      camtoworld: `[3, 4]` float64, OpenCV.
      size: (width, height) that the intrinsics belong to, or None for the image's own.
      lens: this frame's own fields about the lens, then those of the whole file.
      distortion: of the lens, or None for a pinhole.
      seen: indices of the capture's points that it shows, or None where the format does not say.
      reduced: the same image, reduced before, which is read in its place; or None.
    """

    source: pathlib.Path
    listed: str
    file: pathlib.Path
    mask: pathlib.Path | None
    camtoworld: np.ndarray
    size: tuple[int, int] | None
    lens: tuple[dict[str, Any], dict[str, Any]]
    distortion: Distortion | None = None
    seen: np.ndarray | None = None
    reduced: pathlib.Path | None = None

    @property
    def label(self) -> str:
        """How messages name it."""
        return f"{self.source}: frame {self.listed!r}"


def frame_intrinsics(
    frame: Frame, width: int, height: int, *, half_pixel: bool = False
) -> np.ndarray:
    """fx, fy, cx, cy `[4]` float64 in pixels of an image of `width` x `height`.

    Focal lengths win over angles, and a frame's own fields over the file's. Pixels are square and
    the principal point is the middle of the image where nothing else is said. `half_pixel` is for
    files with integer pixel centers: it moves the principal point that they give by +0.5.
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


def check_photographs(path: pathlib.Path, frames: Sequence[Frame]) -> None:
    """Complain in one sentence of all photographs that `path` lists and that do not exist."""
    missing = [frame.listed for frame in frames if not frame.file.is_file()]
    if missing:
        first = ", ".join(missing[:3]) + (", ..." if len(missing) > 3 else "")
        raise SceneError(
            f"{path}: {len(missing)} of {len(frames)} listed images do not exist ({first}): "
            "restore them or drop their frames."
        )


def _focal(label: str, lens: dict[str, Any], width: int, height: int) -> tuple[float, float] | None:
    def one(keys: tuple[str, str], angle: str, side: int) -> float | None:
        for key in keys:
            if key in lens:
                return number(label, key, lens[key], above=0)
        if angle not in lens:
            return None
        radians = number(label, angle, lens[angle], above=0)
        if radians >= math.pi:
            raise SceneError(f"{label}: {angle} must be in radians, below pi, got {radians}.")
        return side / 2 / math.tan(radians / 2)

    x = one(("fx", "fl_x"), "camera_angle_x", width)
    y = one(("fy", "fl_y"), "camera_angle_y", height)
    if x is None and y is None:
        return None
    return (y if x is None else x), (x if y is None else y)
