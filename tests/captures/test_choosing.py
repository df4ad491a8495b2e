"""Some of a capture's photographs: evenly over their order, or from cameras far apart."""

import numpy as np
import pytest
from tiny_capture import frame, random_pose, write_image, write_json

from jaxcloseup.captures.choosing import choose_photographs
from jaxcloseup.captures.load import SceneError, load_scene


def ring(degrees, distance=4.0, height=1.0):
    """Return poses `[V, 3, 4]` on a circle, at these angles, that look at its middle."""
    poses = []
    for angle in np.deg2rad(degrees):
        position = np.array([distance * np.cos(angle), distance * np.sin(angle), height])
        forward = -position / np.linalg.norm(position)
        right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
        poses.append(np.column_stack([right, np.cross(forward, right), forward, position]))
    return np.array(poses)


def steps(degrees):
    """Return the angles between neighbors on a circle."""
    around = np.sort(np.mod(degrees, 360))
    return np.diff([*around, around[0] + 360])


@pytest.mark.parametrize("count", [3, 4, 5, 8, 9, 12])
def test_cameras_on_a_ring_are_the_corners_of_a_regular_polygon(count):
    """Whatever their order; a camera at a time cannot be moved to a more regular one."""
    degrees = np.random.default_rng(count).permutation(np.arange(0, 360, 5.0))
    spread = choose_photographs("ring", ring(degrees), count, "spread")
    path = choose_photographs("ring", ring(degrees), count, "path")
    assert spread == sorted(set(spread)) and len(spread) == count
    assert np.abs(steps(degrees[spread]) - 360 / count).max() < 5
    assert steps(degrees[spread]).min() > 1.5 * steps(degrees[path]).min()


def test_a_loaded_capture_has_the_photographs_that_are_far_apart(tmp_path):
    """Its other photographs are not read: they may be damaged."""
    degrees = np.random.default_rng(0).permutation(np.arange(0, 360, 15.0))
    frames = []
    for i, pose in enumerate(ring(degrees)):
        image = np.full((6, 8, 3), 40 + 8 * i, np.uint8)
        write_image(tmp_path / f"{i:02d}.png", image)
        opengl = np.vstack([pose * [1, -1, -1, 1], [0, 0, 0, 1]])
        frames.append(frame(f"{i:02d}.png", transform_matrix=opengl.tolist()))
    write_json(tmp_path / "transforms_train.json", frames)
    expected = choose_photographs("ring", ring(degrees), 6, "spread")
    np.testing.assert_allclose(steps(degrees[expected]), 60)
    for i in range(24):
        if i not in expected:
            file = tmp_path / f"{i:02d}.png"
            file.write_bytes(file.read_bytes()[:40] + bytes([i]))
    scene = load_scene(tmp_path, photographs=6, choose="spread")
    assert scene.names["train"] == [f"{i:02d}" for i in expected]
    assert any("6 of 24 training photographs, far apart" in n for n in scene.metadata["notes"])
    with pytest.raises(SceneError, match="is truncated"):
        load_scene(tmp_path, photographs=6)


def test_the_choice_does_not_depend_on_coordinates_or_order():
    rng = np.random.default_rng(1)
    poses = np.concatenate([ring(rng.uniform(0, 360, 20)), ring(rng.uniform(0, 360, 20), 2, 2)])
    chosen = choose_photographs("any", poses, 7, "spread")
    rotation, _, shift = random_pose(rng)
    moved = rotation @ poses
    moved[:, :, 3] = 40 * (moved[:, :, 3] + 3 * shift)
    assert choose_photographs("any", moved, 7, "spread") == chosen
    order = rng.permutation(40)
    assert sorted(order[choose_photographs("any", poses[order], 7, "spread")]) == chosen


def test_cameras_in_one_place_look_in_different_directions():
    turned = ring(np.arange(0, 360, 10.0), height=0.0)
    turned[:, :, 3] = 0
    chosen = choose_photographs("place", turned, 4, "spread")
    np.testing.assert_allclose(steps(10.0 * np.array(chosen)), 90)


def test_parallel_cameras_stand_apart():
    """They look at no common point."""
    poses = np.repeat(np.eye(3, 4)[None], 9, axis=0)
    poses[:, 0, 3] = np.arange(9)
    assert choose_photographs("row", poses, 3, "spread") == [0, 4, 8]
