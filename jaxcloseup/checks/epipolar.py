"""How far matched features are from what the poses allow."""

from typing import NamedTuple

import numpy as np

from jaxcloseup.checks.matches import Matches


FITTING = 2.0  # pixels of epipolar error up to which a match fits the poses
_PRECISE, _NEARLY = 0.7, 10.0  # pixels of errors of right poses, and of those of poses with noise
_MANY = 0.08  # share of precise matches that no wrong pose has
_PAIRS = 3  # pairs that say whether a photograph's pose is right


class Cameras(NamedTuple):
    """The cameras of photographs, as a capture gives them."""

    camtoworld: np.ndarray  # `[V, 3, 4]` float64 OpenCV poses
    intrinsics: np.ndarray  # `[V, 4]` fx, fy, cx, cy in pixels
    sizes: np.ndarray  # `[V, 2]` widths and heights in pixels


class Fit(NamedTuple):
    """How well matches fit cameras."""

    share: float  # share of matches with an error of at most `FITTING`
    median: float  # median error in pixels
    fitting: float  # the same of matches that fit; NaN if none does
    by_view: np.ndarray  # `[V]` share of each photograph's matches that fit; NaN without matches
    # `[V]` the same of the best of the photographs that it matches; NaN if it has half as many
    # matches as usual, or fewer than three pairs that have, because a repeated pattern may match a
    # photograph wrongly
    by_best: np.ndarray
    # `[V]` whether some pair of the photograph has many precise matches and hardly any that are
    # nearly so: poses put the others far off, as a repeated pattern does, and no wrong pose
    precise: np.ndarray

    @property
    def all_precise(self) -> bool:
        """Return whether this is so of all photographs of which anything is known."""
        known = np.isfinite(self.by_best)
        return bool(known.any() and self.precise[known].all())


def epipolar_errors(matches: Matches, cameras: Cameras) -> np.ndarray:
    """Compute how far, in pixels, matches are from the projections that poses allow.

    A feature of one photograph lies somewhere on a ray, which another photograph sees as an arc of
    directions from the ray's end at infinity to the first camera. The error is the angle between
    the other's feature and this arc, in pixels at the feature along the image's radius, averaged
    over both photographs. Unlike the distance from an epipolar line it knows that points lie before
    both cameras, and it stays defined for photographs from one place.

    Args:
      matches: M matches.
      cameras: cameras of the photographs.

    Returns:
      `[M]` errors in pixels.
    """
    rays, pixels = _rays(matches, cameras)
    centers = cameras.camtoworld[matches.views, :, 3]
    away = centers[:, 0] - centers[:, 1]
    length = np.linalg.norm(away, axis=-1, keepdims=True)
    away = np.divide(away, length, out=np.zeros_like(away), where=length > 0)
    forward = _arc_angles(rays[:, 1], rays[:, 0], away) * pixels[:, 1]
    backward = _arc_angles(rays[:, 0], rays[:, 1], -away) * pixels[:, 0]
    return (forward + backward) / 2


def fit(matches: Matches, cameras: Cameras) -> Fit:
    """Measure how well matches fit cameras."""
    errors = epipolar_errors(matches, cameras)
    inside, count = errors <= FITTING, len(cameras.intrinsics)
    ends = matches.views.ravel()
    total = np.bincount(ends, minlength=count)
    right = np.bincount(ends, np.repeat(inside, 2), minlength=count)
    by_view = np.divide(right, total, out=np.full(count, np.nan), where=total > 0)
    pairs, place = np.unique(matches.views, axis=0, return_inverse=True)
    shares = _shares(place, inside)
    by_best = np.full(count, -1.0)
    for side in range(2):
        np.maximum.at(by_best, pairs[:, side], shares)
    narrow = _shares(place, errors <= _PRECISE)
    nearly = _shares(place, (errors > FITTING) & (errors <= _NEARLY))
    precise = np.zeros(count, bool)
    precise[pairs[(narrow >= _MANY) & (nearly <= narrow / 4)]] = True
    # Pairs of each photograph that have half as many matches as usual.
    matched = np.bincount(place)
    strong = np.bincount(pairs[matched >= np.median(matched) / 2].ravel(), minlength=count)
    few = total < np.median(total[total > 0]) / 2 if total.any() else total == 0
    by_best[few | (strong < min(_PAIRS, count - 1))] = np.nan
    fitting = float(np.median(errors[inside])) if inside.any() else np.nan
    median = float(np.median(errors))
    return Fit(float(inside.mean()), median, fitting, by_view, by_best, precise)


def capture_parallax(matches: Matches, cameras: Cameras) -> float:
    """Estimate how far features move between a capture's two farthest cameras, in degrees.

    It is the median over matches that fit, each of which moves by an angle between two cameras
    that are so far apart; 0 where no camera moves.
    """
    matches = matches.take(epipolar_errors(matches, cameras) <= FITTING)
    rays, _ = _rays(matches, cameras)
    centers = cameras.camtoworld[:, :, 3]
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1)
    between = apart[tuple(matches.views.T)]
    moved = between > 0
    if not moved.any():
        return 0.0
    angles = _angle(rays[:, 0], rays[:, 1])[moved] * apart.max() / between[moved]
    return min(180.0, float(np.degrees(np.median(angles))))


def _shares(group: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the share of each group that is true."""
    return np.bincount(group, true) / np.bincount(group)


def _rays(matches: Matches, cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions `[M, 2, 3]` in the world of features, and pixels a radian `[M, 2]`."""
    lenses = cameras.intrinsics[matches.views]
    flat = (matches.pixels - lenses[..., 2:]) / lenses[..., :2]
    local = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], -1)
    world = np.einsum("mvij,mvj->mvi", cameras.camtoworld[matches.views, :, :3], local)
    # 1 / cos^2, by which a pixel far from the axis is a smaller angle
    squared = np.sum(local**2, -1)
    focal = np.sqrt(lenses[..., 0] * lenses[..., 1])
    return world / np.sqrt(np.sum(world**2, -1, keepdims=True)), focal * squared


def _arc_angles(directions: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return angles `[M]` between unit directions `[M, 3]` and arcs; an end of 0 is no arc."""
    normal = np.cross(start, end)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 1e-9)
    between = np.sum(np.cross(normal, start) * directions, -1) > 0
    between &= np.sum(np.cross(end, normal) * directions, -1) > 0
    across = np.abs(np.arcsin(np.clip(np.sum(normal * directions, -1), -1, 1)))
    # The end, the other camera itself, is no point that it sees; but numbers should not jump there.
    to_end = np.where(length[:, 0] > 1e-9, _angle(directions, end), np.pi)
    nearest = np.minimum(_angle(directions, start), to_end)
    return np.where(between, across, nearest)


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angle `[M]` between unit vectors, exact also where it is small."""
    return 2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2, 0, 1))
