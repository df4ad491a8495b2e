import json
import pathlib
import time

import numpy as np
import pytest
from tiny_capture import (
    HEIGHT,
    POINTS,
    WIDTH,
    colmap_capture,
    image_line,
    llff_capture,
    vertices,
    write_image,
    write_json,
    write_model,
    write_ply,
)

from jaxcloseup.captures.load import SceneError, load_scene
from jaxcloseup.captures.names import unique_names
from jaxcloseup.photos.scene import UnknownKeyWarning


@pytest.fixture
def capture(tmp_path):
    return llff_capture(tmp_path)


def test_split_file(capture):
    lists = {"train": ["1.png", "2.png"], "test": ["0.png"], "unused": []}
    (capture / "split.json").write_text(json.dumps(lists))
    assert load_scene(capture).names == {"train": ["1", "2"], "test": ["0"]}
    (capture / "split.json").write_text(json.dumps({"unused": ["1.png"], "test_far": ["2.png"]}))
    assert load_scene(capture).names == {"train": ["0"], "test_far": ["2"]}
    assert load_scene(capture, split="listed").names == {"train": ["0"], "test_far": ["2"]}
    assert load_scene(capture, split="every8").names["train"] == ["1", "2"]
    (capture / "split.json").write_text(json.dumps({"train": ["1.png"], "why": "because"}))
    with pytest.warns(UnknownKeyWarning, match=r"split\.json: these fields are ignored: why"):
        load_scene(capture)


def test_nothing_is_held_out_that_no_list_names(capture):
    scene = load_scene(capture, split="listed")
    assert scene.names == {"train": ["0", "1", "2"]} and scene.test is scene.test_far is None
    assert "all of its 3 photographs train" in " ".join(scene.metadata["notes"])


def test_every_eighth_of_separate_files(tmp_path):
    """The photographs of all files count, each once."""
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"{i:02d}.png", "transform_matrix": pose, "fx": 9.0} for i in range(10)]
    for i in range(10):
        write_image(tmp_path / f"{i:02d}.png")
    write_json(tmp_path / "transforms_train.json", frames[:6])
    write_json(tmp_path / "transforms_test.json", frames[4:])
    scene = load_scene(tmp_path, split="every8")
    assert scene.test is None and scene.names["test_far"] == ["00", "08"]
    assert len(scene.train) == 8


def test_closest_photographs_are_held_out(tmp_path):
    pytest.importorskip("pycolmap")
    depths = [8.0, 8.2, 8.4, 8.6, 4.0, 8.8, 9.0, 9.2, 9.4, 9.6]
    colmap_capture(tmp_path, 10, depths=depths)
    scene = load_scene(tmp_path, split="closest")
    assert scene.names["test"] == ["004"] and scene.names["test_far"] == ["000", "009"]
    train = [8.2, 8.4, 8.6, 8.8, 9.0, 9.2, 9.4]
    np.testing.assert_allclose(scene.metadata["times_nearer"], [np.median(train) / 4])


def test_sixteen_wide_photographs_train_for_close_ups_at_least_twice_as_near(tmp_path):
    """Most photographs are close-ups; those between are ordinary views now and then."""
    pytest.importorskip("pycolmap")
    depths = [9.0] * 20 + [1.0, 2.0] * 15 + [4.4, 4.6, 6.0]
    colmap_capture(tmp_path, len(depths), depths=depths)
    scene = load_scene(tmp_path, split="macro")
    names = [f"{i:03d}" for i in range(len(depths))]
    assert scene.names["test"] == names[20:51]
    assert len(scene.names["train"]) == 16
    assert not set(scene.names["train"]) & set(scene.names["test"])
    rest = [name for name in names if name not in scene.names["train"] + scene.names["test"]]
    assert scene.names["test_far"] == rest[::8]
    np.testing.assert_allclose(scene.metadata["times_nearer"], 9 / np.array(depths[20:51]))
    assert "the 31 of 53 that are 2.05 to 9.00 times nearer" in " ".join(scene.metadata["notes"])


def test_what_trains_is_never_scored(tmp_path):
    """Of wide photographs at any distance, some are far nearer than the median of those chosen."""
    pytest.importorskip("pycolmap")
    colmap_capture(tmp_path, 41, depths=[4.0] * 21 + [16.0] * 20)
    names = load_scene(tmp_path, split="macro").names
    assert not set(names["train"]) & {*names["test"], *names["test_far"]}


def test_close_ups_that_are_not_near_enough_are_refused(tmp_path):
    pytest.importorskip("pycolmap")
    colmap_capture(tmp_path, 4, depths=[9.0, 9.0, 6.0, 9.0])
    with pytest.raises(SceneError, match="than its 4 wide ones, and has none: choose --split=clo"):
        load_scene(tmp_path, split="macro")


def test_a_longer_lens_counts_as_nearer(tmp_path):
    """For a transforms.json, points inside the image count as seen."""
    pose = {"transform_matrix": np.diag([1.0, -1, -1, 1]).tolist(), "w": WIDTH, "h": HEIGHT}
    frames = [{"file_path": f"{i}.png", "fx": 9.0 + 3 * (i == 3), **pose} for i in range(5)]
    for i in range(5):
        write_image(tmp_path / f"{i}.png")
    write_json(tmp_path / "transforms.json", frames)
    rows = vertices(count=9)
    rows["z"] = 30
    write_ply(tmp_path / "points3d.ply", rows)
    scene = load_scene(tmp_path, split="closest")
    assert scene.names == {"train": ["1", "2", "4"], "test": ["3"], "test_far": ["0"]}
    np.testing.assert_allclose(scene.metadata["times_nearer"], [12 / 9])


@pytest.mark.parametrize(
    "options",
    [{"split": "every8"}, {"format": "colmap"}, {"invert_masks": True}, {"alpha_mode": "mask"}],
)
def test_built_in_scenes_have_their_own_split(options):
    with pytest.raises(SceneError, match=rf"built-in scene.*leave out {next(iter(options))}"):
        load_scene("table", **options)


def test_many_photographs_of_one_name_are_named_soon():
    """A list that repeats its photographs has names that clash; numbering them takes no square."""
    files = [pathlib.Path("images/a.png"), pathlib.Path("images/a_2.png")] * 20_000
    start = time.process_time()
    names = unique_names(files)
    assert time.process_time() - start < 10
    assert names[:4] == ["images_a", "images_a_2", "images_a_3", "images_a_2_2"]
    assert len(set(names)) == len(files)


def test_fewer_photographs_are_spread_evenly(tmp_path):
    """Points that fewer than two of them see are dropped; held-out views stay."""
    for i in range(9):
        write_image(tmp_path / f"images/{i:03d}.png")
    # 1 to 7 are for training; the second point is seen by two of 1, 3, 5 and 7 too, the first not.
    seen = {2: "4 3 1", 3: "4 3 1 4 3 2", 4: "4 3 1", 7: "4 3 2"}
    names = [f"{i:03d}.png" for i in range(9)]
    lines = [
        part for i, name in enumerate(names) for part in (image_line(i + 1, name), seen.get(i, ""))
    ]
    points = [f"{POINTS[0]} 3 0 4 0 5 0", f"{POINTS[1]} 4 1 8 0"]
    write_model(tmp_path / "sparse", lines, points=points)
    everything, fewer = load_scene(tmp_path), load_scene(tmp_path, photographs=4)
    assert fewer.names == {"train": ["001", "003", "005", "007"], "test_far": ["000", "008"]}
    np.testing.assert_array_equal(everything.points[1:], fewer.points)
    assert any("learns from 4 of 7 training" in note for note in fewer.metadata["notes"])
    assert load_scene(tmp_path, photographs=7).names == everything.names
