"""Check COLMAP's files before pycolmap reads them.

pycolmap fills the missing part of a truncated file with whatever is in memory, and its errors about
text files do not name the file. Formats: https://colmap.github.io/format.html
"""

import math
import pathlib
import struct
from collections.abc import Callable, Sequence

from jaxcloseup.captures.colmap_files import NAMES, ModelFiles, image_records
from jaxcloseup.io.files import read_bytes
from jaxcloseup.photos.scene import SceneError


LARGEST_FILE = 2**32  # bytes
_Count = Callable[[int | str], int]  # number of parameters of a camera model


def check_files(files: ModelFiles, count_parameters: _Count) -> None:
    """Check every record of a model's cameras, images and points.

    Args:
      files: files of the model.
      count_parameters: number of parameters of a camera model, given its id or name; raises
        ValueError or KeyError for an unknown model.

    Raises:
      SceneError: names the file, which has more than `LARGEST_FILE` bytes, or the line or record in
        it.
    """
    needed = NAMES[:2] if files.ply else NAMES
    if missing := [files.path(name).name for name in needed if name not in files.paths]:
        raise SceneError(
            f"{files.folder}: {', '.join(missing)} is missing: copy the whole model again."
        )
    for name, path in files.paths.items():  # pycolmap reads rigs and frames, whatever they are
        data = _read(path)
        if files.suffix == ".bin":
            _check_binary(name, path, data, count_parameters)
        elif name in NAMES:  # not the rigs and frames of COLMAP 3.12
            _check_text(name, path, data, count_parameters)


def _read(path: pathlib.Path) -> bytes:
    try:
        return read_bytes(path, most=LARGEST_FILE)
    except OSError as error:
        raise SceneError(f"{path} cannot be read ({error.strerror}): restore the file.") from error


def _check_binary(name: str, path: pathlib.Path, data: bytes, count_parameters: _Count) -> None:
    walk = _WALKS[name]
    if not data:
        raise SceneError(f"{path} is empty: copy or export it again.")
    count, end = int.from_bytes(data[:8], "little"), 8
    for record in range(count if len(data) >= 8 else 1):
        try:
            end = walk(path, data, end, count_parameters)
        except struct.error:
            end = len(data) + 1
        if end > len(data):
            raise SceneError(
                f"{path} is truncated in record {record + 1} of {count}: copy or export it again."
            )
    if end != len(data):
        raise SceneError(
            f"{path} has {len(data) - end} bytes after its {count} records: copy or export it "
            "again."
        )


def _walk_camera(path: pathlib.Path, data: bytes, at: int, count_parameters: _Count) -> int:
    camera, model, _, _ = struct.unpack_from("<IiQQ", data, at)
    return at + 24 + 8 * _parameters(path, f"camera {camera}", model, count_parameters)


def _walk_image(path: pathlib.Path, data: bytes, at: int, _: _Count) -> int:
    (image,) = struct.unpack_from("<I", data, at)
    pose = struct.unpack_from("<7d", data, at + 4)
    end = data.find(b"\0", at + 64)
    if end < 0:
        raise struct.error
    name = data[at + 64 : end].decode("utf-8", "replace")
    if "\ufffd" in name:
        raise SceneError(
            f"{path}: image {image} has a name that is not UTF-8 ({name}): rename the photograph "
            "and export the model again."
        )
    _check_pose(f"{path}: image {image} ({name})", pose)
    (observations,) = struct.unpack_from("<Q", data, end + 1)
    return end + 9 + 24 * observations


def _walk_point(path: pathlib.Path, data: bytes, at: int, _: _Count) -> int:
    point, *position = struct.unpack_from("<Q3d", data, at)
    if not all(map(math.isfinite, position)):
        raise SceneError(
            f"{path}: point {point} has a position that is not finite: export the model again."
        )
    (track,) = struct.unpack_from("<Q", data, at + 43)
    return at + 51 + 8 * track


def _walk_rig(path: pathlib.Path, data: bytes, at: int, __: _Count) -> int:
    _, sensors = struct.unpack_from("<II", data, at)
    at += 8 + 8 * min(sensors, 1)  # the first sensor is the origin and has no pose
    for _ in range(sensors - 1):
        *_, has_pose = struct.unpack_from("<iIB", data, at)
        at += 9 + 56 * has_pose
    return at


def _walk_frame(path: pathlib.Path, data: bytes, at: int, _: _Count) -> int:
    frame, _, *pose, photographs = struct.unpack_from("<II7dI", data, at)
    _check_pose(f"{path}: frame {frame}", pose)
    return at + 68 + 16 * photographs


_WALKS = {
    **{"cameras": _walk_camera, "images": _walk_image, "points3D": _walk_point},
    **{"rigs": _walk_rig, "frames": _walk_frame},
}


def _check_text(name: str, path: pathlib.Path, data: bytes, count_parameters: _Count) -> None:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: not UTF-8 text: export it again as UTF-8.") from error
    if name == "images":
        records = image_records(text)
        numbered = [(number, image.split(maxsplit=9)) for (number, image), _ in records]
        for _, (number, seen) in records:
            if len(words := seen.split()) % 3:
                raise SceneError(
                    f"{path}: line {number} holds {len(words)} numbers instead of triples of x, y "
                    "and point id: export it again."
                )
    else:
        lines = enumerate(text.splitlines(), 1)
        numbered = [(number, line.split()) for number, line in lines if line[:1] != "#"]
    fewest = {"cameras": 4, "images": 10, "points3D": 8}[name]
    for number, words in numbered:
        if not words:
            continue
        label = f"{path}: line {number}"
        if len(words) < fewest:
            raise SceneError(f"{label} ends after {len(words)} fields: export it again.")
        try:
            if name == "images":
                _check_pose(
                    f"{path}: image {int(words[0])} ({words[9]})", [*map(float, words[1:8])]
                )
            elif name == "points3D":
                _check_finite(label, [*map(float, words[:8])])
            else:
                _check_finite(label, [float(words[2]), float(words[3]), *map(float, words[4:])])
        except ValueError as error:
            if isinstance(error, SceneError):
                raise
            raise SceneError(
                f"{label} holds text where a number belongs: export it again."
            ) from error
        if name == "cameras":
            expected = _parameters(path, f"camera {words[0]}", words[1], count_parameters)
            if len(words) != 4 + expected:
                raise SceneError(
                    f"{label}: {words[1]} needs {expected} parameters, got {len(words) - 4}: "
                    "export it again."
                )


def _parameters(path: pathlib.Path, camera: str, model: int | str, count_parameters: _Count) -> int:
    try:
        return count_parameters(model)
    except (ValueError, KeyError) as error:
        raise SceneError(
            f"{path}: {camera} has the unknown camera model {model}: undistort the photographs "
            "with COLMAP's image_undistorter first, or copy the file again."
        ) from error


def _check_pose(label: str, pose: Sequence[float]) -> None:
    if not all(map(math.isfinite, pose)):
        raise SceneError(
            f"{label}: its pose is not finite: delete the image from the model or solve it again."
        )
    if not any(pose[:4]):
        raise SceneError(
            f"{label}: its rotation is 0, 0, 0, 0: delete the image from the model or solve it "
            "again."
        )


def _check_finite(label: str, values: Sequence[float]) -> None:
    if not all(map(math.isfinite, values)):
        raise SceneError(f"{label} holds a value that is not finite: export the model again.")
