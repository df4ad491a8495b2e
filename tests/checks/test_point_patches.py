"""Points are compared with what photographs show around them."""

import cv2
import numpy as np
from textured_corner import texture

from jaxcloseup.checks.epipolar import Cameras
from jaxcloseup.checks.point_patches import fit_points


SIDE, FOCAL, RADIUS = 300, 700.0, 0.2  # pixels, and the ball's share of the cameras' distance


def orbit(count):
    """Cameras on a ring of radius 1 that look at its center, and their photographs of a ball."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    poses, gray = [], []
    lens = np.array([FOCAL, FOCAL, SIDE / 2, SIDE / 2])
    columns, rows = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    flat = np.stack([(columns - lens[2]) / FOCAL, (rows - lens[3]) / FOCAL, 0 * rows + 1], -1)
    painted = cv2.cvtColor(texture(0), cv2.COLOR_RGB2GRAY)
    for angle in angles:
        eye = np.array([np.cos(angle), np.sin(angle), 0])
        right = np.array([-np.sin(angle), np.cos(angle), 0])
        poses.append(np.column_stack([right, [0, 0, -1], -eye, eye]))
        rays = flat @ poses[-1][:, :3].T
        along, square = rays @ eye, (rays**2).sum(-1)
        root = along**2 - square * (1 - RADIUS**2)
        depth = (-along - np.sqrt(np.maximum(root, 0))) / square
        x, y, z = np.moveaxis(eye + depth[..., None] * rays, -1, 0)
        across = 1024 * (np.arctan2(y, x) / (2 * np.pi) + 0.5)
        down = 512 + 160 * z / RADIUS
        shown = cv2.remap(painted, *map(np.float32, (across, down)), cv2.INTER_LINEAR)
        gray.append(np.where(root > 0, shown, 0).astype(np.uint8))
    sizes = np.tile([SIDE, SIDE], (count, 1))
    return Cameras(np.stack(poses), np.tile(lens, (count, 1)), sizes), gray


def on_the_ball(count):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, 3)) * [1, 1, 0.3]
    return RADIUS * points / np.linalg.norm(points, axis=1, keepdims=True)


def test_right_points_of_a_small_subject_fit_and_others_do_not():
    """Moved from the ring's middle, which is the subject's, points would stay almost in place."""
    cameras, gray = orbit(100)
    points = on_the_ball(400)
    right = fit_points(points, gray, cameras)
    assert right.known and right.fits and right.share > 0.9
    wrong = fit_points(1.3 * points, gray, cameras)
    assert wrong.known and not wrong.fits
