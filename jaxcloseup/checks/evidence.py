"""Read a capture's photographs once, small, with all that a check asks of them."""

import concurrent.futures
import os
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from jaxcloseup.captures.names import file_names
from jaxcloseup.captures.photo import Photo, Reading
from jaxcloseup.captures.photo_checks import is_rotated, wrong_size
from jaxcloseup.captures.photo_reading import MAX_CONCURRENT
from jaxcloseup.captures.sift import Features, find_features
from jaxcloseup.captures.small_photos import read_small
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.checks.epipolar import Cameras
from jaxcloseup.checks.matches import Matches, find_matches
from jaxcloseup.photos.scene import SceneError


SIDE = 800  # longer side in pixels, about, of photographs that are checked
_FEATURES = 1500  # of a photograph


class Evidence(NamedTuple):
    """What photographs show, and the cameras that are claimed for them."""

    names: Sequence[str]  # of photographs
    cameras: Cameras  # in pixels of the reduced photographs
    gray: Sequence[np.ndarray]  # `[H, W]` uint8 reduced photographs
    matches: Matches
    looks: np.ndarray  # `[V, 4]` what `look` measures
    turned: str = ""  # what is wrong with the sizes, if all photographs are turned by a quarter


def gather(
    frames: Sequence[Frame],
    reading: Reading,
    report: Callable[[int], object] = lambda _: None,
    names: Sequence[str] = (),
) -> Evidence:
    """Read photographs at about `SIDE` pixels, and match them.

    Args:
      frames: photographs of the capture.
      reading: how photographs are read; its divisors do not count.
      report: receives the number of photographs that are read.
      names: of photographs; by default those of their files.

    Raises:
      SceneError: a photograph cannot be read, or its size is not what the capture says; unless all
        are turned by a quarter, which their content may explain.
    """

    def measure(frame: Frame) -> tuple[Photo, np.ndarray, Features, np.ndarray]:
        photo = read_small(frame, reading, SIDE)
        gray = cv2.cvtColor(photo.rgb, cv2.COLOR_RGB2GRAY)
        features = find_features(photo.rgb, photo.mask, _FEATURES)
        # Colors are done with.
        return photo._replace(rgb=photo.rgb[:, :, :0]), gray, features, look(photo.rgb, photo.mask)

    done, workers = [], min(MAX_CONCURRENT, os.cpu_count() or 1)  # each decodes at full size
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        for found in pool.map(measure, frames):
            done.append(found)
            report(len(done))
    photos, gray, features, looks = zip(*done, strict=True)
    wrong = next(filter(None, map(wrong_size, photos)), "")
    turned = all(map(is_rotated, photos))
    if wrong and not turned:
        raise SceneError(wrong)
    if turned:  # intrinsics stay those given, of photographs that are not
        photos = [photo._replace(scaled=photo.scaled[::-1]) for photo in photos]
    cameras = Cameras(
        np.stack([frame.camtoworld for frame in frames]),
        np.stack([photo.intrinsics(reading.half_pixel) for photo in photos]),
        np.array([image.shape[::-1] for image in gray]),
    )
    names = names or file_names([frame.file for frame in frames])
    return Evidence(names, cameras, gray, find_matches(features), np.stack(looks), wrong)


def look(rgb: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Measure a photograph's contrast, sharpness, and shares of black and of white pixels `[4]`.

    Contrast is the standard deviation of gray levels, and sharpness that of the Laplacian as a
    share of it.

    Args:
      rgb: `[H, W, 3]` uint8.
      mask: `[H, W]` uint8; pixels below 128 do not count.
    """
    used: np.ndarray = mask >= 128
    if not used.any():
        return np.zeros(4)
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    contrast = float(gray[used].std())
    edges = float(cv2.Laplacian(gray, cv2.CV_32F)[used].std())
    inside = rgb[used]
    black, white = (inside <= 2).all(-1).mean(), (inside >= 253).all(-1).mean()
    return np.array([contrast, edges / max(contrast, 1e-6), black, white])
