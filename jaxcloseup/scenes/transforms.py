"""`transforms*.json`: the capture formats of the paper, Blender, instant-ngp and nerfstudio.

Poses in the files are camera-to-world in OpenGL's frame (x right, y up, z backward). They leave
this module in OpenCV's (x right, y down, z forward), and nothing else knows of the difference.
"""

import json
import math
import pathlib
import warnings
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.scenes.errors import SceneError, UnknownKeyWarning


_DISTORTION = {"k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"}
_LENS_KEYS = {
    *("fx", "fy", "fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y"),
    *("camera_model", "is_fisheye", *_DISTORTION),
}
_FILE_KEYS = _LENS_KEYS | {
    *("frames", "near", "far", "ply_file_path", "applied_transform"),
    *("train_filenames", "test_filenames", "val_filenames"),
}
_FRAME_KEYS = _LENS_KEYS | {"file_path", "transform_matrix", "mask_path"}
# Well known, of no bearing on what is loaded, and passed over in silence.
_UNUSED_KEYS = {
    *("aabb_scale", "scale", "offset", "render_aabb", "sharpness", "rotation", "colmap_im_id"),
    *("applied_scale", "orientation_override", "auto_scale_poses_override"),
    *("depth_file_path", "depth_unit_scale_factor", "integer_depth_scale"),
}
_PINHOLES = {"PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL"}
_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")


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
    """

    source: pathlib.Path
    listed: str
    file: pathlib.Path
    mask: pathlib.Path | None
    camtoworld: np.ndarray
    size: tuple[int, int] | None
    lens: tuple[dict[str, Any], dict[str, Any]]

    @property
    def label(self) -> str:
        """How messages name it."""
        return f"{self.source}: frame {self.listed!r}"


def read_transforms(path: pathlib.Path) -> tuple[dict[str, Any], list[Frame]]:
    """The fields of a `transforms*.json` and its frames, all of them checked.

    Raises:
      SceneError: names the file, the frame and the field, and says what to do.
    """
    fields = _read_json(path)
    entries = fields.get("frames")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise SceneError(f'{path}: "frames" must be a list of objects, one for each photograph.')
    if not entries:
        raise SceneError(f'{path}: "frames" is empty: list at least one photograph.')
    unknown = set(fields) - _FILE_KEYS
    unknown |= {key for entry in entries for key in entry} - _FRAME_KEYS
    unknown -= _UNUSED_KEYS
    if unknown:
        names = ", ".join(sorted(unknown))
        warnings.warn(
            f"{path}: these fields are not read: {names}.", UnknownKeyWarning, stacklevel=2
        )
    frames = [_read_frame(path, fields, entry) for entry in entries]
    missing = [frame.listed for frame in frames if not frame.file.is_file()]
    if missing:
        first = ", ".join(missing[:3]) + (", ..." if len(missing) > 3 else "")
        raise SceneError(
            f"{path}: {len(missing)} of {len(frames)} listed images do not exist ({first}): "
            "restore them or drop their frames."
        )
    return fields, frames


def frame_intrinsics(
    frame: Frame, width: int, height: int, *, half_pixel: bool = False
) -> np.ndarray:
    """fx, fy, cx, cy `[4]` float64 in pixels of an image of `width` x `height`.

    Focal lengths win over angles, and a frame's own fields over the file's. Pixels are square and
    the principal point is the middle of the image where nothing else is said. `half_pixel` is for
    files with integer pixel centres: it moves the principal point that they give by +0.5.
    """
    for lens in frame.lens:
        focal = _focal(frame.label, lens, width, height)
        if focal:
            break
    else:
        raise SceneError(f"{frame.label}: no focal length: give fl_x (or fx) or camera_angle_x.")
    lens = {**frame.lens[1], **frame.lens[0]}
    centre = [
        number(frame.label, key, lens[key]) + 0.5 * half_pixel if key in lens else side / 2
        for key, side in (("cx", width), ("cy", height))
    ]
    return np.array([*focal, *centre])


def number(label: str, key: str, value: Any, *, above: float = -math.inf) -> float:
    """`value` as a float, which must be finite and greater than `above`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SceneError(f"{label}: {key} must be a finite number, got {value!r}: correct it.")
    if value <= above:
        raise SceneError(f"{label}: {key} must be greater than {above:g}, got {value}: correct it.")
    return float(value)


def affine_transform(label: str, key: str, value: Any) -> np.ndarray:
    """A `[3, 4]` float64 matrix out of a 3x4 or 4x4 list of lists."""
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(())
    if matrix.shape not in ((3, 4), (4, 4)):
        raise SceneError(f"{label}: {key} must be a 4x4 matrix of numbers: correct it.")
    if not np.isfinite(matrix).all():
        raise SceneError(f"{label}: {key} holds a value that is not finite: drop or correct it.")
    if len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise SceneError(f"{label}: {key} must end in the row 0, 0, 0, 1: it may be transposed.")
    return matrix[:3]


def _read_json(path: pathlib.Path) -> dict[str, Any]:
    try:
        fields = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise SceneError(f"{path} cannot be read ({error.strerror}): restore the file.") from error
    except json.JSONDecodeError as error:
        raise SceneError(
            f"{path}: not JSON at line {error.lineno} ({error.msg}): correct it."
        ) from error
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: not UTF-8 text: save it again as UTF-8.") from error
    if not isinstance(fields, dict):
        raise SceneError(f'{path}: not an object with a list of "frames": is it the right file?')
    return fields


def _read_frame(path: pathlib.Path, fields: dict[str, Any], entry: dict[str, Any]) -> Frame:
    listed = entry.get("file_path")
    if not isinstance(listed, str) or not listed:
        raise SceneError(f"{path}: a frame has no file_path (got {listed!r}): name its image.")
    label = f"{path}: frame {listed!r}"
    lens = {**fields, **entry}
    _check_pinhole(label, lens)
    if ("w" in lens) != ("h" in lens):
        raise SceneError(f"{label}: w and h belong together: give both or neither.")
    size = tuple(int(number(label, key, lens[key], above=0)) for key in "wh" if key in lens)
    if "transform_matrix" not in entry:
        raise SceneError(f"{label}: no transform_matrix: give its camera-to-world pose.")
    pose = _rigid_transform(label, "transform_matrix", entry["transform_matrix"])
    mask = entry.get("mask_path") or None
    if not isinstance(mask, str | None):
        raise SceneError(
            f"{label}: mask_path is {mask!r}: give the path of a mask, or leave it out."
        )
    frame = Frame(
        source=path,
        listed=listed,
        file=_find(path.parent, listed),
        mask=_find(path.parent, mask) if mask else None,
        camtoworld=pose * np.array([1, -1, -1, 1]),  # OpenGL to OpenCV: y and z change sign
        size=size or None,
        lens=(entry, fields),
    )
    frame_intrinsics(frame, *(size or (1, 1)))  # complain before any image is decoded
    return frame


def _rigid_transform(label: str, key: str, value: Any) -> np.ndarray:
    """As `affine_transform`, and made of a rotation and a position."""
    matrix = affine_transform(label, key, value)
    rotation = matrix[:, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > 1e-3:
        raise SceneError(
            f"{label}: {key} is not rigid, its rotation is off by {error:.2g}: scale positions "
            "only, and leave the rotation's columns orthogonal and of unit length."
        )
    if np.linalg.det(rotation) < 0:
        raise SceneError(f"{label}: {key} mirrors space: flip one axis of its rotation.")
    return matrix


def _find(folder: pathlib.Path, listed: str) -> pathlib.Path:
    """The listed file; formats of Blender's kind leave out the suffix."""
    path = folder / listed.replace("\\", "/")
    candidates = [pathlib.Path(f"{path}{suffix}") for suffix in _SUFFIXES]
    return next((candidate for candidate in candidates if candidate.is_file()), path)


def _check_pinhole(label: str, lens: dict[str, Any]) -> None:
    model = lens.get("camera_model", "PINHOLE")
    bent = [key for key in sorted(_DISTORTION & set(lens)) if number(label, key, lens[key]) != 0]
    if str(model).upper() not in _PINHOLES or lens.get("is_fisheye") or bent:
        reason = f"non-zero {', '.join(bent)}" if bent else f"camera_model {model!r}"
        if lens.get("is_fisheye"):
            reason = "is_fisheye"
        raise SceneError(
            f"{label}: lens distortion ({reason}) is not supported: undistort the photographs to a "
            "pinhole camera first."
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
