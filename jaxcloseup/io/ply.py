"""Vertices in PLY files, as NumPy structured arrays, and triangles beside them."""

import pathlib
from collections.abc import Sequence

import numpy as np

from jaxcloseup.io.files import read_bytes, write_file
from jaxcloseup.io.messages import printable


_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class PlyError(ValueError):
    """A PLY file cannot be read. The message is one sentence that says what to do."""

    def __init__(self, message: str) -> None:
        """Escape what a terminal would obey in what files say."""
        super().__init__(printable(message))


def read_vertices(path: str | pathlib.Path) -> np.ndarray:
    """Read the vertices of a PLY file, in any encoding, with any plain properties in any order.

    Raises:
      PlyError: the file is missing, is cut short, has more than 1 GiB, is not PLY, or its vertices
        have no x, y, z.
    """
    path = pathlib.Path(path)
    try:
        data = read_bytes(path)
    except OSError as error:
        raise PlyError(f"{path} cannot be read ({error.strerror}): restore the file.") from error
    end = data.find(b"end_header")
    encoding, count, properties = _parse_header(path, data[: max(end, 0)])
    start = data.find(b"\n", end) + 1 or len(data)
    dtype = np.dtype([(name, _ORDERS[encoding] + kind) for name, kind in properties])
    short = f"{path} ends before its {count} vertices do: copy or export it again."
    # Text has at least a digit and a separator for each number, except the last.
    smallest = 2 * count * len(properties) - 1 if encoding == "ascii" else count * dtype.itemsize
    if len(data) - start < smallest:
        raise PlyError(short)
    if encoding == "ascii":
        rows = data[start:].split(b"\n", count)[:count]
        try:
            with np.errstate(over="ignore"):  # too large for its type is infinite, as in binary
                vertices = np.array([tuple(map(float, row.split())) for row in rows], dtype)
        except (ValueError, OverflowError) as error:
            whole = all(len(row.split()) == len(properties) for row in rows)
            words = (
                f"{path} has words instead of numbers in its vertices, or numbers beyond their "
                "type: export it again."
            )
            raise PlyError(words if whole else short) from error
        if len(rows) < count:
            raise PlyError(short)
        return vertices
    return np.frombuffer(data, dtype, count, start)


def write_vertices(
    path: str | pathlib.Path,
    vertices: np.ndarray,
    faces: np.ndarray | None = None,
    *,
    offset: Sequence[float] | np.ndarray = (0, 0, 0),
) -> None:
    """Write a structured array `[P]` as a binary little-endian PLY file, whole or not at all.

    Args:
      path: path of the file.
      vertices: `[P]`; its fields become properties.
      faces: `[F, 3]` indices of the vertices of triangles; None writes no such element.
      offset: `[3]` shift that the coordinates leave out, which a comment says if it is not 0.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    names = vertices.dtype.names or ()
    fields = [(name, vertices.dtype[name].str[1:]) for name in names]
    lines = [*header_lines(offset), f"element vertex {len(vertices)}"]
    lines += [f"property {_NAMES[kind]} {name}" for name, kind in fields]
    data = vertices.astype([(name, "<" + kind) for name, kind in fields]).tobytes()
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles = np.empty(len(faces), [("count", "u1"), ("indices", "<i4", 3)])
        triangles["count"], triangles["indices"] = 3, faces
        data += triangles.tobytes()
    write_file(path, "\n".join([*lines, "end_header\n"]).encode() + data)


def header_lines(offset: Sequence[float] | np.ndarray) -> list[str]:
    """Return the first lines of a binary file, whose coordinates leave out an offset `[3]`."""
    lines = ["ply", "format binary_little_endian 1.0"]
    if any(offset):
        lines += ["comment add offset " + " ".join(f"{value:.15g}" for value in offset)]
    return lines


def _parse_header(path: pathlib.Path, header: bytes) -> tuple[str, int, list[tuple[str, str]]]:
    """Read encoding, vertex count and the vertex's (name, type) pairs."""
    lines = [line.split() for line in header.decode("latin-1").splitlines() if line.split()]
    encodings = [line[1] for line in lines if line[0] == "format" and len(line) > 1]
    elements = [index for index, line in enumerate(lines) if line[0] == "element"]
    if not lines or lines[0] != ["ply"] or not encodings or encodings[0] not in _ORDERS:
        raise PlyError(f"{path} is not a PLY file: replace it, or remove it to do without points.")
    vertex = lines[elements[0] : [*elements, len(lines)][1]] if elements else [[""]]
    try:
        if vertex[0][:2] != ["element", "vertex"]:
            raise KeyError("vertex")
        properties = [(line[2], _TYPES[line[1]]) for line in vertex if line[0] == "property"]
        names = [name for name, _ in properties]
        if not {"x", "y", "z"} <= set(names):
            raise KeyError("x, y, z")
        if len(set(names)) < len(names):
            raise ValueError("a property name appears twice")
        count = int(vertex[0][2])
        if count < 0:
            raise ValueError(f"a count of {count}")
        return encodings[0], count, properties
    except (KeyError, IndexError, ValueError) as error:
        raise PlyError(
            f"{path} does not begin with vertices of plain properties x, y, z ({error}): export it "
            "again as a point cloud."
        ) from error
