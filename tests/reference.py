"""Slow NumPy float64 oracles, written from the equations and sharing no code with the package."""

import numpy as np


def project(camtoworld, intrinsics, points):
    """Pixels `[N, 2]` and depths `[N]` of world points `[N, 3]`, one at a time."""
    fx, fy, cx, cy = np.asarray(intrinsics, np.float64)
    rotation = np.asarray(camtoworld, np.float64)[:, :3]
    position = np.asarray(camtoworld, np.float64)[:, 3]
    pixels, depths = [], []
    for point in np.asarray(points, np.float64):
        x, y, z = rotation.T @ (point - position)
        pixels.append([fx * x / z + cx, fy * y / z + cy])
        depths.append(z)
    return np.array(pixels), np.array(depths)


def unproject(camtoworld, intrinsics, pixels, depths):
    """World points `[N, 3]` of pixels `[N, 2]` at z-depths `[N]`, one at a time."""
    fx, fy, cx, cy = np.asarray(intrinsics, np.float64)
    rotation = np.asarray(camtoworld, np.float64)[:, :3]
    position = np.asarray(camtoworld, np.float64)[:, 3]
    points = []
    for (x, y), z in zip(np.asarray(pixels, np.float64), np.asarray(depths), strict=True):
        points.append(position + rotation @ np.array([(x - cx) / fx * z, (y - cy) / fy * z, z]))
    return np.array(points)


def forward_warp(values, pixels, depths, shape):
    """Z-buffer, one source after the other: `(values [H, W, C], depth [H, W])`, inf where empty."""
    height, width = shape
    image, buffer = np.zeros((height, width, values.shape[-1])), np.full(shape, np.inf)
    for value, (x, y), depth in zip(values, pixels, depths, strict=True):
        if 0 <= x < width and 0 <= y < height and 0 < depth < buffer[int(y), int(x)]:
            image[int(y), int(x)], buffer[int(y), int(x)] = value, depth
    return image, buffer
