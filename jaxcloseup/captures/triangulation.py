"""Triangulate points for captures that have poses but no points.

Match SIFT features between neighboring photographs, and triangulate each match with the known
poses. Drop matches that reproject badly or whose rays are nearly parallel.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from jaxcloseup.captures.depth_range import SMALLEST
from jaxcloseup.captures.sift import find_features, match_features


_NEIGHBORS = 4
# Cosine of the widest angle between optical axes; SIFT finds few matches beyond 40 degrees.
_MIN_AXIS_COSINE = np.cos(np.radians(60))
_MAX_ERROR = 2.0  # in pixels
_MIN_ANGLE = np.radians(1.5)  # between rays; below it, depth is unreliable


class Triangulated(NamedTuple):
    """Points that two photographs both show; P may be 0."""

    points: np.ndarray  # `[P, 3]` float32 world points
    rgb: np.ndarray  # `[P, 3]` float32 colors in [0, 1]
    views: np.ndarray  # `[P, 2]` indices of the photographs


def triangulate(
    images: Sequence[np.ndarray],
    masks: Sequence[np.ndarray],
    camtoworld: np.ndarray,
    intrinsics: np.ndarray,
) -> Triangulated:
    """Triangulate points that two neighboring photographs both show.

    A surface point may appear once per pair of photographs.

    Args:
      images: uint8 pinhole photographs `[H, W, 3]`; sizes may differ.
      masks: uint8 masks `[H, W]`; features are used where the mask is at least 128.
      camtoworld: `[V, 3, 4]` OpenCV poses in a scene.
      intrinsics: `[V, 4]` fx, fy, cx, cy in pixels.
    """
    found = [find_features(image, mask) for image, mask in zip(images, masks, strict=True)]
    points, colors, views = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros((0, 2), int)]
    for i, j in _neighbors(camtoworld):
        first, second = match_features(found[i].descriptors, found[j].descriptors)
        pixels = found[i].pixels[first], found[j].pixels[second]
        world, good = _intersect(pixels, camtoworld[[i, j]], intrinsics[[i, j]])
        points.append(world[good])
        colors.append(found[i].rgb[first][good])
        views.append(np.tile([i, j], (good.sum(), 1)))
    return Triangulated(
        np.concatenate(points).astype(np.float32),
        np.concatenate(colors).astype(np.float32) / 255,
        np.concatenate(views),
    )


def _neighbors(camtoworld: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield each pair of neighboring views once: close positions, similar directions."""
    axes, positions = camtoworld[:, :, 2], camtoworld[:, :, 3]
    away = np.linalg.norm(positions[:, None] - positions, axis=-1)
    # Rotation in place shows no depth, and a view is not its own neighbor.
    fit = (axes @ axes.T > _MIN_AXIS_COSINE) & (away > SMALLEST)
    order = np.argsort(np.where(fit, away, np.inf), axis=1, kind="stable")[:, :_NEIGHBORS]
    pairs = {
        (min(i, j), max(i, j)) for i, row in enumerate(order.tolist()) for j in row if fit[i, j]
    }
    yield from sorted(pairs)


def _intersect(
    pixels: tuple[np.ndarray, np.ndarray], camtoworld: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Intersect rays through pixel pairs `[M, 2]`: points `[M, 3]` and validity `[M]`."""
    if not len(pixels[0]):
        return np.zeros((0, 3)), np.zeros(0, bool)
    # Work relative to the first camera in units of the baseline, to keep precision far from 0.
    origin = camtoworld[0, :, 3]
    unit = np.linalg.norm(camtoworld[1, :, 3] - origin)
    rotations = camtoworld[:, :, :3]
    positions = (camtoworld[:, :, 3] - origin) / unit
    normalized = [(p - k[2:]) / k[:2] for p, k in zip(pixels, intrinsics, strict=True)]
    matrices = [np.column_stack([r.T, -r.T @ c]) for r, c in zip(rotations, positions, strict=True)]
    homogeneous = cv2.triangulatePoints(*matrices, *(x.T.astype(np.float64) for x in normalized)).T
    scale = homogeneous[:, 3:]
    local = homogeneous[:, :3] / np.where(np.abs(scale) < 1e-12, 1e-12, scale)
    good = np.isfinite(local).all(-1)
    for x, k, r, c in zip(normalized, intrinsics, rotations, positions, strict=True):
        camera = (local - c) @ r
        depth = np.where(camera[:, 2] > 1e-6, camera[:, 2], 1e-6)
        error = np.linalg.norm((camera[:, :2] / depth[:, None] - x) * k[:2], axis=-1)
        good &= (camera[:, 2] > 1e-6) & (error < _MAX_ERROR)
    a, b = local - positions[0], local - positions[1]
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, -1))
    return local * unit + origin, good & (angle > _MIN_ANGLE)
