"""Read photographs, a few at a time: decode, mask, undistort, downscale and crop them."""

import concurrent.futures
import functools
import logging
import math
import os
import pathlib
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from jaxcloseup.captures.distortion import Remap, undistort, undistortion_map
from jaxcloseup.captures.mask_values import MaskValues, read_mask
from jaxcloseup.captures.photo import CONSTANT, TRANSPARENT, Photo, Reading, resized_intrinsics
from jaxcloseup.captures.photo_files import composite, decode_image, downscale_image, read_file
from jaxcloseup.captures.photo_masks import is_dynamic
from jaxcloseup.captures.reduced_photos import check_reduced
from jaxcloseup.captures.world_frames import Frame, frame_intrinsics
from jaxcloseup.io.cache import Stored, cache_path, cached, content_hash, hash_files
from jaxcloseup.io.memory import installed_memory
from jaxcloseup.photos.scene import SceneError


MAX_CONCURRENT = 4  # each needs a few times its own size: 12 megapixels take about 100 MB
_SOURCES = (
    *("photo.py", "photo_reading.py", "photo_files.py", "file_kinds.py", "mask_values.py"),
    "distortion.py",
)
_FEW = 1000  # values
_BYTES_PER_PIXEL = 12  # peak of what stays: as read, padded, and weights in float32

_log = logging.getLogger(__name__)


def read_photos(splits: Mapping[str, Sequence[Frame]], reading: Reading) -> dict[str, list[Photo]]:
    """Read the photographs of each split, at most `MAX_CONCURRENT` at full size in memory.

    Raises:
      SceneError: a photograph or mask cannot be read, their sizes differ, or the photographs do not
        fit into memory.
    """
    # Close-ups are cropped while their photograph is in memory anyway.
    parts = splits.get("test", ()) if reading.zoom > 1 else ()
    closeups = {frame.file for frame in parts}
    whole = {split: members for split, members in splits.items() if not closeups or split != "test"}
    frames = [frame for members in whole.values() for frame in members]
    read = functools.partial(
        _read_photo,
        reading=reading,
        # Most captures have one lens.
        find_remap=_one_at_a_time(functools.lru_cache(maxsize=2)(undistortion_map)),
    )
    first = read(frames[0], frames[0].file in closeups)
    _check_memory(first[0], len(frames), reading)
    workers = min(MAX_CONCURRENT, os.cpu_count() or 1)
    # OpenCV decodes without Python's lock.
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        each = pool.map(read, frames[1:], [frame.file in closeups for frame in frames[1:]])
        made = [first, *each]
    wholes = iter(photos[0] for photos in made)
    found = {split: [next(wholes) for _ in members] for split, members in whole.items()}
    found["test" if closeups else ""] = [photo for photos in made for photo in photos[1:]]
    return {split: found[split] for split in splits}


def _check_memory(photo: Photo, count: int, reading: Reading) -> None:
    """Raise before reading `count` photographs of this size that would not fit into memory."""
    needed = _BYTES_PER_PIXEL * count * photo.mask.size
    if needed > (held := installed_memory()):
        width, height = photo.size
        smallest = math.ceil(reading.downscale * math.sqrt(needed / held))
        raise SceneError(
            f"{photo.frame.file.parent}: {count} photographs of {width} x {height} pixels need "
            f"{needed / 2**30:.1f} GiB, but this computer has {held / 2**30:.1f}: choose a "
            f"downscale of at least {smallest}."
        )


def _one_at_a_time(function: Callable[..., Remap]) -> Callable[..., Remap]:
    """Lock a cached function, so that concurrent threads compute each map once."""
    lock = threading.Lock()

    def locked(*arguments: Any) -> Remap:
        with lock:
            return function(*arguments)

    return locked


def _read_photo(
    frame: Frame, closeup: bool, *, reading: Reading, find_remap: Callable[..., Remap]
) -> list[Photo]:
    """Read a photograph and, if `closeup`, its most detailed crop without the zoom factor."""
    picture = read_file(frame.reduced or frame.file)
    mask = read_file(frame.mask) if frame.mask else None
    make = functools.partial(make_photo, frame, closeup, picture, mask, reading, find_remap)
    if frame.reduced or reading.downscale * reading.zoom == 1:
        return make()
    # Everything that the result depends on.
    key = ["area", cv2.__version__, _code(), closeup, reading._replace(half_pixel=False)]
    key += [content_hash(picture), None if mask is None else content_hash(mask)]
    key += [frame.size, frame.distortion, frame.turns, is_dynamic(frame)]
    if frame.distortion:
        # The size may be unknown before decoding. This stand-in is so large that a principal
        # point that defaults to its middle never equals a given one.
        size = frame.size or (2**30, 2**30)
        key += frame_intrinsics(frame, *size, half_pixel=reading.half_pixel).tolist()
    # The file is named by a hash of the key, so it is never out of date and may be deleted.
    key_hash = content_hash(repr(key).encode())
    return cached(
        cache_path("photographs", f"{key_hash}.photo"),
        key_hash,
        make,
        pack=_pack,
        unpack=functools.partial(_unpack, frame, 2 if closeup else 1),
        report=_log.warning,
        report_unwritable=_log.debug,  # a full disk would be reported once per photograph
    )


@functools.cache
def _code() -> str:
    """Hash the modules that determine how a photograph is processed."""
    return hash_files(pathlib.Path(__file__).with_name(name) for name in _SOURCES)


def _pack(photos: Sequence[Photo]) -> Stored:
    images = {f"rgb{i}": photo.rgb for i, photo in enumerate(photos)}
    images |= {f"mask{i}": photo.mask for i, photo in enumerate(photos)}
    return Stored(images, [photo[3:] for photo in photos])


def _unpack(frame: Frame, count: int, stored: Stored) -> list[Photo]:
    """Return the `count` photographs that `_pack` packed; raise an exception for other content."""
    photos = []
    for i, (stored_size, scaled, corner, flaw) in enumerate(stored.record):
        rgb, mask = stored.arrays[f"rgb{i}"], stored.arrays[f"mask{i}"]
        if not (rgb.dtype == mask.dtype == np.uint8 and rgb.shape == (*mask.shape, 3)):
            raise ValueError("other arrays")
        sizes = tuple(stored_size), tuple(scaled), tuple(corner)
        photos.append(Photo(frame, rgb, mask, *sizes, str(flaw)))
    if len(photos) != count:
        raise ValueError(f"{len(photos)} photographs instead of {count}")
    return photos


def make_photo(
    frame: Frame,
    closeup: bool,
    picture: np.ndarray,
    mask_picture: np.ndarray | None,
    reading: Reading,
    find_remap: Callable[..., Remap],
) -> list[Photo]:
    """Decode, mask, undistort and downscale a photograph, and crop it where that is asked for.

    Args:
      frame: the photograph.
      closeup: whether its most detailed crop without the zoom factor follows.
      picture: uint8 `[N]` bytes of its file.
      mask_picture: uint8 `[N]` bytes of its mask's file, or None.
      reading: how it is read.
      find_remap: `undistortion_map`, or what keeps its results.

    Raises:
      SceneError: the photograph or its mask cannot be read, or their sizes do not fit.
    """
    file = frame.reduced or frame.file
    image = np.rot90(decode_image(file, data=picture), frame.turns)
    if reading.alpha_mode == "ignore":
        image = np.ascontiguousarray(image[..., :3])
    flaw = _flaw(image)
    rgb = composite(image, 0.0 if reading.alpha_mode == "mask" else reading.background)
    if reading.alpha_mode == "mask" and image.shape[-1] == 4:
        rgb = np.concatenate([rgb, image[..., 3:]], -1)
    stored = width, height = rgb.shape[1], rgb.shape[0]
    downscale = reading.downscale
    if frame.reduced:
        check_reduced(frame, stored, downscale)
        downscale = 1
    if downscale * reading.zoom > min(stored):
        factors = f"downscale {downscale}"
        factors += f" times zoom {reading.zoom}" if reading.zoom > 1 else ""
        raise SceneError(
            f"{file} is {width} x {height} pixels, and {factors} leaves nothing of it: choose a "
            "smaller factor."
        )
    mask = None
    if mask_picture is not None:
        mask = _read_mask(frame, mask_picture, stored, reading)
    if frame.distortion:
        intrinsics = resized_intrinsics(frame, stored, stored, reading.half_pixel)
        remap = find_remap(frame.distortion, tuple(intrinsics.tolist()), width, height)
        _check_remap(frame, remap)
        whole = np.full((height, width), 255, np.uint8) if mask is None else mask
        rgb, mask = undistort(rgb, whole, remap)
    rgb = downscale_image(rgb, downscale)
    if mask is None:
        mask = np.full(rgb.shape[:2], 255, np.uint8)
    else:
        mask = downscale_image(mask, downscale)
    photo = Photo(frame, rgb, mask, stored, (rgb.shape[1], rgb.shape[0]), flaw=flaw)
    photos = _zoomed(photo, reading.zoom, closeup) if reading.zoom > 1 else [photo]
    return [_without_alpha(photo) for photo in photos] if rgb.shape[-1] == 4 else photos


def _check_remap(frame: Frame, remap: Remap) -> None:
    if not remap.inside.any():
        raise SceneError(
            f"{frame.label}: undistortion leaves nothing of the photograph: correct the distortion "
            "coefficients."
        )


def _flaw(image: np.ndarray) -> str:
    """Say what makes RGB or RGBA `[H, W, 3 or 4]` show nothing; "" if it shows something."""
    if image.shape[-1] == 4 and not image[..., 3].any():
        return TRANSPARENT
    # Few pixels may well be equal.
    parts = (image[::16, ::16], image) if image.size > _FEW else ()
    return CONSTANT if parts and all((part == image[0, 0]).all() for part in parts) else ""


def _read_mask(
    frame: Frame, data: np.ndarray, size: tuple[int, int], reading: Reading
) -> np.ndarray:
    """Read the mask of a photograph of this size, `[H, W]`: 255 where pixels are kept."""
    assert frame.mask is not None
    dynamic = is_dynamic(frame)
    mask = read_mask(frame.mask, MaskValues(white=1) if dynamic else reading.masks, data=data)
    mask = np.rot90(mask, frame.turns)
    mask = 255 - mask if dynamic or reading.invert_masks else mask
    if mask.shape[::-1] == frame.size != size:
        mask = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
    if mask.shape[::-1] != size:
        raise SceneError(
            f"{frame.mask} is {mask.shape[1]} x {mask.shape[0]} pixels but its photograph is "
            f"{size[0]} x {size[1]}: give both the same size."
        )
    return mask


def _without_alpha(photo: Photo) -> Photo:
    """Split RGBA `[H, W, 4]`, composited over black, into the file's colors and weights."""
    alpha = photo.rgb[..., 3].astype(np.float32) / 255
    own = photo.rgb[..., :3] / np.maximum(alpha, 1 / 255)[..., None]
    return photo._replace(
        rgb=np.rint(np.minimum(own, 255)).astype(np.uint8),
        mask=np.rint(photo.mask * alpha).astype(np.uint8),
    )


def _zoomed(photo: Photo, zoom: int, closeup: bool) -> list[Photo]:
    """Shrink a photograph exactly `zoom` times and, if `closeup`, crop a part of the same size.

    The crop is the most detailed of the photograph's `zoom` x `zoom` parts. Pixels at the right and
    the bottom that do not fill a shrunk pixel are dropped.
    """
    width, height = (side // zoom for side in photo.size)
    rgb, mask = (image[: height * zoom, : width * zoom] for image in (photo.rgb, photo.mask))
    small = photo._replace(
        rgb=downscale_image(rgb, zoom),
        mask=downscale_image(mask, zoom),
        scaled=(photo.size[0] / zoom, photo.size[1] / zoom),
    )
    if not closeup:
        return [small]
    corners = [(x * width, y * height) for y in range(zoom) for x in range(zoom)]
    parts = [np.s_[y : y + height, x : x + width] for x, y in corners]
    detail = [_detail(rgb[part], mask[part]) for part in parts]
    best = int(np.argmax(detail))
    part = parts[best]
    # Copy, because a view would keep the whole photograph in memory.
    rgb, mask = rgb[part].copy(), mask[part].copy()
    return [small, photo._replace(rgb=rgb, mask=mask, corner=corners[best])]


def _detail(rgb: np.ndarray, mask: np.ndarray) -> float:
    """Sum the squared brightness differences of neighboring pixels, by their weights."""
    gray = cv2.cvtColor(rgb[..., :3], cv2.COLOR_RGB2GRAY).astype(np.float32)
    weight = mask.astype(np.float32) / 255
    if rgb.shape[-1] == 4:
        weight *= rgb[..., 3] / np.float32(255)
    across = np.diff(gray, axis=1) ** 2 * weight[:, 1:] * weight[:, :-1]
    down = np.diff(gray, axis=0) ** 2 * weight[1:] * weight[:-1]
    return float(across.sum() + down.sum())
