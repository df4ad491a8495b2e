"""Write cameras and points for other programs: a COLMAP text model, and `transforms.json`.

Both list pinhole cameras: photographs are written beside them as they were undistorted. COLMAP
shares our frame, and its poses are world-to-camera; `transforms.json`, of nerfstudio and
Instant-NGP, has camera-to-world poses in OpenGL's frame (y up, z backward).
"""

import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from jaxcloseup.io.files import write_file, write_json


IMAGES, MASKS, POINTS = "images", "masks", "points.ply"
_OPENGL = np.diag([1.0, -1, -1, 1])
_LISTS = {"train": "train_filenames", "test": "test_filenames", "test_far": "val_filenames"}


class FileView(NamedTuple):
    """A photograph in files.

    Attributes:
      name: of its file in the folder of images.
      split: `train`, `test` or `test_far`.
      camtoworld: `[3, 4]` camera-to-world pose in the OpenCV frame, in the coordinates to write.
      intrinsics: `[4]` fx, fy, cx, cy in pixels; the image's corner is 0.
      height: of the image in pixels.
      width: of the image in pixels.
      masked: whether there is a mask of the same name in the folder of masks.
    """

    name: str
    split: str
    camtoworld: np.ndarray
    intrinsics: np.ndarray
    height: int
    width: int
    masked: bool


def write_colmap(
    folder: pathlib.Path, views: Sequence[FileView], points: np.ndarray, rgb: np.ndarray
) -> None:
    """Write `cameras.txt`, `images.txt` and `points3D.txt`.

    Args:
      folder: of the model, such as `sparse/0`.
      views: photographs, in the order of their numbers.
      points: `[P, 3]` float64 points in the coordinates to write.
      rgb: `[P, 3]` uint8 colors of the points.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    lenses: dict[str, int] = {}
    images = []
    for number, view in enumerate(views, 1):
        lens = f"PINHOLE {view.width} {view.height} {_numbers(view.intrinsics)}"
        camera = lenses.setdefault(lens, len(lenses) + 1)
        quaternion = _quaternion(view.camtoworld[:, :3].T)
        # Readers turn it back by the quaternion. The rotation, of float32, differs from that by
        # little, but far from the origin by too much.
        shift = -_matrix(quaternion) @ view.camtoworld[:, 3]
        pose = _numbers([*quaternion, *shift])
        # No keypoints are known: their line is empty.
        images += [f"{number} {pose} {camera} {view.name}", ""]
    _write_lines(
        folder / "cameras.txt",
        "CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy",
        [f"{camera} {lens}" for lens, camera in lenses.items()],
    )
    _write_lines(
        folder / "images.txt",
        "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then a line of keypoints",
        images,
    )
    rows = [
        f"{number} {_numbers(point)} {' '.join(map(str, color))} -1"
        for number, (point, color) in enumerate(zip(points, rgb.tolist(), strict=True), 1)
    ]
    _write_lines(folder / "points3D.txt", "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK", rows)


def write_transforms(
    path: pathlib.Path, views: Sequence[FileView], *, near: float, far: float
) -> None:
    """Write `transforms.json`, which names photographs, masks and points relative to itself.

    Args:
      path: path of the file.
      views: photographs.
      near: smallest z-depth of a surface, in the unit to write.
      far: largest z-depth of a surface, in the unit to write.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    frames: list[dict[str, Any]] = []
    for view in views:
        pose = np.vstack([view.camtoworld, [0, 0, 0, 1]]) @ _OPENGL
        lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), view.intrinsics.tolist(), strict=True))
        frame = {"file_path": f"{IMAGES}/{view.name}", "w": view.width, "h": view.height, **lens}
        if view.masked:
            frame["mask_path"] = f"{MASKS}/{view.name}"
        frames.append(frame | {"transform_matrix": pose.tolist()})
    lists = {
        name: [f"{IMAGES}/{view.name}" for view in views if view.split == split]
        for split, name in _LISTS.items()
    }
    about = {"camera_model": "PINHOLE", "ply_file_path": POINTS, "near": near, "far": far}
    write_json(path, {**about, **lists, "frames": frames})


def write_mask(path: pathlib.Path, shown: np.ndarray) -> None:
    """Write a mask `[H, W]`, true where pixels count, as a PNG of one channel.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    write_file(path, cv2.imencode(".png", np.where(shown, np.uint8(255), np.uint8(0)))[1].tobytes())


def _write_lines(path: pathlib.Path, columns: str, lines: Sequence[str]) -> None:
    write_file(path, "\n".join([f"# {columns}", *lines, ""]).encode())


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (w, x, y, z) that fits a rotation `[3, 3]` best.

    It is the eigenvector of the largest eigenvalue of Bar-Itzhack's symmetric matrix.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    matrix = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, yy - xx - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, zz - xx - yy],
    ]
    return np.linalg.eigh(matrix)[1][:, -1]


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation `[3, 3]` of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
