"""Find already shrunk photographs in `images_2`, `images_4` and `images_8` beside `images`."""

import collections
import pathlib
from collections.abc import Sequence

from jaxcloseup.captures.photo import whole_size
from jaxcloseup.captures.photo_masks import list_pictures
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.photos.scene import SceneError


_FOLDER = "images"
_FACTORS = (2, 4, 8)
_PIXELS = {"fx", "fy", "fl_x", "fl_y", "cx", "cy"}  # fields in pixels of the full size


def photographs_folder(folder: pathlib.Path) -> pathlib.Path:
    """Return a capture's `images`; where that does not exist, the least shrunk that does."""
    whole = folder / _FOLDER
    shrunk = (folder / f"{_FOLDER}_{factor}" for factor in _FACTORS)
    return whole if whole.exists() else next((one for one in shrunk if one.is_dir()), whole)


def is_stand_in(frame: Frame) -> bool:
    """Return True if a frame's file is shrunk, because `images` does not exist."""
    names = {f"{_FOLDER}_{factor}" for factor in _FACTORS}
    names -= set(pathlib.PurePath(frame.listed).parts)
    shrunk = [root for root in frame.file.absolute().parents if root.name in names]
    if not shrunk:
        return False
    # The capture holds the file that lists the photograph, so what this lies in too is the capture
    # or above it, whatever its name. A model's folder is resolved to find its capture.
    source = frame.source
    ways = source.absolute(), source.parent.resolve() / source.name
    return not {root for way in ways for root in way.parents}.issuperset(shrunk)


def note_stand_ins(name: str, frames: Sequence[Frame]) -> tuple[str, ...]:
    """Return a note if shrunk photographs are read in place of their originals.

    Args:
      name: name of the capture, for the note.
      frames: photographs of the capture.

    Raises:
      SceneError: intrinsics in pixels cannot be scaled, because the original size is unknown.
    """
    shrunk = [frame for frame in frames if is_stand_in(frame)]
    for frame in shrunk:
        if frame.size is None and not _PIXELS.isdisjoint([*frame.lens[0], *frame.lens[1]]):
            raise SceneError(
                f"{frame.label}: only {frame.file} exists, and the intrinsics cannot be scaled to "
                "it: give w and h of the full-size photographs, or restore these."
            )
    return (
        (f"{name}: reading shrunk photographs, because {_FOLDER} does not exist",) if shrunk else ()
    )


def attach_reduced(
    name: str, splits: dict[str, list[Frame]], downscale: int
) -> tuple[dict[str, list[Frame]], tuple[str, ...]]:
    """Attach shrunk copies to the frames, if every photograph has one, and return notes.

    Args:
      name: name of the capture, for the notes.
      splits: frames by split.
      downscale: factor by which to shrink the photographs.

    Raises:
      SceneError: a folder of shrunk photographs cannot be listed.
    """
    frames = {frame.file: frame for members in splits.values() for frame in members}
    places = {file: _place(file, downscale) for file in frames}
    folders = {place for place in places.values() if place and place.is_dir()}
    if downscale not in _FACTORS or not folders:
        return splits, ()
    folder_name = f"{_FOLDER}_{downscale}"
    pictures = [path for folder in folders for path in list_pictures(folder)]
    by_stem = {path.with_suffix(""): path for path in pictures}
    by_name = {path: path for path in pictures}
    found = {
        file: by_name.get(place / file.name, by_stem.get(place / file.stem)) if place else None
        for file, place in places.items()
    }
    owners = collections.Counter(found.values())  # a.jpg and a.png must not share a copy
    missing = [file.name for file, path in found.items() if path is None or owners[path] > 1]
    # Without w and h, intrinsics refer to the full-size photograph, which is not read.
    if missing or any(frame.size is None for frame in frames.values()):
        reason = "the capture gives no w and h of the full-size photographs"
        if missing:
            reason = f"it lacks {len(missing)} of {len(found)} photographs, such as {missing[0]}"
        return splits, (f"{name}: {folder_name} is not used, because {reason}",)
    return {
        split: [frame._replace(reduced=found[frame.file]) for frame in members]
        for split, members in splits.items()
    }, (f"{name}: using the shrunk photographs in {folder_name}",)


def check_reduced(frame: Frame, size: tuple[int, int], downscale: int) -> None:
    """Check that a shrunk copy has a size that fits its photograph, or the intrinsics' size.

    Raises:
      SceneError: it differs from both by more than rounding.
    """
    own = whole_size(frame)
    for whole in (own, frame.size):
        if whole and all(abs(downscale * size[i] - whole[i]) <= downscale for i in (0, 1)):
            return
    if own:
        raise SceneError(
            f"{frame.reduced} is {size[0]} x {size[1]} pixels, which is not {own[0]} x {own[1]} "
            f"divided by {downscale}: make it again, or rename its folder."
        )


def _place(file: pathlib.Path, downscale: int) -> pathlib.Path | None:
    """Find the folder for a photograph's shrunk copy; None if it does not lie in `images`."""
    for root in file.parents:
        if root.name == _FOLDER:
            return root.with_name(f"{_FOLDER}_{downscale}") / file.parent.relative_to(root)
    return None
