"""Whether points lie on what photographs show: patches around their projections look alike."""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from jaxcloseup.captures.corrections import axes_matrix
from jaxcloseup.checks.epipolar import Cameras


_TRIED = 400  # points that are compared
_RADIUS, _SPACING = 4, 1.5  # of a patch: samples to each side, and pixels between them
_FLAT = 4.0  # gray levels of standard deviation below which a patch says nothing
_ALIKE = 0.75  # correlation of patches from which they show the same
_PAIRS = 3  # pairs of photographs that may show a point; the most similar patches count
_WIDEST = np.cos(np.radians(25))  # angle between rays beyond which patches look different
_MOVED = 0.1  # share of a point's distance by which it is moved for comparison
# Points fit if so many look alike, and so many more than when they are moved.
_LEAST, _GAIN = 0.3, 0.15
_FEWEST = 40  # textured points, below which nothing can be said


class PointsFit(NamedTuple):
    """How many points lie on what photographs show."""

    share: float  # share of textured points whose patches look alike
    moved: float  # the same after moving the points off their place
    textured: int  # number of points that were compared
    tried: int  # number of points, of which those count that two photographs show with texture
    shown: float  # share of points that two photographs have in view

    @property
    def known(self) -> bool:
        """Return True if there were enough points to compare."""
        return self.textured >= _FEWEST

    @property
    def fits(self) -> bool:
        """Return True if points agree with the photographs."""
        return self.share >= max(_LEAST, self.moved + _GAIN)


def fit_points(points: np.ndarray, gray: Sequence[np.ndarray], cameras: Cameras) -> PointsFit:
    """Compare what photographs show around points.

    Each point is seen by the photographs nearest to it that have it inside of their image. A patch
    around its projection into one, taken as parallel to the image, is looked up in another. Points
    on surfaces look alike (a normalized correlation of at least 0.75); others do so by chance,
    which the same points measure, moved by a tenth of their distance to the nearest photograph.

    Args:
      points: `[P, 3]` world points.
      gray: `[H, W]` uint8 photographs.
      cameras: their cameras.
    """
    some = points[:: max(1, len(points) // _TRIED)][:_TRIED].astype(np.float64)
    if not len(some):
        return PointsFit(0.0, 0.0, 0, 0, 0.0)
    share, textured = _alike(some, gray, cameras)
    shown = float((_in_view(some, cameras, margin=0.0)[0].sum(1) >= 2).mean())
    # Along its ray a point moves in other photographs wherever it lies; from the middle of all
    # cameras, which in an orbit is that of the subject, it would hardly move.
    first, _, rows = _views(some, cameras)
    rows, pair = np.unique(rows, return_index=True)
    eye = cameras.camtoworld[first[pair], :, 3]
    moved = [_alike(eye + (1 + by) * (some[rows] - eye), gray, cameras) for by in (-_MOVED, _MOVED)]
    return PointsFit(share, float(np.mean([m for m, _ in moved])), textured, len(some), shown)


def find_points_mistake(
    points: np.ndarray, gray: Sequence[np.ndarray], cameras: Cameras
) -> str | None:
    """Return the only turn by quarters of the points' world that makes them fit, or None.

    Args:
      points: `[P, 3]` world points that do not fit.
      gray: `[H, W]` uint8 photographs.
      cameras: their cameras.

    Returns:
      New coordinates in terms of the old ones, such as `x,z,-y`.
    """
    some = points[:: max(1, len(points) // _TRIED)][:_TRIED].astype(np.float64)
    found = []
    for axes in ("x,y,z", *_turns()):
        share, textured = _alike(some @ axes_matrix(axes).T, gray, cameras)
        # A turn that moves most points out of sight is not better for the few that stay.
        found.append((share * textured / len(some), axes))
    (best, axes), (second, _), *_ = sorted(found, reverse=True)
    return axes if best >= _LEAST and best - second >= _GAIN and axes != "x,y,z" else None


def coverage(points: np.ndarray, cameras: Cameras) -> tuple[float, float, float]:
    """Measure how photographs cover points, without asking what hides them.

    Args:
      points: `[P, 3]` world points, at least one.
      cameras: cameras of the photographs.

    Returns:
      Medians over points: number of photographs that have it in view; widest angle between their
      rays, in degrees; distance of the nearest as a share of the median distance.
    """
    some = points[:: max(1, len(points) // _TRIED)][:_TRIED].astype(np.float64)
    inside, _ = _in_view(some, cameras, margin=0.0)
    rays = cameras.camtoworld[None, :, :, 3] - some[:, None]
    away = np.linalg.norm(rays, axis=-1)
    rays /= np.maximum(away, 1e-300)[..., None]
    cosines = np.einsum("pvi,pwi->pvw", rays, rays)
    both = inside[:, :, None] & inside[:, None]
    widest = np.arccos(np.clip(np.where(both, cosines, 1).min((1, 2)), -1, 1))
    nearest = np.where(inside, away, np.inf).min(1)
    usual = np.median(away[inside]) if inside.any() else np.inf
    return (
        float(np.median(inside.sum(1))),
        float(np.degrees(np.median(widest))),
        float(np.median(nearest[np.isfinite(nearest)]) / usual) if inside.any() else 0.0,
    )


def _turns() -> Iterator[str]:
    """Yield the 23 rotations that permute axes, as texts."""
    for names in itertools.permutations("xyz"):
        for signs in itertools.product(("", "-"), repeat=3):
            axes = ",".join(sign + name for sign, name in zip(signs, names, strict=True))
            if np.linalg.det(axes_matrix(axes)) > 0 and axes != "x,y,z":
                yield axes


def _alike(points: np.ndarray, gray: Sequence[np.ndarray], cameras: Cameras) -> tuple[float, int]:
    """Return the share of textured points whose patches look alike, and their number."""
    first, second, rows = _views(points, cameras)
    if not len(rows):
        return 0.0, 0
    steps = _SPACING * np.arange(-_RADIUS, _RADIUS + 1)
    offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    pixels, depth = _project(points[rows], cameras, first)
    patch = pixels[:, None] + offsets
    lenses = cameras.intrinsics[first][:, None]
    flat = np.concatenate(
        [(patch - lenses[..., 2:]) / lenses[..., :2], np.ones((*patch.shape[:2], 1))], -1
    )
    poses = cameras.camtoworld[first]
    world = np.einsum("nij,nkj->nki", poses[:, :, :3], flat * depth[:, None, None])
    world += poses[:, None, :, 3]
    other, _ = _project(world.reshape(-1, 3), cameras, np.repeat(second, len(offsets)))
    a = _sample(gray, first, patch)
    b = _sample(gray, second, other.reshape(patch.shape))
    a, b = (x - x.mean(-1, keepdims=True) for x in (a, b))
    spread = np.sqrt((a**2).mean(-1) * (b**2).mean(-1))
    textured = np.minimum(a.std(-1), b.std(-1)) > _FLAT
    similar = np.where(textured, (a * b).mean(-1) / np.maximum(spread, 1e-6), -1)
    best = np.full(len(points), -1.0)
    np.maximum.at(best, rows, similar)
    counted = best > -1
    return (float((best[counted] > _ALIKE).mean()) if counted.any() else 0.0), int(counted.sum())


def _views(points: np.ndarray, cameras: Cameras) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs of photographs `[N]`, `[N]` that may show points, and the points' rows `[N]`."""
    inside, depth = _in_view(points, cameras, margin=_SPACING * _RADIUS)
    depth = np.where(inside, depth, np.inf)
    rays = cameras.camtoworld[None, :, :, 3] - points[:, None]
    rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-300)
    nearest = np.argsort(depth, axis=1, kind="stable")
    found = []
    for point in range(len(points)):
        seen = nearest[point][np.isfinite(depth[point, nearest[point]])]
        seen = seen[:8]
        pairs = [
            (a, b, point)
            for a, b in itertools.combinations(seen.tolist(), 2)
            if rays[point, a] @ rays[point, b] > _WIDEST
        ]
        found += pairs[:_PAIRS]
    return tuple(np.array(found, int).reshape(-1, 3).T)  # type: ignore[return-value]


def _in_view(
    points: np.ndarray, cameras: Cameras, *, margin: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return which views have points inside of their image, `[P, V]`, and z-depths `[P, V]`."""
    shape = len(points), len(cameras.intrinsics)
    rows, view = (x.ravel() for x in np.indices(shape))
    pixels, depth = _project(points[rows], cameras, view)
    inside = (depth > 0) & (pixels > margin).all(-1)
    inside &= (pixels < cameras.sizes[view] - margin).all(-1)
    return inside.reshape(shape), depth.reshape(shape)


def _project(
    points: np.ndarray, cameras: Cameras, views: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Project points `[N, 3]`, each into a view `[N]`: pixels `[N, 2]` and z-depths `[N]`."""
    poses, lenses = cameras.camtoworld[views], cameras.intrinsics[views]
    local = np.einsum("nji,nj->ni", poses[:, :, :3], points - poses[:, :, 3])
    depth = local[:, 2]
    safe = np.where(depth > 0, depth, 1.0)[:, None]
    return local[:, :2] / safe * lenses[:, :2] + lenses[:, 2:], depth


def _sample(gray: Sequence[np.ndarray], views: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Read gray levels `[N, K]` at pixels `[N, K, 2]` of each row's photograph, bilinearly."""
    values = np.zeros(pixels.shape[:2])
    for view in np.unique(views):
        rows = np.flatnonzero(views == view)
        # OpenCV puts pixel centers at integers.
        x, y = np.moveaxis(pixels[rows] - 0.5, -1, 0).astype(np.float32)
        values[rows] = cv2.remap(gray[view], x, y, cv2.INTER_LINEAR)
    return values
