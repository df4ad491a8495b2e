"""Plan the cameras of the built-in scenes: far views on an arc, and rotated close-ups.

The code uses NumPy float64 and casts rays on the exact solids. Poses are camera-to-world `[3, 4]`
in OpenCV axes. All views share one full-size pinhole camera.
"""

from typing import NamedTuple

import numpy as np

from jaxcloseup.drawn_scenes.modeling import Rig, turn
from jaxcloseup.drawn_scenes.raycast import Solids, cast_rays


WIDTH, HEIGHT, FOCAL = 960, 540, 800.0
_CANDIDATES = 48


class Closeups(NamedTuple):
    """Close-up test views."""

    poses: np.ndarray  # `[V, 3, 4]` poses
    subjects: np.ndarray  # `[V, 3]` surface point that each view looks at
    # `[V]` distance from the nearest training camera to the subject, over the distance from the
    # close-up to the subject
    magnification: np.ndarray


def pose_looking_at(
    position: np.ndarray, target: np.ndarray, turned: tuple[float, float, float] | np.ndarray
) -> np.ndarray:
    """Build an upright pose that looks at `target`, then rotate it by `turned`.

    Args:
      position: `[3]` camera position.
      target: `[3]` point to look at.
      turned: (pitch, yaw, roll) in radians.
    """
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    rotation = rotation @ turn(*np.rad2deg(turned))
    return np.column_stack([rotation, position])


def grid_rays(poses: np.ndarray, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Spread rays evenly over views: origins `[V, 1, 3]`, directions `[V, rows * columns, 3]`."""
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * WIDTH / FOCAL
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * HEIGHT / FOCAL
    xy = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    in_camera = np.column_stack([xy, np.ones(len(xy))])
    return poses[:, None, :, 3], np.einsum("pj,vij->vpi", in_camera, poses[:, :, :3])


def count_views(solids: Solids, points: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Count the views `[V, 3, 4]` that show each of the surface points `[P, 3]`."""
    away = points[:, None] - poses[None, :, :, 3]
    in_camera = np.einsum("pvi,vij->pvj", away, poses[:, :, :3])
    depth = np.maximum(in_camera[..., 2], 1e-6)
    inside = (in_camera[..., 2] > 0.05) & (
        np.abs(in_camera[..., :2] / depth[..., None]) < np.array([WIDTH, HEIGHT]) / (2 * FOCAL)
    ).all(-1)
    # Cast rays only to points inside the image.
    count = np.zeros(len(points), int)
    which, view = np.nonzero(inside)
    if len(which):
        hit = cast_rays(solids, poses[view, :, 3], away[which, view])
        np.add.at(count, which, np.abs(hit.depth - 1) < 2e-3)
    return count


def plan_far(solids: Solids, rig: Rig, rng: np.random.Generator, count: int) -> np.ndarray:
    """Plan far poses `[count, 3, 4]` in order of azimuth, with free space in front of each."""
    poses = []
    for k in range(count):
        azimuth = np.interp(k + 0.5, [0, count], rig.azimuth)
        height = (0.5 + 0.618034 * k) % 1
        while True:
            a, e = np.deg2rad([azimuth, np.interp(height, [0, 1], rig.elevation)])
            away = np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
            position = np.array(rig.target) + rng.uniform(*rig.distance) * away
            target = np.array(rig.target) + rng.normal(0, 0.06, 3)
            pose = pose_looking_at(position, target, (0.0, 0.0, rng.normal(0, 0.02)))
            depth = cast_rays(solids, *grid_rays(pose[None], 32, 18)).depth
            if depth.min() > 0.4 * rig.distance[0] and np.isfinite(depth).all():
                break
            height = rng.uniform()
        poses.append(pose)
    return np.stack(poses)


def plan_closeups(
    solids: Solids, rig: Rig, train: np.ndarray, rng: np.random.Generator, count: int
) -> Closeups:
    """Plan `count` close-ups, each nearer to its subject than any training view, as the rig says.

    Each camera lies 12 to 45 degrees off the line from its subject to a training view, and does not
    point straight at the subject. A candidate is kept only if nothing blocks its view of the
    subject, no surface is right in front of it, and training views see the subject and most of the
    rest of its image.
    """
    chosen = []
    for k in range(count):
        low, high = rig.magnification
        magnification = low * (high / low) ** ((k * 5 % count + 0.5) / count)
        for attempt in range(8 * len(rig.interests)):
            # Try each subject twice, then move on to the next.
            interest = np.array(rig.interests[(k + attempt // 2) % len(rig.interests)])
            found = _closeup(solids, interest, magnification, train, rng)
            if found is not None:
                break
        else:
            raise ValueError("no close-up fits: change the interests of the scene's rig")
        chosen.append(found)
    poses, subjects = (np.stack(column) for column in zip(*chosen, strict=True))
    nearest = np.linalg.norm(train[None, :, :, 3] - subjects[:, None], axis=-1).min(1)
    own = np.linalg.norm(poses[:, :, 3] - subjects, axis=-1)
    return Closeups(poses, subjects, nearest / own)


def _closeup(
    solids: Solids, interest: np.ndarray, magnification: float, train: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray] | None:  # fmt: skip
    """Return the pose and subject of the first good random candidate, or None."""
    views = train[rng.integers(len(train), size=_CANDIDATES), :, 3]
    aims = interest[:3] + interest[3] * _in_ball(rng, _CANDIDATES)
    hit = cast_rays(solids, views, aims - views)
    depth = np.where(np.isfinite(hit.depth), hit.depth, 0)
    subjects = views + depth[:, None] * (aims - views)
    on_subject = np.linalg.norm(subjects - interest[:3], axis=-1) < 1.3 * interest[3]

    to_view = (views - subjects) / np.linalg.norm(views - subjects, axis=-1, keepdims=True)
    side = np.cross(to_view, _in_ball(rng, _CANDIDATES))
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    angle = np.deg2rad(rng.uniform(12, 45, (_CANDIDATES, 1)))
    direction = np.cos(angle) * to_view + np.sin(angle) * side
    nearest = np.linalg.norm(train[None, :, :, 3] - subjects[:, None], axis=-1).min(1)
    own = nearest / magnification
    positions = subjects + own[:, None] * direction
    turns = rng.uniform(-1, 1, (_CANDIDATES, 3)) * np.deg2rad([7, 11, 18])
    poses = np.stack(
        [pose_looking_at(p, s, t) for p, s, t in zip(positions, subjects, turns, strict=True)]
    )

    facing = np.sum(hit.normal * direction, axis=-1) > 0.4
    back = cast_rays(solids, subjects + 1e-3 * hit.normal, positions - subjects).depth > 1
    good = np.flatnonzero(on_subject & facing & back)
    if not len(good):
        return None
    clear = cast_rays(solids, *grid_rays(poses[good], 32, 18)).depth.min(1)
    for i in good[clear > np.maximum(0.07, 0.4 * own[good])]:
        fine = cast_rays(solids, *grid_rays(poses[i : i + 1], 96, 54)).depth
        if fine.min() < max(0.07, 0.35 * own[i]) or not np.isfinite(fine).all():
            continue
        origins, directions = grid_rays(poses[i : i + 1], 16, 9)
        depths = cast_rays(solids, origins, directions).depth[..., None]
        shown = (origins + depths * directions)[0]
        views_of = count_views(solids, np.concatenate([subjects[i : i + 1], shown]), train)
        if views_of[0] >= 3 and np.mean(views_of[1:] >= 3) > 0.75:
            return poses[i], subjects[i]
    return None


def _in_ball(rng: np.random.Generator, count: int) -> np.ndarray:
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    return points * rng.uniform(size=(count, 1)) ** (1 / 3)
