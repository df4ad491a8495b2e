"""Correct known mistakes of captures, such as poses that are inverted.

A correction is a text, so that a run can record it:

    axes            the cameras' y and z axes point the other way (OpenGL's in place of OpenCV's)
    inverse         the file's matrices are world-to-camera in place of camera-to-world
    order=2,0,1     photograph i has the pose of photograph 2, 0, 1, ... in the file's order
    turn=1          photographs are turned back by so many quarter turns, counterclockwise
    size=2          intrinsics are of photographs so many times as large as stated
    focal=0.5       focal lengths are multiplied
    center=0.1,0    the principal point moves by so many widths and heights
    points=none     the capture's points are not used
    points=x,z,-y   the points' new coordinates in terms of those in the file
"""

from collections.abc import Callable, Sequence

import numpy as np

from jaxcloseup.captures.photo_files import size_of_image
from jaxcloseup.captures.world_frames import Frame, frame_intrinsics
from jaxcloseup.photos.scene import SceneError


_FLIP = np.diag([1.0, -1, -1])


def correct_poses(poses: np.ndarray, correction: str, *, opengl: bool) -> np.ndarray:
    """Apply a correction of poses; others return them as they are.

    Args:
      poses: `[V, 3, 4]` OpenCV poses, as they were read.
      correction: the correction.
      opengl: whether the files' matrices have OpenGL's axes, as transforms.json has.
    """
    name, _, value = correction.partition("=")
    if name == "axes":
        return _with_axes(poses, _FLIP)
    if name == "inverse":
        axes = _FLIP if opengl else np.eye(3)
        return _with_axes(_inverse(_with_axes(poses, axes)), axes)
    if name == "order":
        return poses[[int(i) for i in value.split(",")]]
    return poses


def correct_points(points: np.ndarray, correction: str) -> np.ndarray:
    """Apply a correction of points `[P, 3]`; others return them as they are."""
    name, _, value = correction.partition("=")
    if name != "points":
        return points
    return points[:0] if value == "none" else points @ axes_matrix(value).T


def axes_matrix(axes: str) -> np.ndarray:
    """Return the matrix `[3, 3]` of `x,z,-y`, whose rows give the new coordinates."""
    rows = [part.strip() for part in axes.split(",")]
    matrix = np.zeros((3, 3))
    for i, part in enumerate(rows):
        matrix[i, "xyz".index(part.lstrip("-"))] = -1 if part.startswith("-") else 1
    return matrix


def correct_frames(
    frames: Sequence[Frame], corrections: Sequence[str], *, opengl: bool
) -> list[Frame]:
    """Apply corrections, in their order, to all photographs of a capture.

    Args:
      frames: the capture's photographs in the order of its file.
      corrections: the corrections.
      opengl: as in `correct_poses`.

    Raises:
      SceneError: a correction is none of those above.
    """
    result = list(frames)
    for correction in corrections:
        name, _, value = correction.partition("=")
        try:
            poses = np.stack([frame.camtoworld for frame in result])
            poses = correct_poses(poses, correction, opengl=opengl)
            seen = [frame.seen for frame in result]
            if name == "order":  # which points are seen was found with the pose
                seen = [seen[int(i)] for i in value.split(",")]
            change = _CHANGES.get(name, lambda frame, _: frame)
            numbers = [] if name in _TEXTS else [float(part) for part in value.split(",")]
            result = [
                change(frame._replace(camtoworld=pose, seen=points), numbers)
                for frame, pose, points in zip(result, poses, seen, strict=True)
            ]
        except (ValueError, IndexError) as error:
            raise SceneError(f"the correction {correction!r} is unknown: {error}.") from error
        if name not in {*_CHANGES, *_TEXTS}:
            raise SceneError(f"the correction {correction!r} is unknown: leave it out.")
    return result


def _with_axes(poses: np.ndarray, axes: np.ndarray) -> np.ndarray:
    return np.concatenate([poses[..., :3] @ axes, poses[..., 3:]], -1)


def _inverse(poses: np.ndarray) -> np.ndarray:
    turned = np.swapaxes(poses[..., :3], -1, -2)
    return np.concatenate([turned, -turned @ poses[..., 3:]], -1)


def _size(frame: Frame) -> tuple[int, int]:
    """Return the size that the intrinsics refer to."""
    size = frame.size or size_of_image(frame.file)
    if size is None:
        raise SceneError(f"{frame.file} is not a readable image: restore it.")
    return size


def _resize(frame: Frame, factors: Sequence[float]) -> Frame:
    (factor,) = factors
    width, height = _size(frame)
    return frame._replace(size=(round(factor * width), round(factor * height)))


def _zoom(frame: Frame, factors: Sequence[float]) -> Frame:
    (factor,) = factors
    fx, fy, cx, cy = frame_intrinsics(frame, *_size(frame))
    return _with_lens(frame, (factor * fx, factor * fy, cx, cy))


def _move_center(frame: Frame, shares: Sequence[float]) -> Frame:
    x, y = shares
    width, height = _size(frame)
    fx, fy, cx, cy = frame_intrinsics(frame, width, height)
    return _with_lens(frame, (fx, fy, cx + x * width, cy + y * height))


def _turn(frame: Frame, turns: Sequence[float]) -> Frame:
    return frame._replace(turns=(frame.turns + int(turns[0])) % 4)


def _with_lens(frame: Frame, intrinsics: Sequence[float]) -> Frame:
    """Give a photograph its own intrinsics, over those of its file."""
    own = dict(zip(("fx", "fy", "cx", "cy"), map(float, intrinsics), strict=True))
    return frame._replace(lens=({**frame.lens[0], **own}, frame.lens[1]))


_CHANGES: dict[str, Callable[[Frame, Sequence[float]], Frame]] = {
    "size": _resize,
    "focal": _zoom,
    "center": _move_center,
    "turn": _turn,
}
_TEXTS = ("axes", "inverse", "order", "points")  # corrections of poses or points alone
