"""Building blocks of the built-in scenes: solids with finishes, lamps and a camera rig.

World units are meters and z is up. Sizes are full extents (diameters, not radii).
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jaxcloseup.drawn_scenes.lighting import Ambience, Lamp
from jaxcloseup.drawn_scenes.raycast import BOX, CYLINDER, FACES_OF, PLANE, SPHERE


class Finish(NamedTuple):
    """The material of a face."""

    texture: str  # name of the color texture
    # meters per repeat of the texture; None stretches `region` once over the face
    size: float | None = None
    detail: str = "plain"  # name of the texture of fine structure
    detail_size: float = 0.2  # meters per repeat of the detail
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)  # RGB factor on the color
    gloss: float = 0.0  # strength of the highlight
    grain: bool = False  # whether to align the texture with the longer side of the face
    shines: bool = False  # whether the face shows its own color, without light or shadow
    # (left, top, right, bottom) part of the texture, in [0, 1]
    region: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)


class Solid(NamedTuple):
    """A solid before assembly."""

    kind: int  # PLANE, BOX, SPHERE or CYLINDER
    center: np.ndarray  # `[3]` center in the world
    size: np.ndarray  # `[3]` full extents in meters
    rotation: np.ndarray  # `[3, 3]` rotation from the solid to the world
    taper: float  # growth of a cylinder's radius with local z, in (-1, 1)
    finishes: tuple[Finish, ...]  # finish of each face
    texel: float  # side of a baked light texel in meters


class Rig(NamedTuple):
    """The positions of the far cameras, and the subjects of close-ups."""

    target: tuple[float, float, float]  # (x, y, z) point that the far cameras look at
    distance: tuple[float, float]  # (lo, hi) meters between the cameras and the target
    azimuth: tuple[float, float]  # (lo, hi) degrees about z; 0 is straight in front, at -y
    elevation: tuple[float, float]  # (lo, hi) degrees above the horizon
    # (x, y, z, radius) balls that hold the subjects of close-ups
    interests: tuple[tuple[float, float, float, float], ...]
    photographs: int = 60  # number of training photographs
    magnification: tuple[float, float] = (2.1, 7.6)  # (lo, hi) of close-ups


class Model(NamedTuple):
    """A scene before rendering: its solids, its light and its camera rig."""

    solids: list[Solid]
    lamps: list[Lamp]  # the first one makes the highlight
    ambience: Ambience
    rig: Rig


def turn(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """Return the rotation matrix `[3, 3]` by degrees about x, then y, then z."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.deg2rad([x, y, z])):
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        step = np.eye(3)
        step[i, i] = step[j, j] = np.cos(angle)
        step[j, i], step[i, j] = np.sin(angle), -np.sin(angle)
        matrix = step @ matrix
    return matrix


def _solid(
    kind: int,
    center: ArrayLike,
    size: ArrayLike,
    finish: Finish,
    *,
    rotation: np.ndarray | None,
    texel: float,
    taper: float = 0.0,
    faces: Mapping[int, Finish] | None = None,
) -> Solid:
    finishes = [finish] * FACES_OF[kind]
    for face, other in (faces or {}).items():
        finishes[face] = other
    rotation = np.eye(3) if rotation is None else rotation
    center, size = np.asarray(center, float), np.asarray(size, float)
    return Solid(kind, center, size, rotation, taper, tuple(finishes), texel)


def box(
    center: ArrayLike,
    size: ArrayLike,
    finish: Finish,
    *,
    rotation: np.ndarray | None = None,
    texel: float = 0.03,
    faces: Mapping[int, Finish] | None = None,
) -> Solid:
    """Model a box; `faces` overrides the finish of sides 0..5 = -x, +x, -y, +y, -z, +z."""
    return _solid(BOX, center, size, finish, rotation=rotation, texel=texel, faces=faces)


def block(low: ArrayLike, high: ArrayLike, finish: Finish, **options: Any) -> Solid:
    """Model a box between two corners, with the options of `box`."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    return box((low + high) / 2, high - low, finish, **options)


def sphere(
    center: ArrayLike,
    size: ArrayLike,
    finish: Finish,
    *,
    rotation: np.ndarray | None = None,
    texel: float = 0.03,
) -> Solid:
    """Model a sphere of diameter `size`, or an ellipsoid with three diameters."""
    diameters = np.broadcast_to(size, 3)
    return _solid(SPHERE, center, diameters, finish, rotation=rotation, texel=texel)


def cylinder(
    base: ArrayLike,
    height: float,
    bottom: float,
    top: float,
    finish: Finish,
    *,
    rotation: np.ndarray | None = None,
    texel: float = 0.03,
    faces: Mapping[int, Finish] | None = None,
) -> Solid:
    """Model a cylinder or cone on `base`, diameters `bottom`, `top`; faces: side, bottom, top."""
    rotation = np.eye(3) if rotation is None else rotation
    center = np.asarray(base, float) + rotation @ [0, 0, height / 2]
    size, taper = ((bottom + top) / 2, (bottom + top) / 2, height), (top - bottom) / (top + bottom)
    return _solid(
        CYLINDER, center, size, finish, rotation=rotation, texel=texel, taper=taper, faces=faces
    )


def rod(
    start: ArrayLike, end: ArrayLike, thickness: float, finish: Finish, *, texel: float = 0.03
) -> Solid:
    """Model a thin round bar from `start` to `end`."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    axis = (end - start) / np.linalg.norm(end - start)
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    rotation = np.stack([across, np.cross(axis, across), axis], axis=1)
    length = float(np.linalg.norm(end - start))
    return cylinder(start, length, thickness, thickness, finish, rotation=rotation, texel=texel)


def sheet(
    center: ArrayLike,
    size: tuple[float, float],
    finish: Finish,
    *,
    facing: str = "+z",
    rotation: np.ndarray | None = None,
    texel: float = 0.03,
) -> Solid:
    """Model a flat rectangle (width, height) that faces along an axis, upright from there."""
    frames = {
        "+z": np.eye(3), "-z": turn(x=180),
        "-y": turn(x=90), "+y": turn(x=90, z=180), "-x": turn(x=90, z=-90), "+x": turn(x=90, z=90),
    }  # fmt: skip
    frame = frames[facing] if rotation is None else rotation @ frames[facing]
    return _solid(PLANE, center, (*size, 1.0), finish, rotation=frame, texel=texel)
