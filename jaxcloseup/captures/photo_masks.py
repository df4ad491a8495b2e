"""Find masks by name, in a folder `masks/` or beside their photographs.

The mask of `images/a.jpg` is the first that exists of `masks/a.jpg.png` (COLMAP's name),
`masks/a.mask.png`, `masks/a` with any image suffix, `images/a.jpg.png` and `images/a.mask.png`.
White pixels are kept and black ones are ignored. `masks` mirrors the subfolders of `images`.
instant-ngp's `images/dynamic_mask_a.png` comes last, and ignores all that is not black.
"""

import collections
import functools
import pathlib
from collections.abc import Iterable, Sequence

from jaxcloseup.captures.mask_values import MaskValues, understand_masks
from jaxcloseup.captures.photo_files import ENDINGS
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.photos.scene import SceneError


FOLDER = "masks"
# The full name comes first, because it tells the masks of a.jpg and a.png apart.
_IN_FOLDER = ("{name}", "{stem}.mask", "{stem}")
_DYNAMIC = "dynamic_mask_{stem}"
_BESIDE = (*_IN_FOLDER[:2], _DYNAMIC)


def is_picture(path: pathlib.Path) -> bool:
    """Return True if a file has an image's name; hidden files such as `._a.jpg` do not."""
    return path.suffix.lower() in ENDINGS and not path.name.startswith(".")


def list_photographs(folder: pathlib.Path) -> list[pathlib.Path]:
    """List the images in a folder, sorted, except those that are masks of other images there."""
    pictures, by_stem = list_pictures(folder), _by_stem(folder)
    masks = {_find(by_stem, picture, _BESIDE) for picture in pictures}
    return [picture for picture in pictures if picture not in masks]


def is_dynamic(frame: Frame) -> bool:
    """Return True if a frame has a mask of instant-ngp's, which is not black where it ignores."""
    return frame.mask is not None and frame.mask.stem == _DYNAMIC.format(stem=frame.file.stem)


def attach_masks(folder: pathlib.Path, splits: dict[str, list[Frame]]) -> dict[str, list[Frame]]:
    """Attach the masks found by name to the frames.

    Args:
      folder: folder of the capture; every folder between it and a photograph may hold `masks/`.
      splits: frames by split; a frame that names its own mask keeps it.

    Raises:
      SceneError: a folder `masks/` fits no photograph, or several photographs share a mask.
    """
    every = [frame for frames in splits.values() for frame in frames]
    waiting = list({frame.file: frame for frame in every if frame.mask is None}.values())
    places = functools.cache(functools.partial(_places, folder.resolve()))
    holders = sorted({holder for frame in waiting for holder, _ in places(frame.file.parent)})
    pictures = functools.cache(_by_stem)  # list each folder once
    found: dict[pathlib.Path, pathlib.Path | None] = {}
    for file in (frame.file for frame in waiting):
        masks = (_find(pictures(place), file, _IN_FOLDER) for _, place in places(file.parent))
        found[file] = next((mask for mask in masks if mask), None)
    listed = {frame.file for frame in every}
    total = len(listed)
    if holders and not any(found.values()) and len(waiting) == total:
        stem, name = waiting[0].file.stem, waiting[0].file.name
        raise SceneError(
            f"{holders[0]} holds no mask for any of the {total} photographs: for {name}, name the "
            f"mask {name}.png, {stem}.mask.png or {stem} with an image suffix, or rename the "
            "folder if it holds something else."
        )
    for file in found:
        beside = _find(pictures(file.parent), file, _BESIDE)
        found[file] = found[file] or (None if beside in listed else beside)
    masked = {file: mask for file, mask in found.items() if mask}
    _check_shared(masked)
    return {
        split: [frame._replace(mask=frame.mask or found[frame.file]) for frame in frames]
        for split, frames in splits.items()
    }


def understood_masks(
    name: str, frames: Iterable[Frame], *, inverted: bool
) -> tuple[MaskValues, tuple[str, ...]]:
    """Find out what the values of the frames' masks mean, and note how many have one.

    Args:
      name: name of the capture, for the note.
      frames: photographs of the capture.
      inverted: whether masks mark ignored pixels in white.

    Raises:
      SceneError: a mask cannot be read, or the values could mean anything.
    """
    every = {frame.file: frame for frame in frames}.values()
    masked = [frame for frame in every if frame.mask]
    if not masked:
        return MaskValues(), ()
    files = [frame.mask for frame in masked if frame.mask and not is_dynamic(frame)]
    values, words = understand_masks(files, inverted=inverted) if files else (MaskValues(), "")
    if len(files) < len(masked):
        words += "; " * bool(words) + "all but black of dynamic_mask files is ignored"
    note = f"{name}: {len(masked)} of {len(every)} photographs have a mask ({words})"
    return values, (note + "; the others are used whole" * (len(masked) < len(every)),)


def _places(capture: pathlib.Path, folder: pathlib.Path) -> list[tuple[pathlib.Path, pathlib.Path]]:
    """List the `masks/` folders around a folder of photographs, each with the one for its masks.

    `capture` is the resolved path of the capture's folder.
    """
    around, places = [folder, *folder.parents], []
    # A file may list absolute paths of a capture whose own path is relative or leads over a link.
    ends = (end for end, root in enumerate(around, 1) if root.resolve() == capture)
    # Photographs may lie outside the capture's folder; then their two nearest folders count.
    for root in around[: next(ends, 2)]:
        if (root / FOLDER).is_dir():
            # A file may list ../images/a.jpg, but masks/../images holds no masks.
            inner = [part for part in folder.relative_to(root).parts if part != ".."]
            places.append((root / FOLDER, root.joinpath(FOLDER, *inner)))
            if inner:  # masks/ beside images/ may leave out the name images
                places.append((root / FOLDER, root.joinpath(FOLDER, *inner[1:])))
    return places


def list_pictures(folder: pathlib.Path) -> tuple[pathlib.Path, ...]:
    """List the images in a folder, sorted; empty if the folder does not exist."""
    try:
        return tuple(
            sorted(path for path in folder.iterdir() if is_picture(path)) if folder.is_dir() else ()
        )
    except OSError as error:
        raise SceneError(
            f"{folder} cannot be listed ({error.strerror}): make it readable."
        ) from error


def _by_stem(folder: pathlib.Path) -> dict[str, pathlib.Path]:
    """Map stems to the images in a folder; the first image wins a shared stem."""
    return {path.stem: path for path in reversed(list_pictures(folder))}


def _find(
    pictures: dict[str, pathlib.Path], photograph: pathlib.Path, stems: Sequence[str]
) -> pathlib.Path | None:
    """Find the first image that matches a stem pattern of `{name}` and `{stem}`."""
    wanted = [stem.format(name=photograph.name, stem=photograph.stem) for stem in stems]
    return next((pictures[stem] for stem in wanted if stem in pictures), None)


def _check_shared(found: dict[pathlib.Path, pathlib.Path]) -> None:
    """Raise if photographs share a mask, such as `a.jpg` and `a.png`."""
    owners = collections.defaultdict(list)
    for file, mask in found.items():
        owners[mask].append(file)
    for mask, (first, *others) in owners.items():
        if others:
            raise SceneError(
                f"{mask} matches both {first} and {others[0]}: name each mask after its "
                f"photograph, such as {first.name}.png, in a subfolder of the same name."
            )
