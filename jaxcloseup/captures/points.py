"""Read initial points from PLY files."""

import pathlib
import warnings

import numpy as np

from jaxcloseup.io.ply import PlyError, read_vertices
from jaxcloseup.photos.scene import PointsWarning, SceneError


_CHANNELS = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
_HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")  # of degree 0, in files of splats
_HARMONIC = 0.28209479177387814  # the spherical harmonic of degree 0, 1 / sqrt(4 pi)


def read_ply_points(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Read positions `[P, 3]`, float64, and colors `[P, 3]` in [0, 1], float32, of PLY vertices.

    Properties may come in any order, and unknown ones are ignored. Colors are red, green and blue,
    also as diffuse_red or r, or splats' harmonics f_dc. Integer colors are divided by the maximum
    of their type, or by 255 if none exceeds it; float colors are divided by 255 if any exceeds 1.
    Without any, points are mid gray, which a note says. Points that are not finite are dropped with
    a warning.

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
    notes: tuple[str, ...] = ()
    if rgb is None:
        rgb = np.full((len(vertices), 3), 0.5, np.float32)
        notes = (f"{path.name} has no colors: its points are gray",) if len(vertices) else ()
    finite = (np.abs(points) <= np.finfo(np.float32).max).all(-1) & np.isfinite(rgb).all(-1)
    if not finite.all():
        count, dropped = len(vertices), (~finite).sum()
        warnings.warn(
            f"{path}: {dropped} of {count} points are not finite and were dropped.",
            PointsWarning,
            stacklevel=2,
        )
    return points[finite], rgb[finite], notes


def _colors(vertices: np.ndarray) -> np.ndarray | None:
    held = set(vertices.dtype.names or ())
    names = next((names for names in _CHANNELS if held.issuperset(names)), None)
    if names is None:
        if not held.issuperset(_HARMONICS):
            return None
        harmonics = np.stack([vertices[name] for name in _HARMONICS], -1).astype(np.float32)
        return np.clip(0.5 + _HARMONIC * harmonics, 0, 1)
    rgb = np.stack([vertices[name] for name in names], -1)
    if rgb.dtype.kind in "iu":  # some programs write 0 to 255 in fields of 16 bits
        most = np.iinfo(rgb.dtype).max
        return rgb.astype(np.float32) / (255 if most > 255 and not (rgb > 255).any() else most)
    # Float colors should lie in [0, 1], but some programs write 0 to 255.
    return rgb.astype(np.float32) / (255 if (rgb > 1).any() else 1)
