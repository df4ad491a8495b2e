"""Where training photographs show a capture's points, at which depths, and how sure these are."""

import numpy as np

from jaxcloseup.fields.volume.depth_supervision import Sightings
from jaxcloseup.photos.scene import Scene, SceneError


_MOST = 100_000  # sightings that are kept, drawn at random
_ERROR = 1.0  # pixels; what is assumed where a capture has no reprojection errors
_CELL = 4  # pixels; a point hides what lies behind it in a cell of this size ...
_BEHIND = 0.05  # ... by more than this share of its depth
_COLOR = 0.1  # largest difference of a channel between a point and what shows it


def find_sightings(scene: Scene) -> Sightings:
    """Return the points of a scene in its training photographs.

    A COLMAP model says which photographs show a point, and its reprojection error. Otherwise a
    photograph shows a point that no other point near its pixel hides, and whose color it has. The
    deviation of depth is that of the point's position, estimated from all its sightings with
    independent errors of their pixels, along the ray.

    Raises:
      SceneError: the scene has no such points.
    """
    cameras = scene.train.cameras
    poses = np.asarray(cameras.camtoworld, np.float64)
    lenses = np.asarray(cameras.intrinsics, np.float64)
    points = np.asarray(scene.points, np.float64)
    told, found = scene.metadata.get("seen"), []
    for view, (pose, lens) in enumerate(zip(poses, lenses, strict=True)):
        local = (points - pose[:, 3]) @ pose[:, :3]
        depth = local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = local[:, :2] / depth[:, None] * lens[:2] + lens[2:]
        inside = (depth >= scene.near) & (depth <= scene.far)
        inside &= np.all((pixels >= 0) & (pixels < [cameras.width, cameras.height]), axis=1)
        rows = np.flatnonzero(inside)
        if told is not None:
            rows = np.intersect1d(rows, told[view])
        else:
            rows = rows[_shown(scene, view, rows, pixels[rows], depth[rows])]
        found.append((np.full(len(rows), view), rows, pixels[rows], depth[rows]))
    views, rows, pixels, depth = map(np.concatenate, zip(*found, strict=True))
    deviation = _deviations(poses, lenses, points, views, rows, depth, _errors(scene))
    sure = np.flatnonzero(np.isfinite(deviation))
    if not len(sure):
        raise SceneError(
            f"{scene.name} has no points that two training photographs show, which depth_weight "
            "needs: --set depth_weight=0 trains without them"
        )
    if len(sure) > _MOST:
        sure = np.random.default_rng(0).choice(sure, _MOST, replace=False)
    return Sightings(
        cameras,
        views[sure].astype(np.int32),
        *(x[sure].astype(np.float32) for x in (pixels, depth, deviation)),
    )


def _shown(
    scene: Scene, view: int, rows: np.ndarray, pixels: np.ndarray, depth: np.ndarray
) -> np.ndarray:
    """Return which of the points inside a photograph it shows."""
    cells = np.floor(pixels / _CELL).astype(np.int64)
    width, height = (
        -(-n // _CELL) for n in (scene.train.cameras.width, scene.train.cameras.height)
    )
    nearest = np.full((height + 2, width + 2), np.inf)
    np.minimum.at(nearest, (cells[:, 1] + 1, cells[:, 0] + 1), depth)
    around = np.min(
        [nearest[cells[:, 1] + y, cells[:, 0] + x] for y in range(3) for x in range(3)], axis=0
    )
    column, row = pixels.astype(np.int64).T
    seen = np.asarray(scene.train.rgb[view])[row, column]
    seen = seen / 255 if seen.dtype == np.uint8 else seen
    counts = np.asarray(scene.train.weight[view])[row, column] > 0
    alike = np.all(np.abs(seen - scene.rgb[rows]) <= _COLOR, axis=1)
    return (depth <= (1 + _BEHIND) * around) & alike & counts


def _errors(scene: Scene) -> np.ndarray:
    """Return the points' reprojection errors, in pixels of the training photographs."""
    told = scene.metadata.get("point_errors")
    if told is None:
        return np.full(len(scene.points), _ERROR)
    errors = np.asarray(told, np.float64) / scene.metadata.get("downscale", 1)
    return np.where(np.isfinite(errors) & (errors > 0), errors, _ERROR)


def _deviations(
    poses: np.ndarray,
    lenses: np.ndarray,
    points: np.ndarray,
    view: np.ndarray,
    rows: np.ndarray,
    depth: np.ndarray,
    errors: np.ndarray,
) -> np.ndarray:
    """Return the standard deviation of each sighting's z-depth; infinite for a point seen once."""
    rays = points[rows] - poses[view][:, :, 3]
    distance = np.linalg.norm(rays, axis=1)
    unit = rays / distance[:, None]
    across = errors[rows] * distance / lenses[view][:, :2].mean(axis=1)
    # A sighting says nothing of the point's position along its ray.
    says = (np.eye(3) - unit[:, :, None] * unit[:, None]) / across[:, None, None] ** 2
    information = np.zeros((len(points), 3, 3))
    np.add.at(information, rows, says)
    often = np.bincount(rows, minlength=len(points)) >= 2
    covariance = np.full_like(information, np.inf)
    covariance[often] = np.linalg.pinv(information[often], hermitian=True)
    with np.errstate(invalid="ignore"):
        along = np.einsum("ni,nij,nj->n", unit, covariance[rows], unit)
    return np.where(often[rows], np.sqrt(np.maximum(along, 0)), np.inf) * depth / distance
