"""Choose the photographs that each photograph is matched with."""

import numpy as np

from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.stereo.config import StereoConfig


_GRID, _DEPTHS, _MOST_POINTS = 6, 4, 512  # samples of a photograph's view; points that are used


def choose_neighbors(
    cameras: Camera, near: float, far: float, config: StereoConfig, points: np.ndarray | None = None
) -> np.ndarray:
    """Choose neighbors by the surface that they share, and by the angles at which they see it.

    Points of a photograph's view stand for its surface: those given that it shows, else some at
    depths from near to far. A neighbor that shows a point is worth most at angles between
    `config.min_angle` and `config.max_angle`. Neighbors are chosen one after another, and a point
    that many of the chosen show, from the same side, counts less for the next.

    Args:
      cameras: stacked cameras `[V]` of one size.
      near: smallest z-depth in the scene, world units.
      far: largest z-depth.
      config: number of neighbors, and angles.
      points: `[P, 3]` world points on surfaces; None: there are none.

    Returns:
      `[V, N]` int32 indices of the photographs, the best ones first; -1 where there is none.
    """
    pose, lens = (
        np.asarray(array, np.float64) for array in (cameras.camtoworld, cameras.intrinsics)
    )
    size = np.array([cameras.width, cameras.height])
    chosen = np.full((len(pose), config.neighbors), -1, np.int32)
    given = np.zeros((0, 3)) if points is None else np.asarray(points, np.float64)
    for view in range(len(pose)):
        shown = given[_project(pose[view : view + 1], lens[view : view + 1], given, size)[0]]
        if len(shown) < _GRID**2:
            shown = _view_samples(pose[view], lens[view], size, near, far)
        shown = shown[:: -(-len(shown) // _MOST_POINTS)]
        worth, rays = _worth(pose, lens, size, shown, view, config)
        for place in range(config.neighbors):
            total = worth.sum(axis=1)
            best = int(np.argmax(total))
            if total[best] <= 0:
                break
            chosen[view, place] = best
            # What is seen from the same side as by the chosen one is worth less from now on.
            cosine = np.einsum("vpc,pc->vp", rays, rays[best])
            alike = np.exp(-np.arccos(np.clip(cosine, -1, 1)) / config.max_angle)
            worth *= 1 - 0.7 * alike * (worth[best] > 0)
            worth[best] = 0
    return chosen


def _worth(
    pose: np.ndarray,
    lens: np.ndarray,
    size: np.ndarray,
    points: np.ndarray,
    view: int,
    config: StereoConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Return what points `[P, 3]` of a view are worth in all views `[V, P]`, and unit rays."""
    rays = pose[:, None, :, 3] - points
    distance = np.linalg.norm(rays, axis=-1)
    rays = rays / np.maximum(distance, 1e-12)[..., None]
    angle = np.arccos(np.clip(np.einsum("vpc,pc->vp", rays, rays[view]), -1, 1))
    rising = np.minimum(angle / config.min_angle, 1) ** 2
    falling = np.exp(-((np.maximum(angle / config.max_angle - 1, 0) / 0.5) ** 2))
    # Photographs from other distances show other detail.
    focal = np.sqrt(lens[:, 0] * lens[:, 1])[:, None]
    ratio = (distance / focal) / (distance[view] / focal[view])
    alike = np.minimum(ratio, 1 / ratio)
    worth = _project(pose, lens, points, size) * rising * falling * alike
    worth[view] = 0
    return worth, rays


def _project(
    pose: np.ndarray, lens: np.ndarray, points: np.ndarray, size: np.ndarray
) -> np.ndarray:
    """Return which views `[V]` show points `[P, 3]`: `[V, P]` bool."""
    local = np.einsum("vpc,vck->vpk", points - pose[:, None, :, 3], pose[:, :, :3])
    depth = np.maximum(local[..., 2:], 1e-12)
    pixels = local[..., :2] / depth * lens[:, None, :2] + lens[:, None, 2:]
    return (local[..., 2] > 0) & np.all((pixels >= 0) & (pixels < size), axis=-1)


def _view_samples(
    pose: np.ndarray, lens: np.ndarray, size: np.ndarray, near: float, far: float
) -> np.ndarray:
    """Return points `[P, 3]` on a grid of pixels of one view, at depths from near to far."""
    share = (np.arange(_GRID) + 0.5) / _GRID
    x, y = np.meshgrid(
        *(
            (share * side - center) / focal
            for side, center, focal in zip(size, lens[2:], lens[:2], strict=True)
        )
    )
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    depths = np.geomspace(near, far, _DEPTHS + 2)[1:-1]
    local = (depths[:, None, None] * rays).reshape(-1, 3)
    return pose[:, 3] + local @ pose[:, :3].T
