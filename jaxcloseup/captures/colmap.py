"""Read COLMAP's sparse models with pycolmap.

COLMAP shares our conventions (cameras look along z with y down, pixel centers at +0.5), but its
poses are world-to-camera.
"""

import collections
import pathlib
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.captures.colmap_checks import check_files
from jaxcloseup.captures.colmap_files import ModelFiles, prepare_model
from jaxcloseup.captures.distortion import read_distortion
from jaxcloseup.captures.json_fields import number
from jaxcloseup.captures.points import read_ply_points
from jaxcloseup.captures.scale import plausible
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.photos.scene import SceneError


_FIELDS: dict[str, str] = {
    "f": "fl_x",
    "fx": "fl_x",
    "fy": "fl_y",
    "k": "k1",
}  # other names are the same
_RIGID = 1e-3


class Model(NamedTuple):
    """A sparse model."""

    source: pathlib.Path  # the file that lists the images
    frames: list[
        Frame
    ]  # the images that have a pose, sorted by name; their files are not found yet
    points: np.ndarray  # `[P, 3]` float64 world points, sorted by id; P may be 0
    rgb: np.ndarray  # `[P, 3]` float32 colors of the points in [0, 1]
    # `[P]` mean reprojection errors in pixels of the images, NaN where unknown; None of a PLY file
    errors: np.ndarray | None
    notes: tuple[str, ...]  # what is unusual about its points


def read_colmap(files: ModelFiles) -> Model:
    """Read a sparse model, binary or text, with or without the rigs and frames of COLMAP 3.12.

    Where no image observes a point, `seen` of the frames is None.

    Raises:
      SceneError: names the file and the record in it, and says what to do.
    """
    reconstruction, names = _reconstruct(files)
    source, cameras = files.path("images"), files.path("cameras")
    lenses = {i: _lens(cameras, camera) for i, camera in reconstruction.cameras.items()}
    posed = [image for image in reconstruction.images.values() if image.has_pose]
    images = sorted(((names.get(i.image_id, i.name), i) for i in posed), key=lambda pair: pair[0])
    _check_names(source, [name for name, _ in images])
    positions = np.stack([image.projection_center() for _, image in images])
    numbers, points, rgb, errors, notes = _read_points(files, reconstruction, positions)
    known, rows = set(reconstruction.points3D), {point: row for row, point in enumerate(numbers)}
    observed = False
    frames = []
    for name, image in images:
        lens, size = lenses[image.camera_id]
        camera = f"{cameras}: camera {image.camera_id}"
        frame = _frame(image, name, source, lens, size, camera)
        seen = {point.point3D_id for point in image.get_observation_points2D()}
        if (absent := seen - known) and not files.ply:
            raise SceneError(
                f"{source}: image {name!r} shows point {min(absent)}, which "
                f"{files.path('points3D')} lacks: export the model again."
            )
        visible = np.array(sorted(rows[point] for point in seen & rows.keys()), np.int64)
        observed |= bool(len(visible))
        frames.append(frame._replace(seen=visible))
    if not observed:
        frames = [frame._replace(seen=None) for frame in frames]
    return Model(source, frames, points, rgb, errors, notes)


def _read_points(
    files: ModelFiles, reconstruction: Any, positions: np.ndarray
) -> tuple[list[int], np.ndarray, np.ndarray, np.ndarray | None, tuple[str, ...]]:
    """Return the points' ids, none in a PLY file, and what `Model` holds of them."""
    if files.ply:
        points, rgb, notes = read_ply_points(files.ply)
        keep = plausible(files.ply, points, positions)
        return (
            [],
            points[keep],
            rgb[keep],
            None,
            (f"its points are those of {files.ply.name}", *notes),
        )
    numbers = sorted(reconstruction.points3D)
    xyz = np.array([reconstruction.points3D[i].xyz for i in numbers], np.float64).reshape(-1, 3)
    keep = plausible(files.path("points3D"), xyz, positions)
    kept = [point for point, good in zip(numbers, keep, strict=True) if good]
    colors = [reconstruction.points3D[i].color for i in kept]
    rgb = np.array(colors, np.float32).reshape(-1, 3) / 255
    errors = np.array([reconstruction.points3D[i].error for i in kept], np.float32).reshape(-1)
    errors = np.where(errors >= 0, errors, np.nan)  # COLMAP writes -1 for an unknown one
    return kept, xyz[keep], rgb, errors, ()


def _reconstruct(files: ModelFiles) -> tuple[Any, dict[int, str]]:
    """Check a model's files, then let pycolmap read them; return the names of `prepare_model`."""
    try:
        import pycolmap
    except ImportError as error:
        raise SceneError(
            f"{files.folder} is a COLMAP model, and reading it needs pycolmap: install it with "
            "pip install 'jaxcloseup[colmap]'."
        ) from error

    def count_parameters(name: int | str) -> int:
        kinds = pycolmap.CameraModelId
        kind = kinds(int(name)) if files.suffix == ".bin" else kinds.__members__[str(name)]
        return len(pycolmap.Camera.create_from_model_id(1, kind, 1.0, 1, 1).params)

    check_files(files, count_parameters)
    reconstruction = pycolmap.Reconstruction()
    read = reconstruction.read_binary if files.suffix == ".bin" else reconstruction.read_text
    with prepare_model(files) as (folder, names):
        try:
            read(str(folder))
        except Exception as error:  # pycolmap's C++ checks raise various types
            reason = " ".join(str(error).replace(str(folder), str(files.folder)).split())
            raise SceneError(
                f"{files.folder}: its files do not match each other ({reason}): export the model "
                "again."
            ) from error
    return reconstruction, names


def _frame(
    image: Any,
    name: str,
    source: pathlib.Path,
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
            f"{source}: image {name!r} has a pose whose rotation is none: export the model again."
        )
    return Frame(
        source=source,
        listed=name,
        file=source.parent / name,
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
