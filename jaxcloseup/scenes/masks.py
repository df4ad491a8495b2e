"""Masks that lie in a folder `masks/` of their own, found by the names of their photographs.

For a photograph `images/a.jpg` the mask is `masks/a.jpg.png`, as COLMAP names it, or
`masks/a.mask.png`, or `masks/a` with any picture's ending; the first of them that is there. White
pixels are kept and black ones are ignored. Folders inside `images` have their like inside `masks`.
"""

import collections
import functools
import pathlib
from collections.abc import Iterator, Sequence

from jaxcloseup.scenes.errors import SceneError
from jaxcloseup.scenes.frames import Frame


FOLDER = "masks"
_PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")


def is_picture(path: pathlib.Path) -> bool:
    """Whether a file is a photograph or a mask by its name; macOS puts `._a.jpg` beside `a.jpg`."""
    return path.suffix.lower() in _PICTURES and not path.name.startswith(".")


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
    if not holders:
        return splits, ()
    pictures = functools.cache(list_pictures)  # folders are listed once, however many photographs
    found = {}
    for frame in waiting:
        masks = (_find(pictures(place), frame.file) for _, place in places[frame.file])
        found[frame.file] = next((mask for mask in masks if mask), None)
    masked = [file for file, mask in found.items() if mask]
    total = len({frame.file for frame in every})
    if not masked and len(waiting) == total:
        stem, name = waiting[0].file.stem, waiting[0].file.name
        raise SceneError(
            f"{holders[0]} holds no mask of any of the {total} photographs: for {name} neither "
            f"{name}.png nor {stem}.mask.png nor {stem} with a picture's ending is there; name "
            "them so, or name the folder otherwise if it holds something else."
        )
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


def _find(pictures: Sequence[pathlib.Path], photograph: pathlib.Path) -> pathlib.Path | None:
    # The whole name first: it tells a.jpg's from a.png's.
    for stem in (photograph.name, f"{photograph.stem}.mask", photograph.stem):
        for path in pictures:
            if path.stem == stem:
                return path
    return None


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
