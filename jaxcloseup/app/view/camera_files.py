"""Read cameras from files of nerfstudio, and map them to the world of a scene."""

import math
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.view.camera_paths import (
    OPENGL,
    CameraError,
    Shots,
    check_memory,
    numbered_shots,
)
from jaxcloseup.captures.json_fields import number, read_object, rigid_transform
from jaxcloseup.captures.load import Scene, SceneError
from jaxcloseup.captures.scale import FOCAL, LENGTH


_RIGID = 1e-3
_LARGEST = 2**31 - 1  # side of an image


def read_camera_path(path: pathlib.Path) -> Shots:
    """Read the cameras of nerfstudio's `camera_path.json`, in the file's own world, in float64.

    The function reads `render_height`, `render_width`, `fps` or `seconds`, and for each entry of
    `camera_path` its `camera_to_world` (16 numbers by rows, OpenGL) and `fov` (vertical, degrees;
    default: the file's `default_fov`). Pixels are square, so `aspect` is redundant and ignored.

    Raises:
      CameraError: the file is invalid; the message names the file, the entry and the field.
    """
    try:
        fields = read_object(path, "a camera_path")
    except SceneError as error:
        raise CameraError(str(error)) from None
    kind = fields.get("camera_type", "perspective")
    if kind != "perspective":
        raise CameraError(f"{path}: camera_type is {kind!r}: make it perspective")
    height, width = (_size(path, fields, key) for key in ("render_height", "render_width"))
    check_memory(width, height, f"{path}: render_width and render_height")
    entries = fields.get("camera_path")
    if not isinstance(entries, list) or not entries:
        raise CameraError(f"{path}: camera_path must be a list of at least one camera")
    poses, focals = [], []
    for i, entry in enumerate(entries):
        label = f"{path}: camera_path[{i}]"
        if not isinstance(entry, dict):
            raise CameraError(f"{label} must be an object with camera_to_world and fov")
        poses.append(_pose(label, entry))
        fov = _number(label, {"fov": fields.get("default_fov"), **entry}, "fov")
        if not 0 < fov < 180:
            raise CameraError(f"{label}: fov must be between 0 and 180 degrees, not {fov:g}")
        focals.append(height / 2 / math.tan(math.radians(fov) / 2))
        if not focals[-1] <= FOCAL[1] * max(width, height):
            raise CameraError(
                f"{label}: fov of {fov:g} degrees is too small for any lens: raise it"
            )
    fps = None
    if fields.get("fps") is not None:
        fps = _number(str(path), fields, "fps")
    elif fields.get("seconds") is not None:
        fps = len(entries) / max(_number(str(path), fields, "seconds"), 1e-9)
    if fps is not None and not 0 < fps <= 1000:
        raise CameraError(f"{path}: fps and seconds must be positive and give at most 1000 fps")
    intrinsics = [[f, f, width / 2, height / 2] for f in focals]
    shots = numbered_shots(poses, intrinsics, height, width, fps=fps)
    return _with_poses(shots, np.stack(poses))


def read_camera_transform(path: pathlib.Path) -> tuple[np.ndarray, float]:
    """Read the `transform`, `[3, 4]` float64, and `scale` of a `dataparser_transforms.json`.

    Raises:
      SceneError: the file is invalid; the message names the file and the field.
    """
    fields = read_object(path, "a transform and a scale")
    transform = rigid_transform(str(path), "transform", fields.get("transform"))
    return transform, number(str(path), "scale", fields.get("scale"), above=0)


def to_capture(shots: Shots, transform: np.ndarray, scale: float, scene: Scene) -> Shots:
    """Map cameras from nerfstudio's world to that of the capture's files, in float64.

    nerfstudio maps a point x of the capture's original world to scale * transform (x, 1). The
    original world is that of the files before the `applied_transform` of its `transforms.json`.
    The recorded scale includes the `applied_scale`, but nerfstudio's cameras do not.

    Args:
      shots: cameras in nerfstudio's world.
      transform: `[3, 4]` nerfstudio's recorded transform.
      scale: nerfstudio's recorded scale of positions.
      scene: the scene of the capture that nerfstudio loaded.

    Raises:
      SceneError: the scene's `applied_transform` and the transform do not combine to a rigid one.
    """
    last = [0.0, 0, 0, 1]
    applied = scene.metadata.get("applied_transform")
    back = np.linalg.inv(np.vstack([transform, last]))
    back = (np.eye(3, 4) if applied is None else applied) @ back
    back = rigid_transform(scene.name, "applied_transform after --camera_transform", back)
    scale /= scene.metadata.get("applied_scale", 1.0)
    poses = np.asarray(shots.cameras.camtoworld, np.float64) / [1, 1, 1, scale]
    return _with_poses(shots, back[:, :3] @ poses + back[:, 3:] * [0, 0, 0, 1])


def to_scene(shots: Shots, scene: Scene) -> Shots:
    """Map cameras from the world of a capture's files to the scene's, which float32 holds."""
    poses = scene.placement.poses_to_scene(np.asarray(shots.cameras.camtoworld))
    return _with_poses(shots, jnp.asarray(poses, jnp.float32))


def _with_poses(shots: Shots, poses: np.ndarray | jax.Array) -> Shots:
    return shots._replace(cameras=shots.cameras.replace(camtoworld=poses))


def _pose(label: str, entry: dict[str, Any]) -> np.ndarray:
    """Return the camera-to-world pose `[3, 4]` of an entry, in the OpenCV frame."""
    if "camera_to_world" not in entry:
        raise CameraError(f"{label}: camera_to_world is missing: give 16 numbers, by rows")
    try:
        matrix = np.array(entry["camera_to_world"], np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(())
    if matrix.size != 16 or not np.isfinite(matrix).all():
        raise CameraError(f"{label}: camera_to_world must be 16 finite numbers, by rows")
    matrix = matrix.reshape(4, 4)
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise CameraError(
            f"{label}: camera_to_world must end in the row 0, 0, 0, 1: it may be transposed"
        )
    rotation = matrix[:3, :3]
    with np.errstate(all="ignore"):
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not error <= _RIGID or np.linalg.det(rotation) < 0:
        raise CameraError(
            f"{label}: camera_to_world is not a rotation and a position: remove scales and "
            "reflections"
        )
    if np.abs(matrix[:3, 3]).max() > LENGTH:
        raise CameraError(f"{label}: camera_to_world is more than {LENGTH:g} away: correct it")
    return np.column_stack([rotation @ OPENGL, matrix[:3, 3]])


def _number(label: str, fields: dict[str, Any], key: str) -> float:
    value = fields.get(key)
    if value is None:
        raise CameraError(f"{label}: {key} is missing: add it")
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CameraError(f"{label}: {key} must be a finite number, not {value!r}")
    return float(value)


def _size(path: pathlib.Path, fields: dict[str, Any], key: str) -> int:
    value = _number(str(path), fields, key)
    if not 1 <= value <= _LARGEST or value != int(value):
        raise CameraError(f"{path}: {key} must be a whole number of pixels, not {value:g}")
    return int(value)
