"""Photographs that were reduced before: `images_2`, `images_4` and `images_8` beside `images`."""

import collections
import pathlib

from jaxcloseup.captures.frames import Frame
from jaxcloseup.captures.masks import list_pictures


_FOLDER = "images"
_FACTORS = (2, 4, 8)


def attach_reduced(
    name: str, splits: dict[str, list[Frame]], downscale: int
) -> tuple[dict[str, list[Frame]], tuple[str, ...]]:
    """The frames with their photographs reduced `downscale` times, if all have one, and a note.

    Args:
      name: of the capture, for the note.
      splits: the frames by split.
      downscale: by which the photographs are to shrink.

    Raises:
      SceneError: such a folder that cannot be listed.
    """
    frames = {frame.file: frame for members in splits.values() for frame in members}
    places = {file: _place(file, downscale) for file in frames}
    folders = {place for place in places.values() if place and place.is_dir()}
    if downscale not in _FACTORS or not folders:
        return splits, ()
    called = f"{_FOLDER}_{downscale}"
    pictures = [path for folder in folders for path in list_pictures(folder)]
    by_stem = {path.with_suffix(""): path for path in pictures}
    by_name = {path: path for path in pictures}
    found = {
        file: by_name.get(place / file.name, by_stem.get(place / file.stem)) if place else None
        for file, place in places.items()
    }
    owners = collections.Counter(found.values())  # a.jpg and a.png do not share one
    missing = [file.name for file, path in found.items() if path is None or owners[path] > 1]
    # Intrinsics of a frame without a size belong to the whole photograph, which is not read.
    if missing or any(frame.size is None for frame in frames.values()):
        reason = "w and h of the whole photographs are not given"
        if missing:
            reason = f"it lacks {len(missing)} of {len(found)} photographs, such as {missing[0]}"
        return splits, (f"{name}: {called} is not used, since {reason}",)
    return {
        split: [frame._replace(reduced=found[frame.file]) for frame in members]
        for split, members in splits.items()
    }, (f"{name}: the photographs were reduced before, in {called}, and are taken from there",)


def _place(file: pathlib.Path, downscale: int) -> pathlib.Path | None:
    """The folder where a photograph's reduced like would lie, if it lies in `images`."""
    for root in file.parents:
        if root.name == _FOLDER:
            return root.with_name(f"{_FOLDER}_{downscale}") / file.parent.relative_to(root)
    return None
