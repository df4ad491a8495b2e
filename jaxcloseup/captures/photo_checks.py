"""Check decoded photographs and masks, also against what the capture's files say."""

import collections
import pathlib
import warnings
from collections.abc import Mapping, Sequence

from jaxcloseup.captures.formats import Listing
from jaxcloseup.captures.photo import CONSTANT, TRANSPARENT, Photo, Reading
from jaxcloseup.captures.photo_files import read_file
from jaxcloseup.captures.reduced_photos import is_stand_in
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.io.cache import content_hash
from jaxcloseup.photos.scene import (
    BlankPhotographWarning,
    DuplicateFileWarning,
    ImageSizeWarning,
    SceneError,
)


def warn_copies(listing: Listing) -> None:
    """Warn of photographs under several names: files of the same bytes."""
    by_size = collections.defaultdict(list)
    for file in sorted({frame.file for part in listing.frames.values() for frame in part}):
        if file.is_file():  # what is none is refused where it is read
            by_size[file.stat().st_size].append(file)
    same: dict[str, list[pathlib.Path]] = collections.defaultdict(list)
    for files in by_size.values():
        for file in files if len(files) > 1 else ():
            same[content_hash(read_file(file))].append(file)
    if copied := [files for files in same.values() if len(files) > 1]:
        first, second, *_ = copied[0]
        warnings.warn(
            f"{listing.folder}: {sum(map(len, copied)) - len(copied)} photographs are the same "
            f"file as another, such as {second.name} as {first.name}: remove the copies.",
            DuplicateFileWarning,
            stacklevel=2,
        )


def without_transparent(
    listing: Listing, parts: dict[str, list[Photo]]
) -> tuple[Listing, dict[str, list[Photo]]]:
    """Leave out fully transparent photographs, and warn of them and of those of one color.

    Args:
      listing: the capture.
      parts: photographs of each split, in the order of `listing.frames`.

    Returns:
      Both without such photographs.

    Raises:
      SceneError: all training photographs are fully transparent.
    """
    every = [photo for part in parts.values() for photo in part]
    if all(photo.flaw == TRANSPARENT for photo in parts["train"]):
        raise SceneError(
            f"{listing.folder}: the training photographs are fully transparent: export them "
            "without alpha, or set alpha_mode to ignore if their colors are right."
        )
    for flaw, done in ((TRANSPARENT, " were left out"), (CONSTANT, " show one color everywhere")):
        files = sorted({photo.frame.file for photo in every if photo.flaw == flaw})
        if files:
            warnings.warn(
                f"{listing.folder}: {flaw} photographs{done}: {len(files)}, such as "
                f"{files[0].name}.",
                BlankPhotographWarning,
                stacklevel=2,
            )
    clear = {photo.frame.file for photo in every if photo.flaw == TRANSPARENT}
    if not clear:
        return listing, parts
    times = listing.times_nearer
    if times is not None:
        tested = zip(listing.frames["test"], times, strict=True)
        times = tuple(time for frame, time in tested if frame.file not in clear)
    frames = {
        split: [frame for frame in part if frame.file not in clear]
        for split, part in listing.frames.items()
    }
    kept = {
        split: [photo for photo in part if photo.frame.file not in clear]
        for split, part in parts.items()
    }
    return listing._replace(
        frames={split: part for split, part in frames.items() if part}, times_nearer=times or None
    ), {split: part for split, part in kept.items() if part}


def check_weights(
    folder: pathlib.Path,
    frames: Mapping[str, Sequence[Frame]],
    photos: Sequence[Photo],
    reading: Reading,
) -> None:
    """Check that masks leave some pixels of the training photographs, which come first in `photos`.

    Raises:
      SceneError: if masks leave no pixel, or an option asks for masks that the capture lacks.
    """
    if reading.invert_masks and not any(frame.mask for part in frames.values() for frame in part):
        raise SceneError(f"{folder}: no photograph has a mask to invert: leave out invert_masks.")
    masks = [photo.mask for photo in photos[: len(frames["train"])]]
    if reading.alpha_mode == "mask" and all((mask == 255).all() for mask in masks):
        raise SceneError(f"{folder}: no photograph has transparent pixels: leave out alpha_mode.")
    if not any(mask.any() for mask in masks):
        advice = "white pixels are kept; set invert_masks if your masks keep black ones"
        if reading.invert_masks:
            advice = "invert_masks keeps black pixels; leave it out if your masks keep white ones"
        raise SceneError(
            f"{folder}: the masks leave no pixel of the {len(masks)} training photographs: "
            f"{advice}."
        )


def check_sizes(folder: pathlib.Path, photos: Sequence[Photo]) -> None:
    """Warn about photographs that were resized as a whole, and refuse any other change of size.

    Raises:
      SceneError: a photograph was cropped, padded or rotated.
    """
    resized = []
    for photo in {(photo.frame.file, photo.frame.size): photo for photo in photos}.values():
        frame = photo.frame
        if said := wrong_size(photo):
            raise SceneError(said)
        (width, height), (w, h) = photo.stored_size, frame.size or photo.stored_size
        if (width, height) == (w, h) or frame.reduced or is_stand_in(frame):
            continue  # a note tells of reduced ones
        resized.append(f"{frame.listed} is {width} x {height} pixels instead of {w} x {h}")
    if resized:
        more = f" (and {len(resized) - 1} more)" if len(resized) > 1 else ""
        warnings.warn(
            f"{folder}: {resized[0]}{more}; the intrinsics were scaled to the images.",
            ImageSizeWarning,
            stacklevel=2,
        )


def wrong_size(photo: Photo) -> str:
    """Describe how a photograph was cropped, padded or rotated since its camera was solved for."""
    frame = photo.frame
    (width, height), (w, h) = photo.stored_size, frame.size or photo.stored_size
    # Resizing rounds each side to whole pixels, so the aspect ratio agrees to within one pixel.
    if frame.reduced or abs(width * h / w - height) <= 1 or abs(height * w / h - width) <= 1:
        return ""
    rotated = ", as if rotated by an EXIF orientation" if is_rotated(photo) else ""
    return (
        f"{frame.label}: the image is {width} x {height} pixels, but w and h are {w} x {h}"
        f"{rotated}: restore the image that the camera was solved for, or correct w and h."
    )


def is_rotated(photo: Photo) -> bool:
    """Return True if width and height are exchanged, against what the capture says."""
    width, height = photo.stored_size
    return width != height and photo.frame.size == (height, width)
