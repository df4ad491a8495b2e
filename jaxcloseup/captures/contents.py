"""Read what a capture's folder holds: photographs of all splits, and points."""

import collections
import os
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.captures.colmap import read_colmap
from jaxcloseup.captures.colmap_files import find_model_files
from jaxcloseup.captures.corrections import correct_frames, correct_points
from jaxcloseup.captures.detection import SEPARATE, SINGLE, Detected, detect
from jaxcloseup.captures.leftovers import unused_note
from jaxcloseup.captures.listed_splits import splits_from_fields
from jaxcloseup.captures.llff import read_llff
from jaxcloseup.captures.photo_masks import attach_masks
from jaxcloseup.captures.photo_search import check_missing, list_first, locate, photograph_folders
from jaxcloseup.captures.placing import find_placement, place
from jaxcloseup.captures.points import read_ply_points
from jaxcloseup.captures.scale import check_positions, plausible
from jaxcloseup.captures.splits import without_repeats
from jaxcloseup.captures.transforms import read_transforms
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.io.placement import UNMOVED, Placement
from jaxcloseup.photos.scene import SceneError


_FILES = {
    "train": (SEPARATE,),
    "test": ("transforms_test.json",),
    "test_far": ("transforms_test_far.json", "transforms_val.json"),
}


class Listed(NamedTuple):
    """All photographs of a capture, and its points, in the coordinates of its files."""

    format: str  # one of `FORMATS`
    folder: pathlib.Path  # folder of the capture
    frames: list[Frame]  # photographs of all splits, in the order of their files
    points: np.ndarray  # `[P, 3]` float64 world points; P may be 0
    rgb: np.ndarray  # `[P, 3]` float32 colors of the points in [0, 1]
    notes: tuple[str, ...]  # sentences on what was read, and what was not


class Content(NamedTuple):
    """What one format's reader returns; `given` holds the splits if the files list any."""

    file: pathlib.Path
    fields: dict[str, Any]
    frames: list[Frame]
    given: dict[str, list[Frame]] | None
    points: tuple[np.ndarray, np.ndarray]
    errors: np.ndarray | None = None
    notes: tuple[str, ...] = ()  # sentences on how it was read


def list_photographs(
    path: pathlib.Path, *, format: str | None = None, corrections: Sequence[str] = ()
) -> Listed:
    """List a folder's photographs of all splits; `load_scene` documents the arguments.

    Raises:
      SceneError: the folder holds no known format, or one of its files is wrong.
    """
    detected, content = read_content(path, format, corrections)
    frames = attach_masks(detected.folder, {"all": content.frames})["all"]
    notes = (*content.notes, *unused_note(detected.folder, frames))
    return Listed(detected.format, detected.folder, frames, *content.points, notes)


def read_content(
    path: pathlib.Path, format: str | None, corrections: Sequence[str] = ()
) -> tuple[Detected, Content]:
    """Read what a folder holds of a format, and find the photographs that its files list.

    Args:
      path: the folder.
      format: the only format to read, or None.
      corrections: corrections of known mistakes.

    Returns:
      What is read, and its content in the coordinates of its files.

    Raises:
      SceneError: the folder holds no known format, or one of its files is wrong.
    """
    detected = detect(path, format)
    readers = {"transforms": _read_transforms, "colmap": _read_model, "llff": _read_llff}
    content = readers[detected.format](detected.folder, detected.path)
    content = _corrected(content, corrections, opengl=detected.format == "transforms")
    scene = detected.folder.resolve().name
    notes = tuple(f"{scene}: {note}" for note in (detected.note, *content.notes))
    return detected, content._replace(notes=notes)


def _corrected(content: Content, corrections: Sequence[str], *, opengl: bool) -> Content:
    """Apply corrections to photographs, their splits and points."""
    if not corrections:
        return content
    points, rgb = content.points
    frames = correct_frames(content.frames, corrections, opengl=opengl)
    for correction in corrections:
        points = correct_points(points, correction)
    if not len(points):
        frames = [frame._replace(seen=None) for frame in frames]
    changed = {id(old): new for old, new in zip(content.frames, frames, strict=True)}
    given = content.given and {
        split: [changed[id(frame)] for frame in part] for split, part in content.given.items()
    }
    errors = content.errors if len(points) else None
    note = f"{content.file}: corrected by {', '.join(corrections):.200}"
    return content._replace(
        frames=frames,
        given=given,
        points=(points, rgb[: len(points)]),
        errors=errors,
        notes=(*content.notes, note),
    )


def _read_transforms(folder: pathlib.Path, file: pathlib.Path) -> Content:
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
    _check_masks(frames)
    if file.name == SINGLE:
        given = splits_from_fields(file, fields, frames)
    else:
        parts = {
            split: [frame for frame in frames if frame.source == present[split]] for split in read
        }
        given = {split: part for split, part in parts.items() if part}
    points, rgb, about = _read_ply(file, fields, frames)
    notes = (*located.notes, *unrendered, *about)
    return Content(file, fields, frames, given, (points, rgb), notes=notes)


def _check_masks(frames: Sequence[Frame]) -> None:
    """Raise if masks that frames name do not exist."""
    masked = [frame for frame in frames if frame.mask]
    missing = [frame for frame in masked if frame.mask and not os.path.lexists(frame.mask)]
    if missing:
        raise SceneError(
            f"{missing[0].label}: its mask {missing[0].mask} does not exist ({len(missing)} of "
            f"{len(masked)} masks are missing): restore them, or remove the fields that name them."
        )


def _read_model(folder: pathlib.Path, path: pathlib.Path) -> Content:
    files = find_model_files(path)
    assert files is not None  # it was detected
    model = read_colmap(files)
    places = photograph_folders(folder, path)
    located = locate(folder, model.frames, places)
    check_missing(folder, located, places)
    notes = (*located.notes, *model.notes)
    points = model.points, model.rgb
    return Content(model.source, {}, located.frames, None, points, model.errors, notes)


def _read_llff(folder: pathlib.Path, file: pathlib.Path) -> Content:
    fields, frames = read_llff(file, *list_first(photograph_folders(folder)))
    points, rgb, notes = _read_ply(file, fields, frames)
    return Content(file, fields, frames, None, (points, rgb), notes=notes)


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


def placed(content: Content) -> tuple[Content, Placement]:
    """Return what was read, in the coordinates of the scene, and where this lies.

    Raises:
      SceneError: a camera lies too far away.
    """
    frames, (points, rgb) = content.frames, content.points
    check_positions(frames, UNMOVED)
    placement = find_placement(np.stack([frame.camtoworld[:, 3] for frame in frames]), points)
    check_positions(frames, placement)
    given = content.given and {k: place(part, placement) for k, part in content.given.items()}
    points = placement.to_scene(points).astype(np.float32)
    frames = place(frames, placement)
    return content._replace(frames=frames, given=given, points=(points, rgb)), placement
