"""Move a capture to the origin and scale it to one size, so that its unit and origin do not matter.

Programs may then have lengths that suit scenes of about this size, such as floors and planes in
front of cameras, and float32 resolves positions everywhere in a scene.
"""

from collections.abc import Sequence

import numpy as np

from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.io.placement import Placement


SIZE = 3.5  # about what COLMAP gives a capture; settings with lengths were chosen there
_ITERATIONS = 100
_ROUNDING = 1e-12  # of coordinates; cameras closer to each other stand in one place


def find_placement(positions: np.ndarray, points: np.ndarray) -> Placement:
    """Return the shift and scale that give a capture its middle at 0 and its size `SIZE`.

    The middle is the geometric median of the cameras, and the size their median distance from it.
    Both follow a capture that is moved, turned or scaled, and a few stray cameras hardly change
    them. The scale is exact instead of a power of two, so that a capture in any unit becomes the
    same numbers, up to rounding.

    Args:
      positions: `[V, 3]` float64 positions of all cameras, whatever their split, so that every
        split has the same coordinates.
      points: `[P, 3]` points, P may be 0: they give the size of cameras that stand in one place.
        Without them such a capture has no size, and keeps its unit.
    """
    center = positions.mean(axis=0)
    smallest = _ROUNDING * np.abs(positions).max() + np.finfo(np.float32).tiny
    for _ in range(_ITERATIONS):  # Weiszfeld's algorithm
        weight = 1 / np.maximum(_distances(positions, center), smallest)
        center = (weight[:, None] * positions).sum(axis=0) / weight.sum()
    spread = np.median(_distances(positions, center))
    reach = np.median(_distances(points, center)) if len(points) else 0.0
    if spread <= max(smallest, 1e-6 * reach):
        spread = reach if reach > smallest else SIZE
    return Placement(center, float(SIZE / spread))


def place(frames: Sequence[Frame], placement: Placement) -> list[Frame]:
    """Return frames of a capture in the coordinates of its scene."""
    return [
        frame._replace(camtoworld=placement.poses_to_scene(frame.camtoworld)) for frame in frames
    ]


def describe_offset(name: str, placement: Placement) -> list[str]:
    """Return a sentence if files of float32 leave out a shift of a capture's coordinates."""
    if not placement.offset.any():
        return []
    shift = ", ".join(f"{value:.15g}" for value in placement.offset)
    return [f"{name}: its origin is far away, so PLY files get its coordinates minus {shift}"]


def _distances(points: np.ndarray, center: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points - center, axis=-1)
