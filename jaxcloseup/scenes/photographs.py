"""Photographs made ready, a few at a time: decoded, masked, straightened and downscaled."""

import concurrent.futures
import functools
import os
import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxcloseup.scenes.distortion import Remap, undistort, undistortion
from jaxcloseup.scenes.errors import SceneError
from jaxcloseup.scenes.frames import Frame, frame_intrinsics
from jaxcloseup.scenes.images import downscale_image, read_image, read_mask


_MOST_AT_ONCE = 4  # each holds a few times its own size: 12 megapixels take some 100 MB


class Photo(NamedTuple):
    """A photograph after downscaling.

    Attributes:
      rgb: `[H, W, 3]` uint8.
      mask: `[H, W]` uint8, 255 where it counts.
      stored_size: the (width, height) that it had before.
    """

    rgb: np.ndarray
    mask: np.ndarray
    stored_size: tuple[int, int]

    @property
    def size(self) -> tuple[int, int]:
        """Its (width, height)."""
        return self.rgb.shape[1], self.rgb.shape[0]


def read_photos(
    frames: Sequence[Frame], *, downscale: int, background: float, half_pixel: bool
) -> list[Photo]:
    """The photographs of `frames`; at full size no more than `_MOST_AT_ONCE` are in memory.

    Args:
      frames: what to read.
      downscale: whole number by which they shrink, by averaging areas.
      background: grey level in [0, 1] behind transparent pixels.
      half_pixel: whether the files count pixel centres at whole numbers.

    Raises:
      SceneError: a photograph or its mask that cannot be read, or sizes that do not fit.
    """
    read = functools.partial(
        _read_photo,
        downscale=downscale,
        background=background,
        half_pixel=half_pixel,
        find_remap=_one_at_a_time(functools.lru_cache(maxsize=2)(undistortion)),  # mostly one lens
    )
    workers = min(_MOST_AT_ONCE, os.cpu_count() or 1)
    # OpenCV decodes without Python's lock.
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        return list(pool.map(read, frames))


def resized_intrinsics(
    frame: Frame, stored: tuple[int, int], wanted: tuple[int, int], half_pixel: bool
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
    frame: Frame,
    *,
    downscale: int,
    background: float,
    half_pixel: bool,
    find_remap: Callable[..., Remap],
) -> Photo:
    rgb = read_image(frame.file, background=background)
    height, width = rgb.shape[:2]
    if downscale > min(width, height):
        raise SceneError(
            f"{frame.file} is {width} x {height} pixels, so that downscale {downscale} leaves "
            "nothing of it: take a smaller one."
        )
    mask = None
    if frame.mask:
        mask = read_mask(frame.mask)
        if mask.shape != (height, width):
            raise SceneError(
                f"{frame.mask} is {mask.shape[1]} x {mask.shape[0]} pixels and its photograph "
                f"{width} x {height}: give them one size."
            )
    if frame.distortion:
        intrinsics = resized_intrinsics(frame, (width, height), (width, height), half_pixel)
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
    return Photo(rgb, mask, (width, height))
