"""List the photographs of a capture by split."""

import math
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.captures.choosing import choose_photographs
from jaxcloseup.captures.contents import placed, read_content
from jaxcloseup.captures.leftovers import unused_note
from jaxcloseup.captures.listed_splits import splits_from_file
from jaxcloseup.captures.photo import whole_size
from jaxcloseup.captures.photo_masks import attach_masks
from jaxcloseup.captures.placing import describe_offset
from jaxcloseup.captures.reduced_photos import attach_reduced, note_stand_ins
from jaxcloseup.captures.splits import FindPoints, divide, warn_duplicates
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.io.messages import printable
from jaxcloseup.io.placement import Placement


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


def read_listing(
    path: pathlib.Path,
    *,
    format: str | None = None,
    split: str,
    zoom: int = 1,
    downscale: int | None = 1,
    pixels: int = 1,
    photographs: int | None = None,
    choose: str = "path",
    find_points: FindPoints | None = None,
    corrections: Sequence[str] = (),
) -> Listing:
    """List a folder's photographs by split; `load_scene` and `divide` document the arguments.

    Raises:
      SceneError: the folder holds no known format, or one of its files is wrong.
    """
    detected, content = read_content(path, format, corrections)
    content, placement = placed(content)
    folder, scene = detected.folder, detected.folder.resolve().name
    given = content.given
    if split in ("given", "listed") and not given:
        given = splits_from_file(folder, content.frames)
    points, rgb = content.points
    find = find_points and _with_masks(folder, find_points)
    division = divide(scene, content.frames, given, split, points, zoom, find_points=find)
    if split != "zoom":  # crops share files with training photographs but show finer detail
        warn_duplicates(folder, division.frames)
    train, fewer = _chosen(scene, division.frames["train"], photographs, choose)
    frames = attach_masks(folder, division.frames | {"train": train})
    if downscale is None:
        sizes = filter(None, map(whole_size, frames["train"]))
        downscale = fitting_divisor(sizes, zoom**2 * pixels)
    frames, reduced = attach_reduced(scene, frames, downscale)
    keep = np.ones(len(points), bool)
    if fewer or len(frames) > 1:
        keep = _seen_in_training(frames["train"], len(points))
    used = [*content.frames, *(frame for part in frames.values() for frame in part)]
    notes = [*content.notes, *note_stand_ins(scene, content.frames), *division.notes, *reduced]
    notes += [*unused_note(folder, used), *describe_offset(scene, placement), *fewer]
    notes += _describe_dropped(scene, keep)
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
        placement=placement,
    )


def _with_masks(folder: pathlib.Path, find_points: FindPoints) -> FindPoints:
    """Return a function that finds points where masks show something."""
    return lambda frames: find_points(attach_masks(folder, {"all": list(frames)})["all"])


def _chosen(
    scene: str, train: list[Frame], photographs: int | None, choose: str
) -> tuple[list[Frame], list[str]]:
    """Return the training photographs that are used, and a note if they are not all."""
    poses = np.stack([frame.camtoworld for frame in train])
    rows = choose_photographs(scene, poses, photographs, choose)
    if len(rows) == len(train):
        return train, []
    apart = ", far apart" * (choose == "spread")
    note = f"{scene}: learns from {len(rows)} of {len(train)} training photographs{apart}"
    return [train[i] for i in rows], [note]


def _describe_dropped(scene: str, keep: np.ndarray) -> list[str]:
    """Return a note on points that are not kept, if there are any."""
    if keep.all():
        return []
    return [
        f"{scene}: dropped {np.sum(~keep)} of {len(keep)} points, which fewer than two training "
        "photographs see"
    ]


def fitting_divisor(sizes: Iterable[tuple[int, int]], pixels: int) -> int:
    """Return the divisor that brings most photographs next to a number of pixels, at least 1.

    Args:
      sizes: width and height of each photograph.
      pixels: about how many a photograph keeps.
    """
    areas = [width * height for width, height in sizes]
    return max(1, round(math.sqrt(float(np.median(areas or [1])) / pixels)))


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
