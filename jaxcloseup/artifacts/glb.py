"""Pack splats and textured meshes as GLB, the binary form of glTF 2.0.

Splats are points with the attributes of KHR_gaussian_splatting, uncompressed; readers without this
extension show the points. glTF has y up and z backward, so files are turned by 180 degrees around x
against the capture's coordinates, as SPZ files are.
"""

import json
import math
import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxcloseup.artifacts.file_splats import file_splats, with_y_up
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.io.placement import UNMOVED, Placement


_SPLATTING = "KHR_gaussian_splatting"
_UNLIT = "KHR_materials_unlit"
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_FLOAT, _UNSIGNED_INT = 5126, 5125
_POINTS, _TRIANGLES, _LINEAR = 0, 4, 9729


class TexturedMesh(NamedTuple):
    """Triangles, counterclockwise as seen from outside, and their texture.

    Attributes:
      vertices: `[P, 3]` positions in world units.
      faces: `[F, 3]` indices of vertices.
      texture_places: `[P, 2]` places of the vertices in the texture, from its top left corner, 0,
        to its bottom right one, 1.
      texture: bytes of a PNG or JPEG file.
    """

    vertices: np.ndarray
    faces: np.ndarray
    texture_places: np.ndarray
    texture: bytes


def pack_splats_glb(
    surfels: Surfels, alive: jax.Array, *, placement: Placement = UNMOVED
) -> tuple[bytes, int]:
    """Return the surfels that are alive as the bytes of a file.

    Args:
      surfels: `N` surfels, which get a thickness, or volumetric Gaussians.
      alive: `[N]` bool.
      placement: of the surfels in the coordinates to write. By default they stay.

    Returns:
      The bytes, and the number of alive surfels that were dropped because a value is not finite.
    """
    splats, dropped = file_splats(surfels, alive, placement=placement)
    splats = with_y_up(splats)
    color = np.clip(splats.base_colors, 0, 1)
    arrays = {
        "POSITION": splats.means,
        "COLOR_0": np.column_stack([_to_linear(color), splats.opacities]),
        f"{_SPLATTING}:ROTATION": splats.quaternions[:, [1, 2, 3, 0]],
        f"{_SPLATTING}:SCALE": np.exp(splats.log_scales),
        f"{_SPLATTING}:OPACITY": splats.opacities[:, None],
    }
    for degree in range(math.isqrt(splats.sh.shape[1])):
        for order in range(2 * degree + 1):
            name = f"{_SPLATTING}:SH_DEGREE_{degree}_COEF_{order}"
            arrays[name] = splats.sh[:, degree**2 + order]
    extension = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    parts = _Parts()
    attributes = {name: parts.add_floats(array) for name, array in arrays.items()}
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {_SPLATTING: extension}}
    return parts.pack(primitive, placement, extensions=[_SPLATTING]), dropped


def pack_mesh_glb(mesh: TexturedMesh, *, placement: Placement = UNMOVED) -> bytes:
    """Return a mesh as the bytes of a file; its colors are shown as they are, without light.

    Args:
      mesh: the mesh.
      placement: of the mesh in the coordinates to write.
    """
    parts = _Parts()
    vertices = placement.to_file(mesh.vertices) * [1, -1, -1]
    primitive = {
        "attributes": {
            "POSITION": parts.add_floats(vertices),
            "TEXCOORD_0": parts.add_floats(mesh.texture_places),
        },
        "indices": parts.add_indices(mesh.faces),
        "mode": _TRIANGLES,
        "material": 0,
    }
    kind = "png" if mesh.texture.startswith(b"\x89PNG") else "jpeg"
    colored = {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1}
    more = {
        "materials": [{"pbrMetallicRoughness": colored, "extensions": {_UNLIT: {}}}],
        "textures": [{"source": 0, "sampler": 0}],
        # Smaller copies of the texture would mix triangles that only lie together in it.
        "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR}],
        "images": [{"bufferView": parts.add(mesh.texture), "mimeType": f"image/{kind}"}],
    }
    return parts.pack(primitive, placement, extensions=[_UNLIT], more=more)


class _Parts:
    """The parts of a file's one buffer."""

    def __init__(self) -> None:
        self.data: list[bytes] = []
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []
        self.size = 0

    def add(self, data: bytes) -> int:
        """Add bytes; return the number of their view."""
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(data)})
        self.data.append(data + bytes(-len(data) % 4))
        self.size += len(self.data[-1])
        return len(self.views) - 1

    def add_floats(self, array: np.ndarray) -> int:
        """Add an attribute `[M, C]`; return the number of its accessor."""
        array = array.astype("<f4")
        ends = {name: end.tolist() for name, end in _ends(array)}
        return self._add_array(array, _FLOAT, {"type": _TYPES[array.shape[1]], **ends})

    def add_indices(self, faces: np.ndarray) -> int:
        """Add the corners of triangles `[F, 3]`; return the number of their accessor."""
        return self._add_array(faces.reshape(-1).astype("<u4"), _UNSIGNED_INT, {"type": "SCALAR"})

    def _add_array(self, array: np.ndarray, kind: int, about: dict[str, Any]) -> int:
        view = self.add(array.tobytes())
        about |= {"bufferView": view, "componentType": kind, "count": len(array)}
        self.accessors.append(about)
        return len(self.accessors) - 1

    def pack(
        self,
        primitive: Mapping[str, Any],
        placement: Placement,
        *,
        extensions: list[str],
        more: Mapping[str, Any] | None = None,
    ) -> bytes:
        """Return a file that shows one primitive; what coordinates leave out is in its node."""
        node: dict[str, Any] = {"mesh": 0}
        if placement.offset.any():
            node["extras"] = {"offset": placement.offset.tolist()}
        fields = {
            "asset": {"version": "2.0", "generator": "jaxcloseup"},
            "extensionsUsed": extensions,
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [node],
            "meshes": [{"primitives": [primitive]}],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.size}],
            **(more or {}),
        }
        text = json.dumps(fields, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        size = 28 + len(text) + self.size
        head = struct.pack("<4sIII4s", b"glTF", 2, size, len(text), b"JSON")
        return b"".join([head, text, struct.pack("<I4s", self.size, b"BIN\0"), *self.data])


def _ends(array: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Return the smallest and the largest of each component, which positions must state."""
    return [("min", array.min(axis=0)), ("max", array.max(axis=0))] if len(array) else []


def _to_linear(color: np.ndarray) -> np.ndarray:
    """Decode sRGB colors in [0, 1], as IEC 61966-2-1 does."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
