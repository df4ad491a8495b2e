"""Bounds on what a capture's numbers may be beside each other, since they are stored as float32.

They are far beyond any lens and any scene. What exceeds them is a mistake in a file.
"""

import warnings
from collections.abc import Sequence

import numpy as np

from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.io.placement import Placement
from jaxcloseup.photos.scene import PointsWarning, SceneError


FOCAL = (0.01, 1e4)  # focal length in multiples of the photograph's longer side
CENTER = 100  # distance of the principal point from the middle, likewise
LENGTH = 1e12  # any distance, and 1 / the smallest one: squares and cubes stay finite
STRAY = 1e5  # distance of points from the cameras, in multiples of the cameras' spread or median


def check_lens(label: str, intrinsics: np.ndarray, width: int, height: int) -> None:
    """Raise unless fx, fy, cx, cy `[4]`, in pixels, fit a photograph of this size."""
    side, (low, high) = max(width, height), FOCAL
    for focal in intrinsics[:2]:
        if not low * side <= focal <= high * side:
            raise SceneError(
                f"{label}: a focal length of {focal:.4g} pixels is not between {low:g} and "
                f"{high:g} times the longer side of {width} x {height} pixels: correct it."
            )
    x, y = intrinsics[2:]
    if max(abs(x - width / 2), abs(y - height / 2)) > CENTER * side:
        raise SceneError(
            f"{label}: the principal point {x:.4g}, {y:.4g} lies more than {CENTER} times the "
            f"longer side outside {width} x {height} pixels: correct cx and cy."
        )


def check_positions(frames: Sequence[Frame], placement: Placement) -> None:
    """Raise if a camera of a capture is absurdly far away, in a scene that lies there."""
    positions = placement.to_scene(np.stack([frame.camtoworld[:, 3] for frame in frames]))
    away = np.abs(positions).max(-1)
    worst = int(np.argmax(away))
    if not away[worst] <= LENGTH:
        raise SceneError(
            f"{frames[worst].label}: its camera lies {away[worst] / placement.scale:.3g} from "
            f"{'the origin' if placement.scale == 1 else 'the others'}: correct its pose."
        )


def plausible(label: object, points: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Check that points are finite as float32 and not absurdly far; warn of others.

    Points are too far at `STRAY` times the cameras' spread, or their own median distance if that is
    larger, so that cameras at one place keep their points.

    Args:
      label: what holds the points.
      points: `[P, 3]` world points, P may be 0.
      positions: `[V, 3]` positions of cameras.

    Returns:
      `[P]` bool.
    """
    center = np.median(positions, 0)
    finite = (np.abs(points) <= np.finfo(np.float32).max).all(-1)
    away = np.abs(np.where(finite[:, None], points, 0) - center).max(-1)
    usual = np.median(away[finite]) if finite.any() else 0.0
    # Divided, because a product could be too large for a float.
    keep = finite & (away / STRAY <= max(usual, np.abs(positions - center).max()))
    if not keep.all():
        warnings.warn(
            f"{label}: {np.sum(~keep)} of {len(keep)} points are not finite, or {STRAY:g} times "
            "farther from the cameras than is usual, and were dropped.",
            PointsWarning,
            stacklevel=2,
        )
    return keep
