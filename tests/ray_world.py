"""A world at infinity whose colors are a function of the ray direction, for tests of cameras.

`photograph` renders what a capture's file describes; `seen` predicts what loaded cameras show.
"""

import numpy as np


SIZE = (47, 35)
LENS = {"fx": 41.0, "fy": 43.0, "cx": 22.3, "cy": 18.6}


def colors(directions):
    """Return colors `[..., 3]` from 0 to 255; neighboring pixels differ by about 30."""
    x, y, z = np.moveaxis(directions / np.linalg.norm(directions, axis=-1, keepdims=True), -1, 0)
    waves = [np.sin(19 * x + 3 * z), np.sin(17 * y + 5 * x), np.sin(13 * (x + y + z))]
    return 127.5 + 120 * np.stack(waves, -1)


def turned(angle):
    """Return an OpenGL pose, rotated about y and translated."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, 0, sin, angle], [0, 1, 0, 2], [-sin, 0, cos, 0], [0, 0, 0, 1]])


def photograph(pose, lens=LENS, size=SIZE, first=0.5):
    """Render the capture's camera; `first` is the coordinate of the first pixel's center."""
    column, row = np.meshgrid(first + np.arange(size[0]), first + np.arange(size[1]))
    x, y = (column - lens["cx"]) / lens["fx"], (row - lens["cy"]) / lens["fy"]
    return np.rint(colors(np.stack([x, -y, -np.ones_like(x)], -1) @ pose[:3, :3].T)).astype("u1")


def seen(cameras, index, offsets=((0.0, 0.0),)):
    """Return mean colors `[H, W, 3]` along a camera's rays through pixel centers plus offsets."""
    pose = np.asarray(cameras.camtoworld, np.float64)[index]
    fx, fy, cx, cy = np.asarray(cameras.intrinsics, np.float64)[index]
    column, row = np.meshgrid(np.arange(cameras.width) + 0.5, np.arange(cameras.height) + 0.5)
    ahead = [
        np.stack([(column + x - cx) / fx, (row + y - cy) / fy, np.ones_like(row)], -1)
        for x, y in offsets
    ]
    return np.mean([colors(directions @ pose[:, :3].T) for directions in ahead], 0)
