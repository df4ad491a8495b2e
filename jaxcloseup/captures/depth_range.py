"""Estimate the depth range of a scene whose files do not give one."""

from collections.abc import Sequence

import numpy as np


SMALLEST = 1e-6  # in a scene: float32 hardly tells smaller distances from 0
_MAX_POINTS = 20_000


def near_far_from_points(
    points: np.ndarray, camtoworld: np.ndarray, intrinsics: np.ndarray, sizes: np.ndarray
) -> tuple[float, float] | None:
    """Estimate a depth range that holds the points which the cameras see, with a margin.

    Each camera contributes the 1st and 99th percentiles of the depths of points inside its image,
    which ignores stray points. Near is 0.7 of the smallest of these over all cameras and far 1.5 of
    the largest, so that a single close-up counts.

    Args:
      points: `[P, 3]` world points.
      camtoworld: `[V, 3, 4]` OpenCV poses.
      intrinsics: `[V, 4]` fx, fy, cx, cy in pixels.
      sizes: `[V, 2]` image widths and heights in pixels.

    Returns:
      near and far in world units, or None if no camera sees any point.
    """
    points = points[:: max(1, len(points) // _MAX_POINTS)]
    ranges = []
    for pose, lens, size in zip(camtoworld, intrinsics, sizes, strict=True):
        depths = depths_in_view(points, pose, lens, size)
        if len(depths):
            ranges.append(np.percentile(depths, [1, 99]))
    if not ranges:
        return None
    low, high = np.transpose(ranges)
    return 0.7 * float(low.min()), 1.5 * float(high.max())


def depths_in_view(
    points: np.ndarray, camtoworld: np.ndarray, intrinsics: np.ndarray, size: Sequence[int]
) -> np.ndarray:
    """Compute the z-depths `[Q]`, in world units, of the points that lie inside an image.

    Args:
      points: `[P, 3]` world points.
      camtoworld: `[3, 4]` OpenCV pose.
      intrinsics: `[4]` fx, fy, cx, cy in pixels.
      size: image width and height in pixels.
    """
    fx, fy, cx, cy = intrinsics
    x, y, z = ((points.astype(np.float64) - camtoworld[:, 3]) @ camtoworld[:, :3]).T
    x, y, z = x[z > 0], y[z > 0], z[z > 0]
    column, row = fx * x / z + cx, fy * y / z + cy
    return z[(column >= 0) & (column < size[0]) & (row >= 0) & (row < size[1])]


def near_far_from_cameras(camtoworld: np.ndarray) -> tuple[float, float]:
    """Guess near and far from the poses `[V, 3, 4]` of a scene alone.

    The guess assumes that all cameras look at one subject, the point nearest to all optical axes.
    Near is a tenth of the smallest depth of the subject and far four times the largest. If the axes
    are parallel or there is one camera, near and far are 0.1 and 100 times the spread of the
    camera positions (or times 1 if that is 0).
    """
    axes, positions = camtoworld[:, :, 2], camtoworld[:, :, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projects onto the image plane
    total = across.mean(0)
    # The smallest eigenvalue is about the mean squared sine of the angle between the axes.
    if np.linalg.eigvalsh(total)[0] > 1e-4:
        subject = np.linalg.solve(total, np.einsum("vij,vj->i", across, positions) / len(axes))
        depths = np.einsum("vi,vi->v", axes, subject - positions)
        if (depths > SMALLEST).mean() > 0.5:
            depths = depths[depths > SMALLEST]
            return 0.1 * float(depths.min()), 4 * float(depths.max())
    spread = float(np.linalg.norm(positions - positions.mean(0), axis=-1).max())
    spread = spread if spread > SMALLEST else 1.0
    return 0.1 * spread, 100 * spread
