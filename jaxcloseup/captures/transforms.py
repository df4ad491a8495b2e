"""Read `transforms*.json`, the format of the paper, Blender, instant-ngp and nerfstudio.

Poses in the files are camera-to-world in OpenGL's frame (x right, y up, z backward). This module
converts them to OpenCV's (x right, y down, z forward), which everything else uses.
"""

import pathlib
import warnings
from typing import Any

import numpy as np

from jaxcloseup.captures.distortion import COEFFICIENTS, read_distortion
from jaxcloseup.captures.json_fields import image_side, read_object, rigid_transform
from jaxcloseup.captures.photo_search import find_exact
from jaxcloseup.captures.world_frames import Frame, frame_intrinsics
from jaxcloseup.photos.scene import SceneError, UnknownKeyWarning


_LENS_KEYS = {
    *("fx", "fy", "fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y"),
    *("camera_model", "is_fisheye", *COEFFICIENTS),
}
_FILE_KEYS = _LENS_KEYS | {
    *("frames", "near", "far", "ply_file_path", "applied_transform", "applied_scale"),
    *("train_filenames", "test_filenames", "val_filenames"),
}
_FRAME_KEYS = _LENS_KEYS | {"file_path", "transform_matrix", "mask_path", "mask_filename"}
# Common fields that do not affect loading and are ignored without a warning.
_UNUSED_KEYS = {
    *("aabb_scale", "scale", "offset", "render_aabb", "sharpness", "rotation", "colmap_im_id"),
    *("orientation_override", "auto_scale_poses_override"),
    *("depth_file_path", "depth_unit_scale_factor", "integer_depth_scale"),
}


def read_transforms(path: pathlib.Path) -> tuple[dict[str, Any], list[Frame]]:
    """Read and check the fields of a `transforms*.json` and its frames, whose files are not found.

    Raises:
      SceneError: names the file, the frame and the field, and says what to do.
    """
    fields = read_object(path, 'a list of "frames"')
    entries = fields.get("frames")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise SceneError(
            f'{path}: "frames" must be a list of objects, one per photograph: correct it.'
        )
    if not entries:
        raise SceneError(f'{path}: "frames" is empty: list at least one photograph.')
    unknown = set(fields) - _FILE_KEYS
    unknown |= {key for entry in entries for key in entry} - _FRAME_KEYS
    unknown -= _UNUSED_KEYS
    if unknown:
        names = ", ".join(sorted(unknown))
        warnings.warn(
            f"{path}: these fields are ignored: {names}.", UnknownKeyWarning, stacklevel=2
        )
    return fields, [_read_frame(path, fields, entry) for entry in entries]


def _read_frame(path: pathlib.Path, fields: dict[str, Any], entry: dict[str, Any]) -> Frame:
    listed = entry.get("file_path")
    if not isinstance(listed, str) or not listed:
        raise SceneError(f"{path}: a frame has no file_path (got {listed!r}): name its image.")
    label = f"{path}: frame {listed!r}"
    lens = {**fields, **entry}
    if ("w" in lens) != ("h" in lens):
        raise SceneError(f"{label}: w and h belong together: give both or neither.")
    size = None
    if "w" in lens:
        size = image_side(label, "w", lens["w"]), image_side(label, "h", lens["h"])
    if "transform_matrix" not in entry:
        raise SceneError(f"{label}: no transform_matrix: give its camera-to-world pose.")
    pose = rigid_transform(label, "transform_matrix", entry["transform_matrix"])
    key = "mask_path" if entry.get("mask_path") else "mask_filename"
    mask = entry.get(key) or None
    if not isinstance(mask, str | None):
        raise SceneError(
            f"{label}: {key} is {mask!r}: give the path of a mask, or remove the field."
        )
    frame = Frame(
        source=path,
        listed=listed,
        file=path.parent / listed,
        mask=(find_exact(path.parent, mask) or path.parent / mask) if mask else None,
        camtoworld=pose * np.array([1, -1, -1, 1]),  # OpenGL to OpenCV: y and z change sign
        size=size,
        lens=(entry, fields),
        distortion=read_distortion(label, lens),
    )
    frame_intrinsics(frame, *(size or (1, 1)))  # raises before any image is decoded
    return frame
