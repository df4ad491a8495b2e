"""Where the built-in scenes are photographed from: far views on an arc, close-ups that are turned.

NumPy float64 throughout, with rays cast on the exact solids. Poses are camera-to-world `[3, 4]` in
OpenCV axes; a view is a pose with the one full-size pinhole of all built-in captures.
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxcloseup.scenes.builtin import Rig
from jaxcloseup.scenes.modelling import turn
from jaxcloseup.scenes.raycast import Hit, Solids, cast_ray, map_rays


WIDTH, HEIGHT, FOCAL = 960, 540, 800.0
_RAYS = 1 << 14  # rays cast at a time: one compilation serves all questions
_CANDIDATES = 48


class Closeups(NamedTuple):
    """Close-up test views.

    Attributes:
      poses: `[V, 3, 4]`.
      subjects: `[V, 3]` the surface point each one looks at.
      magnification: `[V]` distance of the nearest training camera to the subject over its own.
    """

    poses: np.ndarray
    subjects: np.ndarray
    magnification: np.ndarray


def pose_looking_at(
    position: np.ndarray, target: np.ndarray, turned: np.ndarray = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """An upright pose with z towards `target`, then turned by radians (pitch, yaw, roll)."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    rotation = rotation @ turn(*np.rad2deg(turned))
    return np.column_stack([rotation, position])


def cast(solids: Solids, origins: np.ndarray, directions: np.ndarray) -> Hit:
    """First hits of rays `[..., 3]`, as NumPy arrays `[...]`."""
    shape = np.broadcast_shapes(origins.shape, directions.shape)[:-1]
    rays = [np.broadcast_to(r, (*shape, 3)).reshape(-1, 3) for r in (origins, directions)]
    count = len(rays[0])
    rays = [np.pad(r, [(0, -count % _RAYS), (0, 0)], mode="edge").astype(np.float32) for r in rays]
    parts = [
        jax.device_get(_cast(solids, rays[0][i : i + _RAYS], rays[1][i : i + _RAYS]))
        for i in range(0, len(rays[0]), _RAYS)
    ]
    return jax.tree.map(
        lambda *leaf: np.concatenate(leaf)[:count].reshape(*shape, *leaf[0].shape[1:]), *parts
    )


@jax.jit
def _cast(solids: Solids, origins: jax.Array, directions: jax.Array) -> Hit:
    return map_rays(lambda o, d: cast_ray(solids, o, d), origins, directions)


def grid_rays(poses: np.ndarray, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins `[V, 1, 3]` and directions `[V, rows * columns, 3]` evenly over each view."""
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * WIDTH / FOCAL
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * HEIGHT / FOCAL
    xy = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    in_camera = np.column_stack([xy, np.ones(len(xy))])
    return poses[:, None, :, 3], np.einsum("pj,vij->vpi", in_camera, poses[:, :, :3])


def seen_by(solids: Solids, points: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """How many of the views `[V, 3, 4]` show each of the surface points `[P, 3]`."""
    away = points[:, None] - poses[None, :, :, 3]
    in_camera = np.einsum("pvi,vij->pvj", away, poses[:, :, :3])
    depth = np.maximum(in_camera[..., 2], 1e-6)
    inside = (in_camera[..., 2] > 0.05) & (
        np.abs(in_camera[..., :2] / depth[..., None]) < np.array([WIDTH, HEIGHT]) / (2 * FOCAL)
    ).all(-1)
    # Rays are asked only about points inside the frame.
    count = np.zeros(len(points), int)
    which, view = np.nonzero(inside)
    if len(which):
        hit = cast(solids, poses[view, :, 3], away[which, view])
        np.add.at(count, which, np.abs(hit.depth - 1) < 2e-3)
    return count


def plan_far(solids: Solids, rig: Rig, rng: np.random.Generator, count: int) -> np.ndarray:
    """`count` far poses `[count, 3, 4]` in order of azimuth, none with anything just before it."""
    i = np.arange(count)
    heights = (0.5 + i * 0.618034) % 1
    poses = []
    for k in range(count):
        azimuth = rig.azimuth[0] + (rig.azimuth[1] - rig.azimuth[0]) * (k + 0.5) / count
        elevation = rig.elevation[0] + (rig.elevation[1] - rig.elevation[0]) * heights[k]
        a, e = np.deg2rad([azimuth, elevation])
        away = np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
        while True:
            position = np.array(rig.target) + rng.uniform(*rig.distance) * away
            target = np.array(rig.target) + rng.normal(0, 0.06, 3)
            pose = pose_looking_at(position, target, (0.0, 0.0, rng.normal(0, 0.02)))
            if cast(solids, *grid_rays(pose[None], 32, 18)).depth.min() > 0.4 * rig.distance[0]:
                break
            away = away + rng.normal(0, 0.05, 3)
            away /= np.linalg.norm(away)
        poses.append(pose)
    return np.stack(poses)


def plan_closeups(
    solids: Solids, rig: Rig, train: np.ndarray, rng: np.random.Generator, count: int
) -> Closeups:
    """`count` close-ups: each 2 to 8 times nearer to a subject than the nearest training view.

    The camera goes to the side of the subject by 12 to 45 degrees as seen from a training view, and
    does not point straight at it. It is taken only if free space joins it to its subject, nothing is
    just before it, and training views see the subject and most of the rest of its image.
    """
    chosen = []
    for k in range(count):
        magnification = 2.1 * (7.6 / 2.1) ** ((k * 5 % count + 0.5) / count)
        for attempt in range(8 * len(rig.interests)):
            # Two tries at each subject, then on to the next.
            interest = np.array(rig.interests[(k + attempt // 2) % len(rig.interests)])
            found = _closeup(solids, interest, magnification, train, rng)
            if found is not None:
                break
        else:
            raise ValueError("no close-up can be placed; change the interests of the scene's rig")
        chosen.append(found)
    poses, subjects = (np.stack(column) for column in zip(*chosen, strict=True))
    nearest = np.linalg.norm(train[None, :, :, 3] - subjects[:, None], axis=-1).min(1)
    own = np.linalg.norm(poses[:, :, 3] - subjects, axis=-1)
    return Closeups(poses, subjects, nearest / own)


def _closeup(
    solids: Solids, interest: np.ndarray, magnification: float, train: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray] | None:  # fmt: skip
    """The first good one of a handful of random candidates, if any."""
    views = train[rng.integers(len(train), size=_CANDIDATES), :, 3]
    aims = interest[:3] + interest[3] * _in_ball(rng, _CANDIDATES)
    hit = cast(solids, views, aims - views)
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
    back = cast(solids, subjects + 1e-3 * hit.normal, positions - subjects).depth > 1
    clear = cast(solids, *grid_rays(poses, 32, 18)).depth.min(1) > np.maximum(0.07, 0.4 * own)
    for i in np.flatnonzero(on_subject & facing & back & clear):
        origins, directions = grid_rays(poses[i : i + 1], 16, 9)
        depths = cast(solids, origins, directions).depth[..., None]
        shown = (origins + depths * directions)[0]
        views_of = seen_by(solids, np.concatenate([subjects[i : i + 1], shown]), train)
        if views_of[0] >= 3 and np.mean(views_of[1:] >= 3) > 0.75:
            return poses[i], subjects[i]
    return None


def _in_ball(rng: np.random.Generator, count: int) -> np.ndarray:
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    return points * rng.uniform(size=(count, 1)) ** (1 / 3)
