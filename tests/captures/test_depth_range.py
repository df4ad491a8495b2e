"""Depth ranges estimated from points and from cameras."""

import numpy as np

from jaxcloseup.captures.depth_range import near_far_from_cameras, near_far_from_points


def look_at(position, target):
    """An OpenCV pose `[3, 4]`."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward, position], -1)


def test_near_far_from_points():
    """Cameras see a ball of radius 1 from distances 4 and 2; stray points are ignored."""
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    stray = np.array([[0, 3.99, 0], [0, -500.0, 0]])
    poses = np.stack([look_at([0, 4, 0], [0, 0, 0]), look_at([0, -2, 0], [0, 0, 0])])
    lens, sizes = np.array([[20.0, 20, 20, 20]] * 2), np.array([[40, 40]] * 2)
    near, far = near_far_from_points(np.concatenate([ball, stray]), poses, lens, sizes)
    assert 0.5 < near < 1 and 5 < far < 10
    assert near_far_from_points(ball, poses[:1] - [0, 0, 0, 9], lens[:1], sizes[:1]) is None


def test_near_far_from_cameras():
    subject = np.array([1.0, 2, 3])
    offsets = np.array([[4, 0, 0], [0, 5, 1], [-3, -1, 0.5], [1, 2, 2]])
    poses = np.stack([look_at(subject + offset, subject) for offset in offsets])
    distances = np.linalg.norm(offsets, axis=1)
    near, far = near_far_from_cameras(poses)
    np.testing.assert_allclose([near, far], [distances.min() / 10, distances.max() * 4])
    # Parallel axes do not meet; diverging ones meet behind the cameras.
    parallel = np.repeat(poses[:1], 3, 0)
    parallel[:, 0, 3] += [0, 3, 6]
    np.testing.assert_allclose(near_far_from_cameras(parallel), [0.3, 300])
    np.testing.assert_allclose(near_far_from_cameras(poses[:1]), [0.1, 100])
    outward = poses * np.array([1, 1, -1, 1])
    low, high = near_far_from_cameras(outward)
    assert 0 < low < high
