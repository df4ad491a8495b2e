"""Read initial points from PLY files."""

import pathlib
import warnings

import numpy as np

from jaxcloseup.io.ply import PlyError, read_vertices
from jaxcloseup.photos.scene import PointsWarning, SceneError


def read_ply_points(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions `[P, 3]`, float64, and colors `[P, 3]` in [0, 1], float32, of PLY vertices.

    Properties may come in any order, and unknown ones are ignored. Integer colors are divided by
    the maximum of their type; float colors are divided by 255 if any exceeds 1. Without red, green
    and blue, points are mid gray. Points that are not finite are dropped with a warning.

    Raises:
      SceneError: the file is not PLY, is truncated, or its vertices lack x, y, z.
    """
    try:
        vertices = read_vertices(path)
    except PlyError as error:
        raise SceneError(str(error)) from error
    with np.errstate(over="ignore"):  # too large for float32 becomes infinite
        points = np.stack([vertices[axis] for axis in "xyz"], -1).astype(np.float64)
        rgb = _colors(vertices)
    finite = (np.abs(points) <= np.finfo(np.float32).max).all(-1) & np.isfinite(rgb).all(-1)
    if not finite.all():
        count, dropped = len(vertices), (~finite).sum()
        warnings.warn(
            f"{path}: {dropped} of {count} points are not finite and were dropped.",
            PointsWarning,
            stacklevel=2,
        )
    return points[finite], rgb[finite]


def _colors(vertices: np.ndarray) -> np.ndarray:
    names = ["red", "green", "blue"]
    if not set(names) <= set(vertices.dtype.names or ()):
        return np.full((len(vertices), 3), 0.5, np.float32)
    rgb = np.stack([vertices[name] for name in names], -1)
    if rgb.dtype.kind in "iu":
        return rgb.astype(np.float32) / np.iinfo(rgb.dtype).max
    # Float colors should lie in [0, 1], but some programs write 0 to 255.
    return rgb.astype(np.float32) / (255 if (rgb > 1).any() else 1)
