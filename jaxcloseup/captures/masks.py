"""Masks that lie beside their photographs or in a folder `masks/`, found by their names.

For a photograph `images/a.jpg` the mask is `masks/a.jpg.png`, as COLMAP names it, or
`masks/a.mask.png`, or `masks/a` with any picture's ending, or else `images/a.jpg.png` or
`images/a.mask.png`; the first of them that is there. White pixels are kept and black ones are
ignored. Folders inside `images` have their like inside `masks`.
"""

import collections
import functools
import pathlib
from collections.abc import Iterator, Sequence

from jaxcloseup.captures.frames import Frame
from jaxcloseup.scene import SceneError


FOLDER = "masks"
# The whole name first: it tells a.jpg's from a.png's.
_BESIDE = ("{name}", "{stem}.mask")
_IN_FOLDER = (*_BESIDE, "{stem}")
_PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")


def is_picture(path: pathlib.Path) -> bool:
    """Whether a file is a photograph or a mask by its name; macOS puts `._a.jpg` beside `a.jpg`."""
    return path.suffix.lower() in _PICTURES and not path.name.startswith(".")


def list_photographs(folder: pathlib.Path) -> list[pathlib.Path]:
    """The pictures in a folder, sorted, but for those that are masks of others there."""
    pictures, by_stem = list_pictures(folder), _by_stem(folder)
    masks = {_find(by_stem, picture, _BESIDE) for picture in pictures}
    return [picture for picture in pictures if picture not in masks]


def attach_masks(
    folder: pathlib.Path, splits: dict[str, list[Frame]]
) -> tuple[dict[str, list[Frame]], tuple[str, ...]]:
    """The frames with the masks that lie beside their photographs, and notes on how many do.

    Args:
      folder: of the capture; every folder between it and a photograph may hold `masks/`.
      splits: the frames by split. Those that name a mask of their own keep it.

    Raises:
      SceneError: there is such a folder and no photograph has a mask, or several have the same.
    """
    every = [frame for frames in splits.values() for frame in frames]
    waiting = list({frame.file: frame for frame in every if frame.mask is None}.values())
    places = {frame.file: list(_places(folder, frame.file)) for frame in waiting}
    holders = sorted({holder for found in places.values() for holder, _ in found})
    pictures = functools.cache(_by_stem)  # folders are listed once, however many photographs
    found = {}
    for file, around in places.items():
        masks = (_find(pictures(place), file, _IN_FOLDER) for _, place in around)
        found[file] = next((mask for mask in masks if mask), None)
    listed = {frame.file for frame in every}
    total = len(listed)
    if holders and not any(found.values()) and len(waiting) == total:
        stem, name = waiting[0].file.stem, waiting[0].file.name
        raise SceneError(
            f"{holders[0]} holds no mask of any of the {total} photographs: for {name} neither "
            f"{name}.png nor {stem}.mask.png nor {stem} with a picture's ending is there; name "
            "them so, or name the folder otherwise if it holds something else."
        )
    for file in found:
        beside = _find(pictures(file.parent), file, _BESIDE)
        found[file] = found[file] or (None if beside in listed else beside)
    masked = [file for file, mask in found.items() if mask]
    if not holders and not masked:
        return splits, ()
    _check_shared({file: found[file] for file in masked})
    count = len(masked) + total - len(waiting)
    note = f"{folder.resolve().name}: {count} of {total} photographs have a mask"
    if count < total:
        note += "; the others are kept whole"
    return {
        split: [frame._replace(mask=frame.mask or found[frame.file]) for frame in frames]
        for split, frames in splits.items()
    }, (note,)


def _places(
    folder: pathlib.Path, photograph: pathlib.Path
) -> Iterator[tuple[pathlib.Path, pathlib.Path]]:
    """Folders `masks/` that may serve a photograph, and where in them its mask would lie."""
    around = list(photograph.parents)
    # The photographs of a capture may lie outside its folder; then the next two around them count.
    around = around[: around.index(folder) + 1] if folder in around else around[:2]
    for root in around:
        if (root / FOLDER).is_dir():
            # A file may list ../images/a.jpg, and no mask lies in masks/../images.
            inner = [part for part in photograph.parent.relative_to(root).parts if part != ".."]
            yield root / FOLDER, root.joinpath(FOLDER, *inner)
            if inner:  # beside the folder of images, without its name
                yield root / FOLDER, root.joinpath(FOLDER, *inner[1:])


def list_pictures(folder: pathlib.Path) -> tuple[pathlib.Path, ...]:
    """The pictures in a folder, sorted; of one that is not there, none."""
    try:
        return tuple(
            sorted(path for path in folder.iterdir() if is_picture(path)) if folder.is_dir() else ()
        )
    except OSError as error:
        raise SceneError(
            f"{folder} cannot be listed ({error.strerror}): permit reading it."
        ) from error


def _by_stem(folder: pathlib.Path) -> dict[str, pathlib.Path]:
    """The pictures in a folder by their stems; of several with one, the first."""
    return {path.stem: path for path in reversed(list_pictures(folder))}


def _find(
    pictures: dict[str, pathlib.Path], photograph: pathlib.Path, stems: Sequence[str]
) -> pathlib.Path | None:
    """The first picture with one of the stems, which are written for a photograph `{name}`."""
    wanted = [stem.format(name=photograph.name, stem=photograph.stem) for stem in stems]
    return next((pictures[stem] for stem in wanted if stem in pictures), None)


def _check_shared(found: dict[pathlib.Path, pathlib.Path]) -> None:
    """Complain where the photographs `a.jpg` and `a.png`, or of two folders, share a mask."""
    owners = collections.defaultdict(list)
    for file, mask in found.items():
        owners[mask].append(file)
    for mask, (first, *others) in owners.items():
        if others:
            raise SceneError(
                f"{mask} may be the mask of {first} and of {others[0]}: name each after its "
                f"photograph, such as {first.name}.png, in a folder named as that one's."
            )
