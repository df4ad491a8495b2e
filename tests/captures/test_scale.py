"""Numbers that float32 cannot hold, alone or beside a capture's others."""

import numpy as np
import pytest
from tiny_capture import (
    POSE,
    colmap_capture,
    frame,
    own_points,
    paper_capture,
    vertices,
    write_image,
    write_json,
    write_ply,
)

from jaxcloseup.captures.depth_range import near_far_from_cameras
from jaxcloseup.captures.load import SceneError, load_scene
from jaxcloseup.captures.scale import plausible
from jaxcloseup.photos.scene import NearFarWarning, PointsWarning


@pytest.fixture
def capture(tmp_path):
    return paper_capture(tmp_path)


def moved(*position):
    pose = POSE.copy()
    pose[:3, 3] = position
    return pose.tolist()


def test_lenses_of_cached_photographs_are_checked(capture):
    load_scene(capture, downscale=2)
    frames = [frame("train/a.png"), frame("train/b.png", fx=1e31)]
    write_json(capture / "transforms_train.json", frames)
    with pytest.raises(SceneError, match="a focal length of"):
        load_scene(capture, downscale=2)


@pytest.mark.parametrize("noise", [0.0, 1e-15])
@pytest.mark.parametrize("count", [1, 3])
def test_cameras_at_one_place_load(tmp_path, count, noise):
    frames = []
    for i in range(count):
        write_image(tmp_path / f"{i}.png")
        frames.append(frame(f"{i}.png", transform_matrix=moved(50 + noise * i, 20, noise * i)))
    write_json(tmp_path / "transforms_train.json", frames, near=None, far=None)
    with pytest.warns(NearFarWarning):
        scene = load_scene(tmp_path)
    np.testing.assert_allclose([scene.near, scene.far], [0.1, 100])
    assert near_far_from_cameras(np.asarray(scene.train.cameras.camtoworld)) == (0.1, 100)


def test_stray_points_are_dropped(capture):
    rows = vertices(count=9)
    rows["y"][2], rows["y"][3], rows["y"][4] = 1e300, 1e30, 1e9
    rows["y"][5] = 1e3
    write_ply(capture / "points3d.ply", rows)
    with (
        pytest.warns(PointsWarning, match="1 of 9 points are not finite and were dropped"),
        pytest.warns(PointsWarning, match="ply: 2 of 8 points are not finite, or 100000 times"),
    ):
        points = own_points(load_scene(capture))
    np.testing.assert_allclose(points[:, 1], np.delete(rows["y"], [2, 3, 4]), rtol=1e-6)


def test_stray_points_of_a_model_are_dropped_from_what_photographs_see(tmp_path):
    pytest.importorskip("pycolmap")
    colmap_capture(tmp_path, 10, depths=[8.0, 8.2, 8.4, 8.6, 4.0, 8.8, 9.0, 9.2, 9.4, 9.6])
    whole = load_scene(tmp_path, split="closest")
    table = tmp_path / "sparse/0/points3D.txt"
    lines = table.read_text().splitlines()
    for line, x in ((2, "1e300"), (4, "-1e20")):
        words = lines[line].split()
        lines[line] = " ".join([words[0], x, *words[2:]])
    table.write_text("\n".join(lines))
    with pytest.warns(PointsWarning, match=r"points3D\.txt: 2 of 5 points are not finite, or"):
        scene = load_scene(tmp_path, split="closest")
    np.testing.assert_array_equal(scene.points, whole.points[[0, 2, 4]])
    np.testing.assert_array_equal(scene.rgb, whole.rgb[[0, 2, 4]])
    assert scene.metadata["times_nearer"] == whole.metadata["times_nearer"]


def test_positions_whose_square_is_too_large_for_a_float():
    points = np.array([[0.0, 0, 0], [1, 1, 1], [1e39, 0, 0]])
    with pytest.warns(PointsWarning, match="1 of 3 points"):  # and no warning of an overflow
        keep = plausible("a file", points, np.array([[0.0, 0, 0], [0, 0, 1], [1e306, 0, 0]]))
    assert keep.tolist() == [True, True, False]
