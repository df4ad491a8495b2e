"""Lens distortion: resample photographs to a pinhole camera.

The formulas are OpenCV's, which COLMAP, nerfstudio and instant-ngp share. Intrinsics follow our
convention (the center of the top-left pixel is (0.5, 0.5)); OpenCV puts pixel centers at integers,
so `undistortion_map` subtracts half a pixel from the principal point.
"""

import math
from typing import Any, NamedTuple

import cv2
import numpy as np

from jaxcloseup.captures.json_fields import number
from jaxcloseup.photos.scene import SceneError


# The coefficients that each model reads, by their names in files; any other must be 0.
_RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3")
_PERSPECTIVE = {
    **dict.fromkeys(("PINHOLE", "SIMPLE_PINHOLE", "OPENCV"), _RADIAL_TANGENTIAL),
    **dict.fromkeys(("SIMPLE_RADIAL", "RADIAL"), _RADIAL_TANGENTIAL),
    "FULL_OPENCV": (*_RADIAL_TANGENTIAL, "k4", "k5", "k6"),
}
_FISHEYE = {"FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
_FISHEYE |= {"OPENCV_FISHEYE"}
_STOP = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-9  # of solving for a direction
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


class Distortion(NamedTuple):
    """Lens distortion as a hashable record."""

    fisheye: bool  # True if the image radius follows the angle off the axis, not its tangent
    # in OpenCV's order k1, k2, p1, p2, k3, k4, k5, k6; for a fisheye k1, k2, k3, k4
    coefficients: tuple[float, ...]


class Remap(NamedTuple):
    """For each pinhole pixel `[H, W]`, its position in the distorted photograph."""

    x: np.ndarray  # float32 columns; pixel centers are integers, as in OpenCV
    y: np.ndarray  # float32 rows, likewise
    inside: np.ndarray  # bool, whether the distorted photograph shows the pixel


def read_distortion(label: str, lens: dict[str, Any]) -> Distortion | None:
    """Read the distortion that a lens's fields describe, or None for a pinhole.

    Args:
      label: name of the lens in error messages.
      lens: optional fields `camera_model`, `is_fisheye` and the coefficients.

    Raises:
      SceneError: the camera model or a non-zero coefficient is not supported.
    """
    model = lens.get("camera_model", "OPENCV")
    name = str(model).upper()
    given = {key: number(label, key, lens[key]) for key in COEFFICIENTS if key in lens}
    if name not in _PERSPECTIVE and name not in _FISHEYE:
        raise SceneError(
            f"{label}: lens distortion (camera_model {model!r}) is not supported: undistort the "
            "photographs to a pinhole camera first."
        )
    fisheye = name in _FISHEYE or bool(lens.get("is_fisheye"))
    known = ("k1", "k2", "k3", "k4") if fisheye else _PERSPECTIVE[name]
    strange = [key for key, value in given.items() if value and key not in known]
    if strange:
        # Programs do not agree on what k4 multiplies: r^8, or r^2 in a denominator.
        kind = "OPENCV_FISHEYE" if fisheye else name
        hint = "set FULL_OPENCV if you mean OpenCV's rational model, or " if not fisheye else ""
        raise SceneError(
            f"{label}: lens distortion (non-zero {', '.join(strange)}) is not supported with "
            f"{kind}: {hint}undistort the photographs to a pinhole camera first."
        )
    if not fisheye and not any(given.values()):
        return None
    order = known if fisheye else (*_RADIAL_TANGENTIAL, "k4", "k5", "k6")
    return Distortion(fisheye, tuple(given.get(key, 0.0) for key in order))


def undistortion_map(
    distortion: Distortion, intrinsics: tuple[float, float, float, float], width: int, height: int
) -> Remap:
    """Compute where each pixel of a pinhole photograph lies in the distorted one.

    Both photographs have the same size and intrinsics.

    Args:
      distortion: distortion of the lens.
      intrinsics: fx, fy, cx, cy in pixels.
      width: image width in pixels.
      height: image height in pixels.
    """
    fx, fy, cx, cy = intrinsics
    matrix, coefficients = _matrix(np.array(intrinsics)), np.array(distortion.coefficients)
    fisheye, perspective = cv2.fisheye.initUndistortRectifyMap, cv2.initUndistortRectifyMap
    make = fisheye if distortion.fisheye else perspective
    x, y = make(matrix, coefficients, np.eye(3), matrix, (width, height), cv2.CV_32FC1)
    inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    across = (np.arange(width) + 0.5 - cx) / fx
    down = (np.arange(height) + 0.5 - cy) / fy
    radius = np.hypot(across[None, :], down[:, None])
    return Remap(x, y, inside & (radius < _fold(distortion, float(radius.max()))))


def to_pinhole(
    distortion: Distortion, intrinsics: np.ndarray, pixel: tuple[float, float]
) -> tuple[float, float]:
    """Return where a pinhole photograph shows what the distorted one has at a pixel (x, y).

    Both photographs have the same intrinsics (fx, fy, cx, cy). What no pinhole camera sees gives
    NaN, or a pixel far outside.
    """
    matrix, coefficients = _matrix(intrinsics), np.array(distortion.coefficients)
    given = np.array([[pixel]]) - 0.5
    if distortion.fisheye:
        found = cv2.fisheye.undistortPoints(given, matrix, coefficients, P=matrix)
    else:
        found = cv2.undistortImagePoints(given, matrix, coefficients, None, _STOP)
    x, y = (found.ravel() + 0.5).tolist()
    fx, fy, cx, cy = intrinsics
    radius = math.hypot((x - cx) / fx, (y - cy) / fy)
    return (x, y) if radius < _fold(distortion, max(2 * radius, 1.0)) else (math.nan, math.nan)


def from_pinhole(
    distortion: Distortion, intrinsics: np.ndarray, pixel: tuple[float, float]
) -> tuple[float, float]:
    """Return where the distorted photograph shows what a pinhole one has at a pixel (x, y)."""
    fx, fy, cx, cy = intrinsics
    matrix, coefficients = _matrix(intrinsics), np.array(distortion.coefficients)
    flat = (pixel[0] - cx) / fx, (pixel[1] - cy) / fy
    if distortion.fisheye:
        found = cv2.fisheye.distortPoints(np.array([[flat]]), matrix, coefficients)
    else:
        still = np.zeros(3)
        found, _ = cv2.projectPoints(np.array([[[*flat, 1]]]), still, still, matrix, coefficients)
    return float(found[0, 0, 0]) + 0.5, float(found[0, 0, 1]) + 0.5


def _matrix(intrinsics: np.ndarray) -> np.ndarray:
    """Return OpenCV's matrix of intrinsics, in which centers of pixels are integers."""
    fx, fy, cx, cy = map(float, intrinsics)
    return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])


def undistort(image: np.ndarray, mask: np.ndarray, remap: Remap) -> tuple[np.ndarray, np.ndarray]:
    """Resample a photograph `[H, W, 3]` and its mask `[H, W]`, both uint8, to a pinhole camera.

    Pixels outside the distorted photograph get mask 0 and the colors of its border.
    """
    # Cubic, because close-ups need the detail that bilinear averaging removes.
    image = cv2.remap(image, remap.x, remap.y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    mask = cv2.remap(mask, remap.x, remap.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return image, np.where(remap.inside, mask, 0).astype(np.uint8)


def _fold(distortion: Distortion, largest: float) -> float:
    """Find the radius at which the radial polynomial stops growing, or infinity.

    Beyond it, directions that the lens never saw would land inside the photograph again.
    """
    radius = np.linspace(0, largest, 4096)
    if distortion.fisheye:
        angle = np.arctan(radius)
        k1, k2, k3, k4 = distortion.coefficients
        bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
    else:
        k1, k2, _, _, k3, k4, k5, k6 = distortion.coefficients
        square = radius**2
        above, below = np.polyval([k3, k2, k1, 1], square), np.polyval([k6, k5, k4, 1], square)
        bent = radius * above / np.where(below > 0, below, -1)  # past a pole counts as folded
    back = np.flatnonzero(np.diff(bent) <= 0)
    return float(radius[back[0]]) if len(back) else np.inf
