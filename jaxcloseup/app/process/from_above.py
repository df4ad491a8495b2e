"""Draw cameras and points of a capture from above."""

import io

import matplotlib


matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection
from matplotlib.ticker import MaxNLocator


_MOST_POINTS = 20_000


def draw_cameras(poses: np.ndarray, points: np.ndarray, rgb: np.ndarray) -> bytes:
    """Draw cameras and points from above, and return a PNG.

    Up is as perpendicular as possible to the cameras' horizontal axes, since few people tilt a
    camera sideways.

    Args:
      poses: `[V, 3, 4]` OpenCV poses.
      points: `[P, 3]` world points; P may be 0.
      rgb: `[P, 3]` their colors in [0, 1].
    """
    plane = _horizontal(poses[:, :, :3])
    count = len(points)
    if count > _MOST_POINTS:
        some = np.linspace(0, count - 1, _MOST_POINTS).astype(int)
        points, rgb = points[some], rgb[some]
    flat, cameras = points @ plane.T, poses[:, :, 3] @ plane.T
    forward = poses[:, :, 2] @ plane.T
    low, high = np.min(cameras, 0), np.max(cameras, 0)
    if len(flat):
        near, far = np.percentile(flat, [2, 98], axis=0)
        low, high = np.minimum(low, near), np.maximum(high, far)
    side = float(max(high - low)) or 1.0  # one camera, or all in one place
    figure, axes = plt.subplots(figsize=(8, 8), layout="constrained")
    axes.scatter(flat[:, 0], flat[:, 1], s=3, c=np.clip(rgb, 0, 1), linewidths=0)
    length = side / 25
    across = forward[:, ::-1] * [-1, 1]
    wedges = [
        np.stack([c + length * (f - a / 3), c, c + length * (f + a / 3)])
        for c, f, a in zip(cameras, forward, across, strict=True)
    ]
    order = np.arange(len(cameras))
    axes.add_collection(LineCollection(wedges, array=order, cmap="viridis", linewidths=1))
    shown = axes.scatter(cameras[:, 0], cameras[:, 1], s=14, c=order, cmap="viridis", zorder=3)
    ticks = MaxNLocator(integer=True)
    figure.colorbar(shown, ax=axes, shrink=0.6, label="photographs, by name", ticks=ticks)
    middle = (low + high) / 2
    axes.set_xlim(middle[0] - 0.56 * side, middle[0] + 0.56 * side)
    axes.set_ylim(middle[1] - 0.56 * side, middle[1] + 0.56 * side)
    axes.set_aspect("equal")
    axes.set_title(f"{len(poses)} cameras and {count:,} points from above")
    axes.set_xlabel("units of the capture")
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110, metadata={"Software": None})
    plt.close(figure)
    return file.getvalue()


def _horizontal(rotations: np.ndarray) -> np.ndarray:
    """Return horizontal axes `[2, 3]`, x to the right, for rotations `[V, 3, 3]` to the world."""
    right, up = rotations[:, :, 0], -rotations[:, :, 1].mean(0)
    values, vectors = np.linalg.eigh(right.T @ right)
    # Horizontal axes of cameras that look the same way are alike and leave up open: take their own.
    axis = vectors[:, 0] if values[0] < values[1] / 4 else up / np.linalg.norm(up)
    axis = axis * np.sign(axis @ up)
    mean = right.mean(0) - axis * (axis @ right.mean(0))
    if np.linalg.norm(mean) < 1e-3:  # a full circle
        mean = right[0] - axis * (axis @ right[0])
    x = mean / np.linalg.norm(mean)
    return np.stack([x, np.cross(axis, x)])
