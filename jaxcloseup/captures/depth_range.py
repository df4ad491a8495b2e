"""The depth range of a scene whose files do not give one."""

from collections.abc import Sequence

import numpy as np


_MOST_POINTS = 20_000


def near_far_from_points(
    points: np.ndarray, camtoworld: np.ndarray, intrinsics: np.ndarray, sizes: np.ndarray
) -> tuple[float, float] | None:
    """A depth range that holds what the cameras see of the points, with a margin.

    In each camera the 1st and 99th percentiles of the depths of the points inside its image, so
    that stray points do not count; then the extremes over cameras, so that one close-up does. Near
    is 0.7 of the one, far 1.5 of the other.

    Args:
      points: `[P, 3]` world points.
      camtoworld: `[V, 3, 4]` OpenCV poses.
      intrinsics: `[V, 4]` fx, fy, cx, cy.
      sizes: `[V, 2]` width and height of each image.

    Returns:
      near and far, or None where no camera sees any point.
    """
    points = points[:: max(1, len(points) // _MOST_POINTS)]
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
    points: np.ndarray,
    camtoworld: np.ndarray,
    intrinsics: np.ndarray,
    size: Sequence[int],
) -> np.ndarray:
    """z-depths, in world units, of those of `points` `[P, 3]` that lie inside an image.

    Args:
      points: of the world.
      camtoworld: `[3, 4]` OpenCV pose.
      intrinsics: `[4]` fx, fy, cx, cy.
      size: width and height in pixels.
    """
    fx, fy, cx, cy = intrinsics
    x, y, z = ((points.astype(np.float64) - camtoworld[:, 3]) @ camtoworld[:, :3]).T
    x, y, z = x[z > 0], y[z > 0], z[z > 0]
    column, row = fx * x / z + cx, fy * y / z + cy
    return z[(column >= 0) & (column < size[0]) & (row >= 0) & (row < size[1])]


def near_far_from_cameras(camtoworld: np.ndarray) -> tuple[float, float]:
    """A guess from poses `[V, 3, 4]` alone.

    They are taken to look at one subject: the point nearest to all their optical axes. Near is a
    tenth of the least distance to it and far four times the greatest. Where the axes are parallel,
    or there is one camera, the unit is the cameras' own spread (or 1): 0.1 and 100 of it.
    """
    axes, positions = camtoworld[:, :, 2], camtoworld[:, :, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projects onto the plane of an image
    total = across.mean(0)
    # The least eigenvalue is about the mean squared sine of the angle between the axes.
    if np.linalg.eigvalsh(total)[0] > 1e-4:
        subject = np.linalg.solve(total, np.einsum("vij,vj->i", across, positions) / len(axes))
        depths = np.einsum("vi,vi->v", axes, subject - positions)
        if (depths > 0).mean() > 0.5:
            depths = depths[depths > 0]
            return 0.1 * float(depths.min()), 4 * float(depths.max())
    spread = float(np.linalg.norm(positions - positions.mean(0), axis=-1).max()) or 1.0
    return 0.1 * spread, 100 * spread
