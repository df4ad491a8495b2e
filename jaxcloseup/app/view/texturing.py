"""A mesh's texture from the photographs: every triangle has texels of its own.

A square cell of the texture holds two triangles, in halves that a diagonal parts. Triangles are in
groups that face alike, and each group is seen as by a camera in that direction.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.artifacts.glb import TexturedMesh
from jaxcloseup.artifacts.images import encode_jpeg, to_uint8
from jaxcloseup.artifacts.mesh_files import Mesh
from jaxcloseup.detail.add import Detail
from jaxcloseup.geometry.cameras import Camera, points_to_pixels
from jaxcloseup.photos.gather import gather
from jaxcloseup.photos.gather_sums import GatherSettings


# Few photographs, the ones that face a surface, and only where their depth confirms it: sharp.
_SETTINGS = GatherSettings(tolerance=0.02, angle_scale=0.05)
_MARGIN = 1  # texels around triangles: renderers read a little beyond their sides
_SMALLEST = 7  # side of a cell; its triangles span 5 texels less, for margins and the diagonal
_TEXELS = 2**18  # about how many are colored together
_NEAREST = 0.9  # share of surfaces that are farther than those that decide how fine texels are
_FAR = 4.0  # distance of the cameras that look at the mesh, in its radii

_project = jax.jit(points_to_pixels)


class TextureError(Exception):
    """A mesh has too many triangles for a texture. The message is one sentence."""


class Atlas(NamedTuple):
    """Where triangles are in a texture.

    Attributes:
      side: side of a cell in texels.
      columns: cells in a row.
      triangles: `[cells, 2]` numbers of the triangles in a cell; one that is alone is there twice.
      facing: `[cells, 3]` the direction, one of 26, that the triangles of a cell face.
    """

    side: int
    columns: int
    triangles: np.ndarray
    facing: np.ndarray


def texture_mesh(mesh: Mesh, atlas: Atlas, detail: Detail) -> TexturedMesh:
    """Return a mesh with a texture of the photographs' colors.

    What no photograph shows has the colors of the mesh's vertices.

    Args:
      mesh: `F` triangles in world units.
      atlas: where they are in the texture; its cells are made no larger than photographs need.
      detail: photographs of the scene, with their depth.
    """
    corners, colors = mesh.vertices[mesh.faces].astype(np.float64), mesh.rgb[mesh.faces] / 255
    edge = float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))
    finest = _SMALLEST + math.ceil(edge / _finest_pixel(detail))
    atlas = atlas._replace(side=min(finest, atlas.side))
    shares, half = texel_shares(atlas.side)
    together = max(1, _TEXELS // atlas.side**2)
    texture = np.zeros((len(atlas.triangles), atlas.side, atlas.side, 3), np.uint8)
    begins = [0, *(np.flatnonzero(np.any(np.diff(atlas.facing, axis=0), axis=1)) + 1)]
    ends = [*begins[1:], len(texture)]
    batches = [
        np.arange(start, min(start + together, end))
        for begin, end in zip(begins, ends, strict=True)
        for start in range(begin, end, together)
    ]
    for cells in progress.track(batches, "coloring the texture"):
        triangles = atlas.triangles[cells][:, half]
        points = np.einsum("ijk,cijkx->cijx", shares, corners[triangles])
        texels = np.einsum("ijk,cijkx->cijx", shares, colors[triangles])
        rgb, seen = _photographed(points, atlas.facing[cells[0]], mesh, detail, together)
        rgb = np.where(seen[..., None], rgb, texels).reshape(-1, atlas.side, 3)
        texture[cells] = to_uint8(rgb).reshape(texels.shape)
    return TexturedMesh(
        vertices=corners.reshape(-1, 3),
        faces=np.arange(3 * len(corners)).reshape(-1, 3),
        texture_places=texture_places(atlas),
        texture=encode_jpeg(_in_rows(texture, atlas)),
    )


def _finest_pixel(detail: Detail) -> float:
    """Return the side of a photograph's pixel on surfaces that are among the nearest."""
    nearest = np.asarray(jnp.nanquantile(_known(detail.sources.inverse_depth), _NEAREST))
    return 1 / max(float(nearest) * float(np.median(detail.shown.intrinsics[:, 0, 0])), 1e-30)


def _known(inverse_depth: jax.Array) -> jax.Array:
    return jnp.where(inverse_depth > 0, inverse_depth, jnp.nan)


def lay_out(mesh: Mesh, size: int) -> Atlas:
    """Return an atlas for a texture of at most `size` texels a side.

    Raises:
      TextureError: the mesh has too many triangles.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = np.rint(normals / np.maximum(np.abs(normals).max(axis=1, keepdims=True), 1e-30))
    facing[~facing.any(axis=1), 2] = 1  # triangles without area
    _, group = np.unique(facing, axis=0, return_inverse=True)
    order = np.lexsort([_along_curve(corners.mean(axis=1)), group.reshape(-1)])
    counts = np.bincount(group.reshape(-1))
    pairs = []
    for triangles in np.split(order, np.cumsum(counts)[:-1]):
        pairs.append(np.append(triangles, triangles[-1:] if len(triangles) % 2 else []))
    triangles = np.concatenate(pairs).astype(np.int64).reshape(-1, 2)
    columns = int(np.ceil(np.sqrt(len(triangles))))
    if size // columns < _SMALLEST:
        raise TextureError(
            f"--texture={size} has no room for {len(corners)} triangles: choose at least "
            f"{_SMALLEST * columns}, or a smaller --resolution"
        )
    return Atlas(size // columns, columns, triangles, facing[triangles[:, 0]])


def texel_shares(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the shares of corners in a cell's texels, `[side, side, 3]`, and which half they are.

    The first triangle has its right angle near the top left texel, the second near the bottom right
    one. Texels beyond their sides continue the triangles' planes.
    """
    y, x = np.mgrid[:side, :side]
    half = (x + y >= side).astype(int)
    second, third = (np.where(half, side - 1 - place, place) - _MARGIN for place in (x, y))
    second, third = second / _span(side), third / _span(side)
    return np.stack([1 - second - third, second, third], axis=-1), half


def _span(side: int) -> int:
    return side - 3 - 2 * _MARGIN


def texture_places(atlas: Atlas) -> np.ndarray:
    """Return the places `[3 F, 2]` of the corners of all triangles, in [0, 1]."""
    side, columns = atlas.side, atlas.columns
    rows = -(-len(atlas.triangles) // columns)
    cells = np.stack(np.divmod(np.arange(len(atlas.triangles)), columns)[::-1], axis=-1) * side
    near = _MARGIN + 0.5
    far = near + _span(side)
    first = np.array([[near, near], [far, near], [near, far]])
    places = np.empty((atlas.triangles.max() + 1, 3, 2))
    # A triangle that is alone in its cell ends in the first half.
    for half, corners in ((1, side - first), (0, first)):
        places[atlas.triangles[:, half]] = cells[:, None] + corners
    return places.reshape(-1, 2) / [columns * side, rows * side]


def _in_rows(texture: np.ndarray, atlas: Atlas) -> np.ndarray:
    """Return cells `[cells, side, side, 3]` as an image."""
    rows = -(-len(texture) // atlas.columns)
    whole = np.zeros((rows * atlas.columns, *texture.shape[1:]), np.uint8)
    whole[: len(texture)] = texture
    whole = whole.reshape(rows, atlas.columns, atlas.side, atlas.side, 3)
    return whole.swapaxes(1, 2).reshape(rows * atlas.side, atlas.columns * atlas.side, 3)


def _photographed(
    points: np.ndarray, facing: np.ndarray, mesh: Mesh, detail: Detail, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the photographs' colors at points `[C, side, side, 3]`, and where there are any.

    They are seen by a camera far away in the direction that the surface faces, whose pixels are as
    large as the texels. `cells` is what C is filled up to, so that one program serves all.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    distance = _FAR * float(np.linalg.norm(high - low)) / 2
    texel = float(np.median(np.linalg.norm(np.diff(points, axis=2), axis=-1)))
    center = (low + high) / 2
    away = facing / np.linalg.norm(facing)
    camera = Camera.look_at(center + distance * away, center, 1.0, height=1, width=1)
    focal = distance / max(texel, 1e-6 * distance)
    camera = camera.replace(intrinsics=jnp.array([focal, focal, 0, 0], jnp.float32))
    filled = np.zeros((cells, *points.shape[1:]), np.float32)
    filled[: len(points)] = points
    side = points.shape[1]
    pixels, depth = _project(camera, jnp.asarray(filled).reshape(cells * side, side, 3))
    depth = jnp.where(jnp.arange(cells * side)[:, None] < len(points) * side, depth, 0)
    found = gather(camera, pixels, depth, detail.sources, detail.shown, _SETTINGS)
    rgb = np.asarray((1 + found.mean[..., 3:]) / 2).reshape(filled.shape)
    seen = np.asarray(found.weight > 0).reshape(filled.shape[:-1])
    return rgb[: len(points)], seen[: len(points)]


def _along_curve(points: np.ndarray) -> np.ndarray:
    """Return the places of points `[M, 3]` along a Morton curve through their box."""
    span = max(float(np.ptp(points, axis=0).max()), 1e-30)
    cells = ((points - points.min(axis=0)) / span * 1023).astype(np.int64)
    bits = np.arange(10)
    spread = ((cells[..., None] >> bits & 1) << 3 * bits).sum(axis=-1)
    return spread @ np.array([1, 2, 4])
