"""Detect the format of a capture folder and list its photographs."""

import math
import pathlib
import shlex
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.captures.colmap import holds_model, read_colmap
from jaxcloseup.captures.llff import read_llff
from jaxcloseup.captures.photo_files import ENDINGS, size_of_image
from jaxcloseup.captures.photo_masks import attach_masks
from jaxcloseup.captures.placing import describe_offset, find_placement, place
from jaxcloseup.captures.points import read_ply_points
from jaxcloseup.captures.reduced_photos import attach_reduced
from jaxcloseup.captures.scale import check_positions, plausible
from jaxcloseup.captures.splits import (
    FindPoints,
    divide,
    splits_from_fields,
    splits_from_file,
    spread,
    warn_duplicates,
)
from jaxcloseup.captures.transforms import read_transforms
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.io.messages import printable
from jaxcloseup.io.placement import UNMOVED, Placement
from jaxcloseup.photos.scene import SceneError


_FILES = {
    "train": ("transforms_train.json",),
    "test": ("transforms_test.json",),
    "test_far": ("transforms_test_far.json", "transforms_val.json"),
}
_SEPARATE, _SINGLE, _LLFF = "transforms_train.json", "transforms.json", "poses_bounds.npy"
_MODELS = ("sparse/0", "sparse", "colmap/sparse/0")


class Listing(NamedTuple):
    """The photographs, points and fields that a capture's files list, placed as their scene."""

    format: str  # one of `FORMATS`
    folder: pathlib.Path  # folder of the capture
    file: pathlib.Path  # main file of the capture, which error messages name
    fields: dict[str, Any]  # fields of the main file
    frames: dict[str, list[Frame]]  # photographs of each split present, `train` first
    points: np.ndarray  # `[P, 3]` float32 points of the scene; P may be 0
    rgb: np.ndarray  # `[P, 3]` float32 colors of the points in [0, 1]
    notes: tuple[str, ...]  # sentences on what was read and how it was split
    times_nearer: tuple[float, ...] | None  # see `splits.Division`
    # `[P]` mean reprojection errors of the points, in pixels of the photographs' own size, NaN
    # where unknown; None if the format has none
    errors: np.ndarray | None
    downscale: int  # divisor of the photographs' size, chosen where none was given
    placement: Placement  # of the scene in the coordinates of the files, which `fields` have


class _Content(NamedTuple):
    """What one format's reader returns; `given` holds the splits if the files list any."""

    file: pathlib.Path
    fields: dict[str, Any]
    frames: list[Frame]
    given: dict[str, list[Frame]] | None
    points: tuple[np.ndarray, np.ndarray]
    errors: np.ndarray | None = None
    placement: Placement = UNMOVED


def read_listing(
    path: pathlib.Path,
    *,
    format: str | None = None,
    split: str,
    zoom: int = 1,
    downscale: int | None = 1,
    pixels: int = 1,
    photographs: int | None = None,
    find_points: FindPoints | None = None,
) -> Listing:
    """List a folder's photographs by split; `load_scene` and `divide` document the arguments.

    Raises:
      SceneError: the folder holds no known format, or one of its files is wrong.
    """
    kind, folder, content, note = _read_content(path, format)
    scene = folder.resolve().name
    given = content.given
    if split == "given" and not given:
        given = splits_from_file(folder, content.frames)
    points, rgb = content.points
    division = divide(scene, content.frames, given, split, points, zoom, find_points=find_points)
    if split != "zoom":  # crops share files with training photographs but show finer detail
        warn_duplicates(folder, division.frames)
    train = division.frames["train"]
    chosen = spread(scene, len(train), photographs)
    fewer = len(chosen) < len(train)
    frames = division.frames | {"train": [train[i] for i in chosen]}
    frames, masked = attach_masks(folder, frames)
    if downscale is None:
        sizes = (size_of_image(frame.file) or frame.size for frame in frames["train"])
        downscale = fitting_divisor(filter(None, sizes), zoom**2 * pixels)
    frames, reduced = attach_reduced(scene, frames, downscale)
    keep = np.ones(len(points), bool)
    if fewer or len(frames) > 1:
        keep = _seen_in_training(frames["train"], len(points))
    notes = [note, *division.notes, *masked, *reduced, *describe_offset(scene, content.placement)]
    if fewer:
        notes.append(f"{scene}: learns from {len(chosen)} of {len(train)} training photographs")
    if not keep.all():
        notes.append(
            f"{scene}: dropped {np.sum(~keep)} of {len(keep)} points, which fewer than two "
            "training photographs see"
        )
    return Listing(
        format=kind,
        folder=folder,
        file=content.file,
        fields=content.fields,
        frames={split: _renumbered(part, keep) for split, part in frames.items()},
        points=points[keep],
        rgb=rgb[keep],
        notes=tuple(map(printable, notes)),
        times_nearer=division.times_nearer,
        errors=None if content.errors is None else content.errors[keep],
        downscale=downscale,
        placement=content.placement,
    )


def _placed(content: _Content) -> _Content:
    """Return what was read, in the coordinates of the scene."""
    frames, (points, rgb) = content.frames, content.points
    check_positions(frames, UNMOVED)
    placement = find_placement(np.stack([frame.camtoworld[:, 3] for frame in frames]), points)
    check_positions(frames, placement)
    given = content.given and {k: place(part, placement) for k, part in content.given.items()}
    points = placement.to_scene(points).astype(np.float32)
    frames = place(frames, placement)
    return content._replace(frames=frames, given=given, points=(points, rgb), placement=placement)


def fitting_divisor(sizes: Iterable[tuple[int, int]], pixels: int) -> int:
    """Return the divisor that brings most photographs next to a number of pixels, at least 1.

    Args:
      sizes: width and height of each photograph.
      pixels: about how many a photograph keeps.
    """
    areas = [width * height for width, height in sizes]
    return max(1, round(math.sqrt(float(np.median(areas or [1])) / pixels)))


def _read_content(
    path: pathlib.Path, format: str | None
) -> tuple[str, pathlib.Path, _Content, str]:
    """Return the format that is read, its folder, its content, and a sentence about it."""
    found = [(kind, name) for kind, name in _detect(path) if format in (None, kind)]
    if not found:
        raise _no_capture(path, format)
    (kind, name), *others = found
    folder = _folder_of_model(path) if name == "." else path
    readers = {"transforms": _read_transforms, "colmap": _read_model, "llff": _read_llff}
    content = _placed(readers[kind](folder, path / name))
    rejected = " or ".join(_describe(*other, path) for other in others)
    note = f"{folder.resolve().name}: reading {_describe(kind, name, path)}"
    return kind, folder, content, note + (f" and not {rejected}" if rejected else "")


def _no_capture(path: pathlib.Path, format: str | None) -> SceneError:
    """Return the error for a folder that holds no capture of this format."""
    kind = f" in the format {format}" if format else ""
    files = (
        f"add {_SEPARATE}, {_SINGLE}, {_LLFF}, or a COLMAP model in {', '.join(_MODELS)} or in "
        "the folder itself."
    )
    if pictures := None if format else _photographs_in(path):
        target = shlex.quote(f"{path.resolve().name}_capture")
        return SceneError(
            f"{path} holds no capture but photographs: find their poses with jaxcloseup "
            f"process --images={shlex.quote(str(pictures))} --output_dir={target}, or "
            f"{files}"
        )
    return SceneError(f"{path} holds no capture{kind}: {files}")


def _detect(path: pathlib.Path) -> list[tuple[str, str]]:
    """Find (format, file or model folder) pairs in a folder, in order of precedence."""
    files = [("transforms", _SEPARATE), ("transforms", _SINGLE)]
    found = [(kind, name) for kind, name in files if (path / name).is_file()]
    found += [("colmap", name) for name in (*_MODELS, ".") if holds_model(path / name)]
    return found + [("llff", _LLFF)] * (path / _LLFF).is_file()


def _photographs_in(path: pathlib.Path) -> pathlib.Path | None:
    """Return the folder with photographs, if there are any: this one, or `images` in it."""
    for folder in (path, path / "images"):
        if folder.is_dir() and any(one.suffix.lower() in ENDINGS for one in folder.iterdir()):
            return folder
    return None


def _describe(kind: str, name: str, path: pathlib.Path) -> str:
    if kind != "colmap":
        return name
    return f"the COLMAP model in {path.resolve().name if name == '.' else name}"


def _folder_of_model(model: pathlib.Path) -> pathlib.Path:
    """Find the capture that a model belongs to: the nearest parent folder with `images`."""
    around = model.resolve()
    candidates = (around, *around.parents)[:4]
    return next((folder for folder in candidates if (folder / "images").is_dir()), model)


def _read_transforms(folder: pathlib.Path, file: pathlib.Path) -> _Content:
    if file.name == _SINGLE:
        fields, frames = read_transforms(file)
        given = splits_from_fields(file, fields, frames)
    else:
        present = {
            split: next((folder / name for name in names if (folder / name).is_file()), None)
            for split, names in _FILES.items()
        }
        read = {split: read_transforms(path) for split, path in present.items() if path}
        fields = read["train"][0]
        given = {split: frames for split, (_, frames) in read.items()}
        frames = [frame for members in given.values() for frame in members]
    return _Content(file, fields, frames, given, _read_ply(file, fields, frames))


def _read_model(folder: pathlib.Path, model: pathlib.Path) -> _Content:
    file, frames, points, errors = read_colmap(model, folder / "images")
    return _Content(file, {}, frames, None, points, errors)


def _read_llff(folder: pathlib.Path, file: pathlib.Path) -> _Content:
    fields, frames = read_llff(file, folder / "images")
    return _Content(file, fields, frames, None, _read_ply(file, fields, frames))


def _read_ply(
    file: pathlib.Path, fields: dict[str, Any], frames: list[Frame]
) -> tuple[np.ndarray, np.ndarray]:
    folder, named = file.parent, fields.get("ply_file_path")
    if named and not (folder / str(named)).is_file():
        raise SceneError(
            f"{file}: ply_file_path {named!r} does not exist: restore it or remove the field."
        )
    ply = folder / str(named or "points3d.ply")
    if ply.is_file():
        points, rgb = read_ply_points(ply)
        keep = plausible(ply, points, np.stack([frame.camtoworld[:, 3] for frame in frames]))
        return points[keep], rgb[keep]
    return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)


def _renumbered(frames: list[Frame], keep: np.ndarray) -> list[Frame]:
    """Return frames whose `seen` counts only the points `[P]` that are kept."""
    rows = np.cumsum(keep) - 1
    return [
        frame if frame.seen is None else frame._replace(seen=rows[frame.seen[keep[frame.seen]]])
        for frame in frames
    ]


def _seen_in_training(train: Sequence[Frame], count: int) -> np.ndarray:
    """Return which points `[P]` two training photographs see; all if files do not say.

    A point that only other photographs see would leak their content into training.
    """
    seen = [frame.seen for frame in train if frame.seen is not None]
    if len(seen) < len(train):
        return np.ones(count, bool)
    return np.bincount(np.concatenate(seen), minlength=count) >= 2
