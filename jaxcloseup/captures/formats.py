"""List the photographs of a capture by split."""

import collections
import math
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.captures.colmap import read_colmap
from jaxcloseup.captures.colmap_files import find_model_files
from jaxcloseup.captures.detection import SEPARATE, SINGLE, Detected, detect
from jaxcloseup.captures.leftovers import unused_note
from jaxcloseup.captures.llff import read_llff
from jaxcloseup.captures.photo_files import size_of_image
from jaxcloseup.captures.photo_masks import attach_masks
from jaxcloseup.captures.photo_search import check_missing, list_first, locate, photograph_folders
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
    without_repeats,
)
from jaxcloseup.captures.transforms import read_transforms
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.io.messages import printable
from jaxcloseup.photos.scene import SceneError


_FILES = {
    "train": (SEPARATE,),
    "test": ("transforms_test.json",),
    "test_far": ("transforms_test_far.json", "transforms_val.json"),
}


class Listing(NamedTuple):
    """The photographs, points and fields that a capture's files list."""

    format: str  # one of `FORMATS`
    folder: pathlib.Path  # folder of the capture
    file: pathlib.Path  # main file of the capture, which error messages name
    fields: dict[str, Any]  # fields of the main file
    frames: dict[str, list[Frame]]  # photographs of each split present, `train` first
    points: np.ndarray  # `[P, 3]` float32 world points; P may be 0
    rgb: np.ndarray  # `[P, 3]` float32 colors of the points in [0, 1]
    notes: tuple[str, ...]  # sentences on what was read and how it was split
    times_nearer: tuple[float, ...] | None  # see `splits.Division`
    # `[P]` mean reprojection errors of the points, in pixels of the photographs' own size, NaN
    # where unknown; None if the format has none
    errors: np.ndarray | None
    downscale: int  # divisor of the photographs' size, chosen where none was given


class _Content(NamedTuple):
    """What one format's reader returns; `given` holds the splits if the files list any."""

    file: pathlib.Path
    fields: dict[str, Any]
    frames: list[Frame]
    given: dict[str, list[Frame]] | None
    points: tuple[np.ndarray, np.ndarray]
    errors: np.ndarray | None = None
    notes: tuple[str, ...] = ()  # sentences on how it was read


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
    detected, content = _read_content(path, format)
    folder, scene = detected.folder, detected.folder.resolve().name
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
    used = [*content.frames, *(frame for part in frames.values() for frame in part)]
    notes = [*content.notes, *division.notes, *unused_note(folder, used), *masked, *reduced]
    if fewer:
        notes.append(f"{scene}: learns from {len(chosen)} of {len(train)} training photographs")
    if not keep.all():
        notes.append(
            f"{scene}: dropped {np.sum(~keep)} of {len(keep)} points, which fewer than two "
            "training photographs see"
        )
    return Listing(
        format=detected.format,
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
    )


def fitting_divisor(sizes: Iterable[tuple[int, int]], pixels: int) -> int:
    """Return the divisor that brings most photographs next to a number of pixels, at least 1.

    Args:
      sizes: width and height of each photograph.
      pixels: about how many a photograph keeps.
    """
    areas = [width * height for width, height in sizes]
    return max(1, round(math.sqrt(float(np.median(areas or [1])) / pixels)))


def _read_content(path: pathlib.Path, format: str | None) -> tuple[Detected, _Content]:
    """Read what a folder holds of a format, and find the photographs that its files list."""
    detected = detect(path, format)
    readers = {"transforms": _read_transforms, "colmap": _read_model, "llff": _read_llff}
    content = readers[detected.format](detected.folder, detected.path)
    check_positions(content.frames)
    scene = detected.folder.resolve().name
    notes = tuple(f"{scene}: {note}" for note in (detected.note, *content.notes))
    return detected, content._replace(notes=notes)


def _read_transforms(folder: pathlib.Path, file: pathlib.Path) -> _Content:
    named = _FILES if file.name == SEPARATE else {"train": (SINGLE,)}
    present = {
        split: next((folder / name for name in names if (folder / name).is_file()), None)
        for split, names in named.items()
    }
    read = {split: read_transforms(path) for split, path in present.items() if path}
    fields, listed = read["train"][0], [frame for _, part in read.values() for frame in part]
    places = list(dict.fromkeys((folder, *photograph_folders(folder))))
    located = locate(folder, listed, places)
    absent = collections.Counter(frame.source for frame in located.missing)
    if absent.pop(file, 0):
        missing = [frame for frame in located.missing if frame.source == file]
        check_missing(folder, located._replace(missing=missing), places)
    unrendered = [
        f"{path.name} lists {count} views without photographs, which are not scored"
        for path, count in absent.items()
    ]
    frames = without_repeats(located.frames)
    if file.name == SINGLE:
        given = splits_from_fields(file, fields, frames)
    else:
        parts = {
            split: [frame for frame in frames if frame.source == present[split]] for split in read
        }
        given = {split: part for split, part in parts.items() if part}
    points, rgb, about = _read_ply(file, fields, frames)
    notes = (*located.notes, *unrendered, *about)
    return _Content(file, fields, frames, given, (points, rgb), notes=notes)


def _read_model(folder: pathlib.Path, path: pathlib.Path) -> _Content:
    files = find_model_files(path)
    assert files is not None  # it was detected
    model = read_colmap(files)
    places = photograph_folders(folder, path)
    located = locate(folder, model.frames, places)
    check_missing(folder, located, places)
    notes = (*located.notes, *model.notes)
    points = model.points, model.rgb
    return _Content(model.source, {}, located.frames, None, points, model.errors, notes)


def _read_llff(folder: pathlib.Path, file: pathlib.Path) -> _Content:
    fields, frames = read_llff(file, *list_first(photograph_folders(folder)))
    points, rgb, notes = _read_ply(file, fields, frames)
    return _Content(file, fields, frames, None, (points, rgb), notes=notes)


def _read_ply(
    file: pathlib.Path, fields: dict[str, Any], frames: list[Frame]
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Read the points `[P, 3]` beside a file, their colors `[P, 3]`, and notes on them."""
    folder, named = file.parent, fields.get("ply_file_path")
    if named and not (folder / str(named)).is_file():
        raise SceneError(
            f"{file}: ply_file_path {named!r} does not exist: restore it or remove the field."
        )
    ply = folder / str(named or "points3d.ply")
    if ply.is_file():
        points, rgb, notes = read_ply_points(ply)
        keep = plausible(ply, points, np.stack([frame.camtoworld[:, 3] for frame in frames]))
        return points[keep], rgb[keep], notes
    return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), ()


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
