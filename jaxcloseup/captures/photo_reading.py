"""Photographs made ready, a few at a time: decoded, masked, straightened and downscaled."""

import concurrent.futures
import contextlib
import functools
import math
import os
import pathlib
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from jaxcloseup.captures.distortion import Remap, undistort, undistortion_map
from jaxcloseup.captures.frames import Frame, frame_intrinsics
from jaxcloseup.captures.images import downscale_image, read_file, read_image, read_mask
from jaxcloseup.captures.photo_cache import content_hash, kept
from jaxcloseup.scene import SceneError


ALPHA_MODES = ("blend", "mask")
_MOST_AT_ONCE = 4  # each holds a few times its own size: 12 megapixels take some 100 MB
_CODE = ("photo_reading.py", "images.py", "distortion.py")
_BYTES_PER_PIXEL = 12  # of what stays: as read, padded, and weights in float32, at the worst moment


class Reading(NamedTuple):
    """How photographs are made ready.

    Attributes:
      downscale: whole number by which they shrink, by averaging areas.
      zoom: whole number by which they shrink further; if not 1, the frames of `test` are close-ups,
        parts of training photographs that do not.
      background: gray level in [0, 1] behind transparent pixels.
      half_pixel: whether the files count pixel centers at whole numbers.
      alpha_mode: one of `ALPHA_MODES`: transparent pixels show the background, or weigh less.
      invert_masks: whether white is what masks ignore.
    """

    downscale: int = 1
    zoom: int = 1
    background: float = 1.0
    half_pixel: bool = False
    alpha_mode: str = "blend"
    invert_masks: bool = False


class Photo(NamedTuple):
    """A photograph after downscaling, or a part of it.

    Attributes:
      frame: what was read.
      rgb: `[H, W, 3]` uint8.
      mask: `[H, W]` uint8, 255 where it counts.
      stored_size: the (width, height) that the photograph had before.
      scaled: the (width, height) of the whole photograph at this scale; of one that is trimmed so
        that a whole number of pixels become one, possibly fractions.
      corner: (x, y) in it of the part's first pixel.
    """

    frame: Frame
    rgb: np.ndarray
    mask: np.ndarray
    stored_size: tuple[int, int]
    scaled: tuple[float, float]
    corner: tuple[int, int] = (0, 0)

    @property
    def size(self) -> tuple[int, int]:
        """Its (width, height)."""
        return self.rgb.shape[1], self.rgb.shape[0]

    def intrinsics(self, half_pixel: bool) -> np.ndarray:
        """fx, fy, cx, cy `[4]` in its pixels; `half_pixel` as `Reading` has it."""
        whole = _resized_intrinsics(self.frame, self.stored_size, self.scaled, half_pixel)
        return whole - np.array([0, 0, *self.corner])


def read_photos(splits: Mapping[str, Sequence[Frame]], reading: Reading) -> dict[str, list[Photo]]:
    """The photographs of each split; at full size no more than `_MOST_AT_ONCE` are in memory.

    Raises:
      SceneError: a photograph or its mask that cannot be read, sizes that do not fit, or more
        photographs than fit into memory.
    """
    # A close-up is cut while the photograph that it is a part of is there anyway.
    parts = splits.get("test", ()) if reading.zoom > 1 else ()
    closeups = {frame.file for frame in parts}
    whole = {split: of for split, of in splits.items() if not closeups or split != "test"}
    frames = [frame for members in whole.values() for frame in members]
    read = functools.partial(
        _read_photo,
        reading=reading,
        # Most captures have one lens.
        find_remap=_one_at_a_time(functools.lru_cache(maxsize=2)(undistortion_map)),
    )
    first = read(frames[0], frames[0].file in closeups)
    _check_memory(first[0], len(frames), reading)
    workers = min(_MOST_AT_ONCE, os.cpu_count() or 1)
    # OpenCV decodes without Python's lock.
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        each = pool.map(read, frames[1:], [frame.file in closeups for frame in frames[1:]])
        made = [first, *each]
    wholes = iter(photos[0] for photos in made)
    found = {split: [next(wholes) for _ in members] for split, members in whole.items()}
    found["test" if closeups else ""] = [photo for photos in made for photo in photos[1:]]
    return {split: found[split] for split in splits}


def _check_memory(photo: Photo, count: int, reading: Reading) -> None:
    """Refuse what would not fit, were all photographs like this one, before it is read."""
    needed = _BYTES_PER_PIXEL * count * photo.mask.size
    if needed > (held := _memory()):
        width, height = photo.size
        least = math.ceil(reading.downscale * math.sqrt(needed / held))
        raise SceneError(
            f"{photo.frame.file.parent}: {count} photographs of {width} x {height} pixels take "
            f"{needed / 2**30:.1f} GiB, and this computer has {held / 2**30:.1f}: choose a "
            f"downscale of at least {least}."
        )


def _memory() -> int:
    """Bytes of this computer, or of the container."""
    held = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with contextlib.suppress(OSError, ValueError):  # "max" is no limit
        held = min(held, int(pathlib.Path("/sys/fs/cgroup/memory.max").read_text()))
    return held


def _resized_intrinsics(
    frame: Frame, stored: tuple[int, int], wanted: tuple[float, float], half_pixel: bool
) -> np.ndarray:
    """fx, fy, cx, cy in pixels of an image of size `wanted`, for a photograph of size `stored`."""
    size = frame.size or stored
    return frame_intrinsics(frame, *size, half_pixel=half_pixel) * np.tile(
        np.divide(wanted, size), 2
    )


def _one_at_a_time(function: Callable[..., Remap]) -> Callable[..., Remap]:
    """So that threads that ask for the same map wait for one rather than each make theirs."""
    lock = threading.Lock()

    def locked(*arguments):
        with lock:
            return function(*arguments)

    return locked


def _read_photo(
    frame: Frame, closeup: bool, *, reading: Reading, find_remap: Callable[..., Remap]
) -> list[Photo]:
    """A photograph and, if `closeup`, the part of it with most detail at its full size."""
    picture = read_file(frame.reduced or frame.file)
    mask = read_file(frame.mask) if frame.mask else None
    make = functools.partial(_make_photo, frame, closeup, picture, mask, reading, find_remap)
    if frame.reduced or reading.downscale * reading.zoom == 1:
        return make()
    # All that the result depends on.
    key = ["area", cv2.__version__, _code(), closeup, reading._replace(half_pixel=False)]
    key += [content_hash(picture), content_hash(mask), frame.size, frame.distortion]
    if frame.distortion:
        # A size that is not known yet is one of which no half can be a cx that is given.
        size = frame.size or (2**30, 2**30)
        key += frame_intrinsics(frame, *size, half_pixel=reading.half_pixel).tolist()
    arrays = kept(repr(key), lambda: _pack(make()))
    return _unpack(frame, arrays)


@functools.cache
def _code() -> list[str]:
    """Hashes of the modules that decide what becomes of a photograph."""
    folder = pathlib.Path(__file__).parent
    return [content_hash((folder / name).read_bytes()) for name in _CODE]


def _pack(photos: Sequence[Photo]) -> dict[str, np.ndarray]:
    return {
        f"{name}{i}": np.asarray(value)
        for i, photo in enumerate(photos)
        for name, value in photo._asdict().items()
        if name != "frame"
    }


def _unpack(frame: Frame, arrays: dict[str, np.ndarray]) -> list[Photo]:
    names = Photo._fields[1:]
    photos = []
    for i in range(len(arrays) // len(names)):
        rgb, mask, *pairs = (arrays[f"{name}{i}"] for name in names)
        photos.append(Photo(frame, rgb, mask, *(tuple(pair.tolist()) for pair in pairs)))
    return photos


def _make_photo(
    frame: Frame,
    closeup: bool,
    picture: np.ndarray,
    mask_picture: np.ndarray | None,
    reading: Reading,
    find_remap: Callable[..., Remap],
) -> list[Photo]:
    file = frame.reduced or frame.file
    keep_alpha = reading.alpha_mode == "mask"
    rgb = read_image(file, background=reading.background, keep_alpha=keep_alpha, data=picture)
    stored = width, height = rgb.shape[1], rgb.shape[0]
    downscale = reading.downscale
    if frame.reduced:
        _check_reduced(frame, stored, downscale)
        downscale = 1
    if downscale * reading.zoom > min(stored):
        factors = f"downscale {downscale}"
        factors += f" times zoom {reading.zoom}" if reading.zoom > 1 else ""
        raise SceneError(
            f"{file} is {width} x {height} pixels, so that {factors} leaves nothing of it: "
            "take a smaller one."
        )
    mask = None
    if mask_picture is not None:
        mask = read_mask(frame.mask, data=mask_picture)
        mask = 255 - mask if reading.invert_masks else mask
        if frame.reduced and mask.shape[::-1] == frame.size:
            mask = cv2.resize(mask, stored, interpolation=cv2.INTER_AREA)
        if mask.shape != (height, width):
            raise SceneError(
                f"{frame.mask} is {mask.shape[1]} x {mask.shape[0]} pixels and its photograph "
                f"{width} x {height}: give them one size."
            )
    if frame.distortion:
        intrinsics = _resized_intrinsics(frame, stored, stored, reading.half_pixel)
        remap = find_remap(frame.distortion, tuple(intrinsics.tolist()), width, height)
        if not remap.inside.any():
            raise SceneError(
                f"{frame.label}: nothing of the photograph is left when its lens is straightened: "
                "correct the coefficients of its distortion."
            )
        whole = np.full((height, width), 255, np.uint8) if mask is None else mask
        rgb, mask = undistort(rgb, whole, remap)
    rgb = downscale_image(rgb, downscale)
    if mask is None:
        mask = np.full(rgb.shape[:2], 255, np.uint8)
    else:
        mask = downscale_image(mask, downscale)
    photo = Photo(frame, rgb, mask, stored, (rgb.shape[1], rgb.shape[0]))
    photos = _zoomed(photo, reading.zoom, closeup) if reading.zoom > 1 else [photo]
    return [_without_alpha(photo) for photo in photos] if rgb.shape[-1] == 4 else photos


def _without_alpha(photo: Photo) -> Photo:
    """A photograph `[H, W, 4]`, drawn over black, as its own colors and what they weigh."""
    alpha = photo.rgb[..., 3].astype(np.float32) / 255
    own = photo.rgb[..., :3] / np.maximum(alpha, 1 / 255)[..., None]
    return photo._replace(
        rgb=np.rint(np.minimum(own, 255)).astype(np.uint8),
        mask=np.rint(photo.mask * alpha).astype(np.uint8),
    )


def _check_reduced(frame: Frame, size: tuple[int, int], downscale: int) -> None:
    """Complain of a size that no way of rounding gives."""
    if any(abs(side - whole / downscale) > 1 for side, whole in zip(size, frame.size, strict=True)):
        raise SceneError(
            f"{frame.reduced} is {size[0]} x {size[1]} pixels, which is not {frame.size[0]} x "
            f"{frame.size[1]} reduced {downscale} times: make it again, or name its folder "
            "otherwise to have photographs reduced here."
        )


def _zoomed(photo: Photo, zoom: int, closeup: bool) -> list[Photo]:
    """A photograph whose pixels are exactly `zoom` of those before, and perhaps a close-up.

    Both have one size: of the photograph's `zoom` x `zoom` parts the close-up is the one with most
    detail. A rest at the right and the bottom that fills no pixel is left out.
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
    # Copied, for a view would keep the whole photograph in memory.
    rgb, mask = rgb[part].copy(), mask[part].copy()
    return [small, photo._replace(rgb=rgb, mask=mask, corner=corners[best])]


def _detail(rgb: np.ndarray, mask: np.ndarray) -> float:
    """The squared differences of neighbors that both count, of brightness, all together."""
    gray = cv2.cvtColor(rgb[..., :3], cv2.COLOR_RGB2GRAY).astype(np.float32)
    weight = mask.astype(np.float32) / 255
    if rgb.shape[-1] == 4:
        weight *= rgb[..., 3] / np.float32(255)
    across = np.diff(gray, axis=1) ** 2 * weight[:, 1:] * weight[:, :-1]
    down = np.diff(gray, axis=0) ** 2 * weight[1:] * weight[:-1]
    return float(across.sum() + down.sum())
