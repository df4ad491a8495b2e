"""Triangle meshes of surfaces: marching cubes over a grid of distances, and PLY files."""

import pathlib
from typing import NamedTuple

import numpy as np

from jaxcloseup.io.placement import UNMOVED, Placement
from jaxcloseup.io.ply import write_vertices


class Mesh(NamedTuple):
    """Triangles, counterclockwise as seen from outside.

    Attributes:
      vertices: `[P, 3]` float32 positions in world units.
      faces: `[F, 3]` int32 indices of vertices.
      rgb: `[P, 3]` uint8 colors.
    """

    vertices: np.ndarray
    faces: np.ndarray
    rgb: np.ndarray


def surface_mesh(
    distance: np.ndarray, corner: np.ndarray, voxel: float, *, steepest: float = np.inf
) -> Mesh:
    """Extract the surface where distances on a grid are 0, by marching cubes, in black.

    Args:
      distance: `[X, Y, Z]` signed distances, positive outside; NaN where they are unknown, and
        there the surface ends.
      corner: `[3]` position of `distance[0, 0, 0]`.
      voxel: distance between neighbors in world units.
      steepest: largest difference between neighbors; the surface has a hole where two differ more.
    """
    from skimage.measure import marching_cubes

    known = np.isfinite(distance)
    inside = np.where(known, distance, 1)
    if not (inside < 0).any() or not (inside > 0).any():
        return Mesh(np.zeros((0, 3), "f4"), np.zeros((0, 3), "i4"), np.zeros((0, 3), "u1"))
    places, faces, *_ = marching_cubes(inside, 0.0, mask=known)
    # A vertex lies between two neighbors of the grid, or, rarely, inside of a cube.
    ends = [tuple(half(places).astype(int).T) for half in (np.floor, np.ceil)]
    good = known[ends[0]] & known[ends[1]]
    good &= np.abs(inside[ends[0]] - inside[ends[1]]) <= steepest
    faces = faces[good[faces].all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    vertices = (np.asarray(corner) + voxel * places[used]).astype(np.float32)
    return Mesh(vertices, faces.reshape(-1, 3).astype(np.int32), np.zeros(vertices.shape, np.uint8))


def write_mesh(path: str | pathlib.Path, mesh: Mesh, placement: Placement = UNMOVED) -> None:
    """Write a mesh as a binary PLY file with colors of vertices, whole or not at all.

    Args:
      path: path of the file.
      mesh: the mesh.
      placement: of the mesh in the coordinates to write, see `Placement.to_file`.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    names = [(name, "f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(mesh.vertices), names)
    vertices = placement.to_file(mesh.vertices)
    for i, (name, _) in enumerate(names):
        rows[name] = (vertices if i < 3 else mesh.rgb)[:, i % 3]
    write_vertices(path, rows, mesh.faces, offset=placement.offset)
