"""Find SIFT features of photographs, and match them."""

from typing import NamedTuple

import cv2
import numpy as np


_LONGEST_SIDE = 1600  # in pixels; larger photographs are searched at this size
_MAX_FEATURES = 2000  # per photograph; matching cost grows with their square
_RATIO = 0.8  # best over second-best match distance, as in Lowe (2004)


class Features(NamedTuple):
    """Features of one photograph, in no order.

    Descriptors and colors are uint8 to save memory; SIFT's descriptors are integers anyway.
    """

    pixels: np.ndarray  # `[F, 2]` positions in pixels
    descriptors: np.ndarray  # `[F, 128]` uint8
    rgb: np.ndarray  # `[F, 3]` uint8 colors
    strengths: np.ndarray  # `[F]` responses of the detector


def find_features(image: np.ndarray, mask: np.ndarray, most: int = _MAX_FEATURES) -> Features:
    """Find the features of a photograph.

    Args:
      image: uint8 photograph `[H, W, 3]`.
      mask: uint8 mask `[H, W]`; features are used where it is at least 128.
      most: largest number of features, the strongest.
    """
    height, width = image.shape[:2]
    scale = min(1.0, _LONGEST_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale < 1 else image
    usable = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) if scale < 1 else mask
    # Without precise upscaling OpenCV's keypoints are a quarter of a pixel off.
    sift = cv2.SIFT.create(nfeatures=most, enable_precise_upscale=True)
    gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = sift.detectAndCompute(gray, np.uint8(255) * (usable >= 128))
    if not keypoints:
        nothing = np.zeros((0, 128), np.uint8)
        return Features(np.zeros((0, 2)), nothing, np.zeros((0, 3), np.uint8), np.zeros(0))
    # OpenCV puts pixel centers at integers, we at half-integers.
    pixels = (np.array([point.pt for point in keypoints]) + 0.5) / size * [width, height]
    column, row = np.clip(pixels.astype(int), 0, [width - 1, height - 1]).T
    strengths = np.array([point.response for point in keypoints])
    return Features(pixels, descriptors.astype(np.uint8), image[row, column], strengths)


def match_features(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Match descriptors that are mutually best and pass the ratio test.

    Args:
      a: `[F, 128]` uint8 descriptors.
      b: `[G, 128]` uint8 descriptors.

    Returns:
      Indices `[M]` into both.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    similar = unit_descriptors(a) @ unit_descriptors(b).T
    first, best = np.arange(len(a)), similar.argmax(1)
    mutual = similar.argmax(0)[best] == first
    highest = similar[first, best]
    similar[first, best] = -1
    nearest, second = (np.sqrt(np.maximum(2 - 2 * s, 0)) for s in (highest, similar.max(1)))
    keep = mutual & (nearest < _RATIO * second)
    return first[keep], best[keep]


def unit_descriptors(descriptors: np.ndarray) -> np.ndarray:
    """Return descriptors `[F, 128]` as float32 of length 1."""
    lengths = np.linalg.norm(descriptors.astype(np.float32), axis=1, keepdims=True)
    return descriptors / np.maximum(lengths, 1)
