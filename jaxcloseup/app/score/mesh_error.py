"""Measure how far a mesh is from the exact surface that a scene's training photographs see."""

import numpy as np
from scipy.spatial import KDTree

from jaxcloseup.artifacts.mesh_files import Mesh


CLOSE = 0.01  # of the extent
_POINTS = 1_000_000  # on each of the two surfaces


def mesh_error(mesh: Mesh, exact: np.ndarray) -> dict[str, float]:
    """Return distances between a mesh and points of the exact surface, drawn with a fixed seed.

    Points of the mesh are drawn uniformly over its area. Points have gaps, so a perfect mesh has
    distances of about half a gap.

    Args:
      mesh: at least one triangle.
      exact: `[P, 3]` points of the exact surface.

    Returns:
      In world units `extent`, the longest side of the box around `exact`; `mesh_to_surface` and
      `surface_to_mesh`, the mean distances from points of one to the nearest of the other; and
      their mean `chamfer`. `mesh_close` and `surface_close` are the shares of points within `CLOSE`
      times the extent of the other surface.
    """
    rng = np.random.default_rng(0)
    drawn = sample_mesh(rng, mesh, _POINTS)
    exact = exact[rng.permutation(len(exact))[:_POINTS]]
    there, back = KDTree(exact).query(drawn)[0], KDTree(drawn).query(exact)[0]
    extent = float(np.ptp(exact, axis=0).max())
    return {
        "extent": extent,
        "chamfer": float(there.mean() + back.mean()) / 2,
        "mesh_to_surface": float(there.mean()),
        "surface_to_mesh": float(back.mean()),
        "mesh_close": float(np.mean(there <= CLOSE * extent)),
        "surface_close": float(np.mean(back <= CLOSE * extent)),
    }


def sample_mesh(rng: np.random.Generator, mesh: Mesh, count: int) -> np.ndarray:
    """Draw points `[count, 3]`, uniform over the area of a mesh."""
    first, second, third = np.moveaxis(mesh.vertices[mesh.faces].astype(np.float64), 1, 0)
    area = np.linalg.norm(np.cross(second - first, third - first), axis=-1)
    face = rng.choice(len(area), count, p=area / area.sum())
    # Reflecting a point of the parallelogram at its diagonal moves it into the triangle.
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, (1 - u, 1 - v), (u, v))
    return first[face] + u * (second - first)[face] + v * (third - first)[face]
