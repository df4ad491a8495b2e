"""Initial points from PLY files."""

import pathlib
import warnings

import numpy as np

from jaxcloseup.scenes.errors import PointsWarning, SceneError


_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply_points(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions `[P, 3]` and colours `[P, 3]` in [0, 1], float32, of a PLY file's vertices.

    Any property order and any further properties are fine. Integer colours are scaled by their
    type's range, floats above 1 by 255; a file without red, green, blue gives mid grey. Points that
    are not finite are dropped with a warning.

    Raises:
      SceneError: not a PLY file, cut short, or vertices without x, y, z.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path} cannot be read ({error.strerror}): restore the file.") from error
    header, end, body = data.partition(b"end_header")
    encoding, count, properties = _parse_header(path, header if end else b"")
    body = body.partition(b"\n")[2]
    dtype = np.dtype([(name, _ORDERS[encoding] + kind) for name, kind in properties])
    short = f"{path} ends before its {count} vertices do: copy or export it again."
    if encoding == "ascii":
        rows = body.split(b"\n")[:count]
        try:
            vertices = np.array([tuple(map(float, row.split())) for row in rows], dtype)
        except ValueError as error:
            raise SceneError(short) from error
        if len(rows) < count:
            raise SceneError(short)
    else:
        if len(body) < count * dtype.itemsize:
            raise SceneError(short)
        vertices = np.frombuffer(body, dtype, count)
    points = np.stack([vertices[axis] for axis in "xyz"], -1).astype(np.float32)
    rgb = _colours(vertices)
    finite = np.isfinite(points).all(-1) & np.isfinite(rgb).all(-1)
    if not finite.all():
        dropped = count - finite.sum()
        warnings.warn(
            f"{path}: {dropped} of {count} points are not finite and were dropped.",
            PointsWarning,
            stacklevel=2,
        )
    return points[finite], rgb[finite]


def _parse_header(path: pathlib.Path, header: bytes) -> tuple[str, int, list[tuple[str, str]]]:
    """Encoding, vertex count and the vertex's (name, type) pairs."""
    lines = [line.split() for line in header.decode("latin-1").splitlines() if line.split()]
    encodings = [line[1] for line in lines if line[0] == "format" and len(line) > 1]
    elements = [index for index, line in enumerate(lines) if line[0] == "element"]
    if not lines or lines[0] != ["ply"] or not encodings or encodings[0] not in _ORDERS:
        raise SceneError(
            f"{path} is not a PLY file: replace it, or remove it to do without points."
        )
    vertex = lines[elements[0] : [*elements, len(lines)][1]] if elements else [[""]]
    try:
        if vertex[0][:2] != ["element", "vertex"]:
            raise KeyError("vertex")
        properties = [(line[2], _TYPES[line[1]]) for line in vertex if line[0] == "property"]
        if not {"x", "y", "z"} <= {name for name, _ in properties}:
            raise KeyError("x, y, z")
        return encodings[0], int(vertex[0][2]), properties
    except (KeyError, IndexError, ValueError) as error:
        raise SceneError(
            f"{path} does not begin with vertices of plain properties x, y, z ({error}): export it "
            "again as a point cloud."
        ) from error


def _colours(vertices: np.ndarray) -> np.ndarray:
    names = ["red", "green", "blue"]
    if not set(names) <= set(vertices.dtype.names):
        return np.full((len(vertices), 3), 0.5, np.float32)
    rgb = np.stack([vertices[name] for name in names], -1)
    if rgb.dtype.kind in "iu":
        return rgb.astype(np.float32) / np.iinfo(rgb.dtype).max
    # Floats are meant to lie in [0, 1], but some programs write bytes' values as floats.
    return rgb.astype(np.float32) / (255 if (rgb > 1).any() else 1)
