"""Read COLMAP's sparse models with pycolmap.

COLMAP shares our conventions (cameras look along z with y down, pixel centers at +0.5), but its
poses are world-to-camera.
"""

import collections
import pathlib
from typing import Any

import numpy as np

from jaxcloseup.captures.colmap_checks import check_files
from jaxcloseup.captures.distortion import read_distortion
from jaxcloseup.captures.json_fields import number
from jaxcloseup.captures.scale import plausible
from jaxcloseup.captures.world_frames import Frame, check_photographs
from jaxcloseup.photos.scene import SceneError


_FIELDS: dict[str, str] = {
    "f": "fl_x",
    "fx": "fl_x",
    "fy": "fl_y",
    "k": "k1",
}  # other names are the same
_RIGID = 1e-3


def holds_model(folder: pathlib.Path) -> bool:
    """Return True if a folder holds a COLMAP model, complete or not."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_colmap(
    model: pathlib.Path, photographs: pathlib.Path
) -> tuple[pathlib.Path, list[Frame], tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Read a sparse model, binary or text, with or without the rigs and frames of COLMAP 3.12.

    Args:
      model: folder of cameras, images and points3D; binary files win over text files.
      photographs: folder of the images.

    Returns:
      The file that lists the images; the images that have a pose, sorted by name; the points
      `[P, 3]` with their colors `[P, 3]` in [0, 1], float32, sorted by id; and the points' mean
      reprojection errors `[P]` in pixels of the images, NaN where unknown.

    Raises:
      SceneError: names the file and the record in it, and says what to do.
    """
    suffix = ".bin" if (model / "cameras.bin").is_file() else ".txt"
    reconstruction = _reconstruct(model, suffix)
    source, cameras = model / f"images{suffix}", model / f"cameras{suffix}"
    lenses = {i: _lens(cameras, camera) for i, camera in reconstruction.cameras.items()}
    images = [image for image in reconstruction.images.values() if image.has_pose]
    images.sort(key=lambda image: image.name)
    _check_names(source, [image.name for image in images])
    table = model / f"points3D{suffix}"
    numbers = sorted(reconstruction.points3D)
    xyz = np.array([reconstruction.points3D[i].xyz for i in numbers], np.float64).reshape(-1, 3)
    keep = plausible(table, xyz, np.stack([image.projection_center() for image in images]))
    kept = [point for point, good in zip(numbers, keep, strict=True) if good]
    known, rows = set(numbers), {point: row for row, point in enumerate(kept)}
    frames = []
    for image in images:
        lens, size = lenses[image.camera_id]
        frame = _frame(
            image, source, photographs, lens, size, f"{cameras}: camera {image.camera_id}"
        )
        seen = {point.point3D_id for point in image.get_observation_points2D()}
        if absent := seen - known:
            raise SceneError(
                f"{source}: image {image.name!r} shows point {min(absent)}, which {table} lacks: "
                "export the model again."
            )
        visible = np.array(sorted(rows[point] for point in seen & rows.keys()), np.int64)
        frames.append(frame._replace(seen=visible))
    check_photographs(source, frames)
    colors = [reconstruction.points3D[i].color for i in kept]
    rgb = np.array(colors, np.float32).reshape(-1, 3) / 255
    errors = np.array([reconstruction.points3D[i].error for i in kept], np.float32).reshape(-1)
    errors = np.where(errors >= 0, errors, np.nan)  # COLMAP writes -1 for an unknown one
    return source, frames, (xyz[keep].astype(np.float32), rgb), errors


def _reconstruct(model: pathlib.Path, suffix: str) -> Any:
    """Check the files of a model, then let pycolmap read them."""
    try:
        import pycolmap
    except ImportError as error:
        raise SceneError(
            f"{model} is a COLMAP model, and reading it needs pycolmap: install it with "
            "pip install 'jaxcloseup[colmap]'."
        ) from error

    def count_parameters(name: int | str) -> int:
        kinds = pycolmap.CameraModelId
        kind = kinds(int(name)) if suffix == ".bin" else kinds.__members__[str(name)]
        return len(pycolmap.Camera.create_from_model_id(1, kind, 1.0, 1, 1).params)

    check_files(model, suffix, count_parameters)
    reconstruction = pycolmap.Reconstruction()
    read = reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text
    try:
        read(str(model))
    except Exception as error:  # pycolmap's C++ checks raise various types
        reason = " ".join(str(error).split())
        raise SceneError(
            f"{model}: its files do not match each other ({reason}): export the model again."
        ) from error
    return reconstruction


def _frame(
    image: Any,
    source: pathlib.Path,
    photographs: pathlib.Path,
    lens: dict[str, Any],
    size: tuple[int, int],
    camera: str,
) -> Frame:
    """Convert an image of pycolmap; `camera` names its lens in error messages."""
    world_to_camera = image.cam_from_world().matrix()
    rotation = world_to_camera[:, :3].T
    # pycolmap normalizes the quaternions of images, but not those of frames.
    with np.errstate(all="ignore"):
        rigid = np.allclose(rotation.T @ rotation, np.eye(3), atol=_RIGID)
    if not rigid:
        raise SceneError(
            f"{source}: image {image.name!r} has a pose whose rotation is none: export the "
            "model again."
        )
    return Frame(
        source=source,
        listed=image.name,
        file=photographs / image.name,
        mask=None,
        camtoworld=np.column_stack([rotation, -rotation @ world_to_camera[:, 3]]),
        size=size,
        lens=(lens, {}),
        distortion=read_distortion(camera, lens),
    )


def _lens(file: pathlib.Path, camera: Any) -> tuple[dict[str, Any], tuple[int, int]]:
    """Convert a camera to the fields of `transforms.json` and its (width, height)."""
    label = f"{file}: camera {camera.camera_id}"
    size = (
        int(number(label, "width", camera.width, above=0)),
        int(number(label, "height", camera.height, above=0)),
    )
    names: list[str] = [name.strip() for name in camera.params_info.split(",")]
    values = dict(zip(names, map(float, camera.params), strict=True))
    for name, value in values.items():
        number(label, name, value, above=0 if name in ("f", "fx", "fy") else -np.inf)
    lens: dict[str, Any] = {_FIELDS.get(name, name): value for name, value in values.items()}
    return {"camera_model": camera.model_name, **lens}, size


def _check_names(source: pathlib.Path, names: list[str]) -> None:
    if not names:
        raise SceneError(
            f"{source} has no image with a pose: run COLMAP again with photographs that overlap "
            "more."
        )
    twice = [name for name, count in collections.Counter(names).items() if count > 1]
    if twice:
        raise SceneError(
            f"{source} lists {twice[0]!r} more than once ({len(twice)} such names): keep one of "
            "each in the model."
        )
