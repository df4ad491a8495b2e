"""Photographs that were read, against what their capture says of them."""

import pathlib
import warnings
from collections.abc import Mapping, Sequence

from jaxcloseup.captures.frames import Frame
from jaxcloseup.captures.photo_reading import Photo, Reading
from jaxcloseup.scene import ImageSizeWarning, SceneError


def check_weights(
    folder: pathlib.Path,
    frames: Mapping[str, Sequence[Frame]],
    photos: Sequence[Photo],
    reading: Reading,
) -> None:
    """Complain of masks that leave nothing of the training photographs, the first of `photos`.

    Raises:
      SceneError: that, or options on masks of a capture that has none.
    """
    if reading.invert_masks and not any(frame.mask for part in frames.values() for frame in part):
        raise SceneError(f"{folder}: no photograph has a mask to invert: leave out invert_masks.")
    masks = [photo.mask for photo in photos[: len(frames["train"])]]
    if reading.alpha_mode == "mask" and all((mask == 255).all() for mask in masks):
        raise SceneError(f"{folder}: no photograph is transparent anywhere: leave out alpha_mode.")
    if not any(mask.any() for mask in masks):
        advice = "white is what counts, so invert them with invert_masks if it is black in these"
        if not any(frame.mask for frame in frames["train"]):
            advice = "opaque pixels are what counts, so leave out alpha_mode"
        elif reading.invert_masks:
            advice = "black is what counts, so leave out invert_masks if it is white in these"
        raise SceneError(
            f"{folder}: the masks leave no pixel of the {len(masks)} training photographs: "
            f"{advice}."
        )


def warn_sizes(folder: pathlib.Path, photos: Sequence[Photo]) -> None:
    """Accept images that were resized as a whole, and refuse other sizes than the file's.

    Raises:
      SceneError: one that was cropped, padded or turned.
    """
    resized = []
    for photo in {(photo.frame.file, photo.frame.size): photo for photo in photos}.values():
        frame = photo.frame
        if frame.reduced:
            continue
        (width, height), (w, h) = photo.stored_size, frame.size or photo.stored_size
        if (width, height) == (w, h):
            continue
        # Resizing rounds each side to whole pixels: its aspect agrees to within one of them.
        if abs(width * h / w - height) > 1 and abs(height * w / h - width) > 1:
            swapped = (w, h) == (height, width)
            turned = ", turned as by an EXIF orientation" if swapped else ""
            raise SceneError(
                f"{frame.label}: the image is {width} x {height} pixels, but w and h are {w} x {h}"
                f"{turned}: restore the image that the camera was solved for, or correct w and h."
            )
        resized.append(f"{frame.listed} is {width} x {height} and not {w} x {h}")
    if resized:
        more = f" and {len(resized) - 1} more" if len(resized) > 1 else ""
        warnings.warn(
            f"{folder}: {resized[0]}{more}; intrinsics were scaled to the images.",
            ImageSizeWarning,
            stacklevel=2,
        )
