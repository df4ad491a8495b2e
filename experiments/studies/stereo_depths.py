"""Table of depth maps from photographs alone, beside OpenCV's semi-global matching.

    python -m experiments.studies.stereo_depths --scenes=table,room --photographs=all,10

Each photograph is matched with its neighbors (`jaxcloseup.stereo`), and with its best one by
StereoSGBM after both are turned so that rows match. Errors are relative to the exact depth of drawn
scenes, and to the visible points of captures; there *confident pixels* are the share of points.
Seconds include compiling.
"""

import time
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from experiments.studies.tables import SCENES, print_table
from jaxcloseup.app.score.surface_error import find_landmarks
from jaxcloseup.app.score.targets import exact_depths
from jaxcloseup.captures.load import load_scene
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import camera_at, to_float
from jaxcloseup.stereo import StereoConfig, choose_neighbors, estimate_depths


FLAGS = flags.FLAGS
_HEADER = (
    *("scene", "photographs", "method", "confident pixels", "median error", "within 1 %"),
    *("seconds", "core-seconds"),
)


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("scenes", SCENES, "drawn scenes, or folders of captures")
    flags.DEFINE_list("photographs", ["all"], "numbers of photographs, or all")
    flags.DEFINE_integer("downscale", 2, "divisor of the photographs' size", lower_bound=1)


class Timed(NamedTuple):
    """Depth maps `[V, H, W]`, 0 where not confident, and what they took."""

    depth: np.ndarray
    seconds: float
    core_seconds: float


def main(_: list[str]) -> None:
    """Estimate depth maps of every scene, and print the table."""
    rows = []
    for name in FLAGS.scenes:
        for photographs in FLAGS.photographs:
            count = None if photographs == "all" else int(photographs)
            scene = load_scene(name, downscale=FLAGS.downscale, photographs=count)
            config = StereoConfig()
            neighbors = choose_neighbors(
                scene.train.cameras, scene.near, scene.far, config, scene.points
            )
            for method, timed in (
                ("stereo", by_stereo(scene, neighbors, config)),
                ("SGBM", by_sgbm(scene, neighbors)),
            ):
                shown = [scene.name, str(len(scene.train)), method, *_errors(scene, timed.depth)]
                rows.append([*shown, f"{timed.seconds:.0f}", f"{timed.core_seconds:.0f}"])
                print(" | ".join(rows[-1]), flush=True)
    print_table("Depth from photographs alone", _HEADER, rows)


def by_stereo(scene: Scene, neighbors: np.ndarray, config: StereoConfig) -> Timed:
    """Return confident depths by multi-view stereo."""

    @jax.jit
    def estimate(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        near, far = scene.near, scene.far
        maps = estimate_depths(key, scene.train, jnp.asarray(neighbors), near, far, config)
        return maps.depth, maps.confidence

    key, started = jax.random.key(0), _clocks()
    depth, confidence = map(np.asarray, estimate(key))
    return Timed(np.where(confidence > 0, depth, 0), *(_clocks() - started))


def _clocks() -> np.ndarray:
    return np.array([time.perf_counter(), time.process_time()])


def by_sgbm(scene: Scene, neighbors: np.ndarray) -> Timed:
    """Return depths by OpenCV from pairs of each photograph and its best neighbor."""
    views, started = scene.train, _clocks()
    images = (255 * np.asarray(to_float(views.rgb))).round().astype(np.uint8)
    depth = [
        _match_pair(scene, images, view, best) for view, best in enumerate(neighbors[:, 0].tolist())
    ]
    return Timed(np.stack(depth), *(_clocks() - started))


def _disparities(images: Sequence[np.ndarray], lowest: int, count: int) -> np.ndarray:
    """Return disparities `[H, W]` of two rectified images; below `lowest` where none is found."""
    matcher = cv2.StereoSGBM_create(
        lowest,
        count,
        5,
        P1=8 * 3 * 25,
        P2=32 * 3 * 25,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    return matcher.compute(*images).astype(np.float32) / 16


def _match_pair(scene: Scene, images: np.ndarray, view: int, other: int) -> np.ndarray:
    """Return the z-depths `[H, W]` of one photograph where it matches another."""
    cameras = [camera_at(scene.train.cameras, index) for index in (view, other)]
    poses = [np.asarray(camera.camtoworld, np.float64) for camera in cameras]
    height, width = images.shape[1:3]
    # Both are turned so that rows are parallel to the line between the cameras.
    right = poses[1][:, 3] - poses[0][:, 3]
    baseline = np.linalg.norm(right)
    forward = poses[0][:, 2] + poses[1][:, 2]
    down = np.cross(forward, right)
    axes = np.stack([right, down, np.cross(right, down)], axis=1)
    axes /= np.linalg.norm(axes, axis=0)
    focal, lenses, corners = float(cameras[0].intrinsics[0]), [], []
    for pose, camera in zip(poses, cameras, strict=True):
        fx, fy, cx, cy = np.asarray(camera.intrinsics, np.float64)
        lens = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
        lenses.append(np.diag([focal, focal, 1]) @ axes.T @ pose[:, :3] @ np.linalg.inv(lens))
        corner = np.array([[0, 0], [width, 0], [0, height], [width, height]], np.float64)
        corners.append(cv2.perspectiveTransform(corner[None], lenses[-1])[0])
    # Rows must match, columns need not: each image begins where its own photograph does.
    top, bottom = (
        reduce(found[:, 1]) for reduce, found in ((np.min, corners[0]), (np.max, corners[0]))
    )
    left = [found[:, 0].min() for found in corners]
    size = [
        int(np.clip(side, 16, 4 * width))
        for side in (max(np.ptp(found[:, 0]) for found in corners), bottom - top)
    ]
    moves = [np.array([[1, 0, -x], [0, 1, -top], [0, 0, 1]]) for x in left]
    flat = [
        cv2.warpPerspective(images[index], move @ lens, size)
        for index, move, lens in zip((view, other), moves, lenses, strict=True)
    ]
    # Disparities of all depths beyond nine tenths of the nearest point.
    shown = find_landmarks(cameras[0], scene.points).depth
    nearest = 0.9 * float(np.percentile(shown, 1)) if len(shown) else scene.near
    shift = left[0] - left[1]  # columns between disparity 0 and that of points at infinity
    lowest = int(np.floor(-shift))
    count = 16 * int(np.ceil((focal * baseline / nearest + 1) / 16))
    disparity = _disparities(flat, lowest, count)
    valid = disparity >= lowest
    inverse = np.where(valid, (disparity + shift) / (focal * baseline), 0)
    # Back to the photograph's pixels, whose z-depth is that along its own axis.
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    grid = np.stack([x, y, np.ones_like(x)], axis=-1) @ (moves[0] @ lenses[0]).T
    maps = (grid[..., :2] / grid[..., 2:]).astype(np.float32)
    inverse = cv2.remap(inverse.astype(np.float32), maps[..., 0], maps[..., 1], cv2.INTER_NEAREST)
    ahead = np.abs(grid[..., 2])  # z in the turned frame of a point at z-depth 1
    return np.where(inverse > 0, 1 / (np.maximum(inverse, 1e-9) * ahead), 0)


def _errors(scene: Scene, depth: np.ndarray) -> list[str]:
    """Return the share of confident pixels, their median error, and how many are within 1 %."""
    cameras = scene.train.cameras
    if scene.surface:
        exact = np.asarray(exact_depths(scene, cameras))
        found, true = depth[exact > 0], exact[exact > 0]
    else:
        marks = [
            find_landmarks(camera_at(cameras, view), scene.points) for view in range(len(depth))
        ]
        found = np.concatenate(
            [own[mark.row, mark.column] for own, mark in zip(depth, marks, strict=True)]
        )
        true = np.concatenate([mark.depth for mark in marks])
    confident = found > 0
    error = np.abs(found[confident] / true[confident] - 1)
    return [f"{np.mean(confident):.1%}", f"{np.median(error):.3%}", f"{np.mean(error < 0.01):.1%}"]


if __name__ == "__main__":
    define_flags()
    app.run(main)
