"""A check reads sizes, masks and names as training does."""

import json
import os
import threading
import time

import cv2
import numpy as np
import pytest
from textured_corner import HEIGHT, WIDTH, poses, write_corner

from jaxcloseup.app.report.check_page import write_check
from jaxcloseup.captures import folder as folders
from jaxcloseup.captures.contents import list_photographs
from jaxcloseup.captures.corrections import correct_frames
from jaxcloseup.captures.load import load_scene
from jaxcloseup.captures.photo import Reading
from jaxcloseup.captures.photo_reading import MAX_CONCURRENT, read_photos
from jaxcloseup.captures.small_photos import read_small
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.checks import check, evidence
from jaxcloseup.checks.check import check_capture
from jaxcloseup.photos.scene import SceneError


SIZE = {"w": WIDTH, "h": HEIGHT}


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """The corner's photographs by name, which are drawn once, and what is beside them."""
    folder = tmp_path_factory.mktemp("corner")
    write_corner(folder)
    pictures = {path.name: cv2.imread(str(path)) for path in (folder / "images").iterdir()}
    return pictures, (folder / "transforms.json").read_text(), (folder / "points3d.ply").read_text()


@pytest.fixture
def write(photographs, tmp_path):
    """A function that writes the corner with other photographs, fields and names."""
    pictures, fields, points = photographs

    def capture(change=lambda image, _: image, *, name=lambda i: f"images/{i:02d}.png", **added):
        written = json.loads(fields) | added
        for i, frame in enumerate(written["frames"]):
            image = change(pictures[f"{i:02d}.png"], i)
            frame["file_path"] = name(i)
            (tmp_path / name(i)).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(tmp_path / name(i)), np.ascontiguousarray(image))
        (tmp_path / "transforms.json").write_text(json.dumps(written))
        (tmp_path / "points3d.ply").write_text(points)
        return tmp_path

    return capture


def test_turned_photographs_are_turned_back_where_sizes_are_given(write):
    turned = write(lambda image, _: np.rot90(image, 3), **SIZE)
    found = check_capture(turned)
    assert found.corrections == ("turn=1",) and "turned by 90 degrees" in found.sentence
    assert check_capture(turned, corrections=found.corrections).verdict == "fits"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda image, _: image[:, 60:], "is 260 x 240 pixels, but w and h are 320 x 240: restore"),
        (lambda image, i: np.rot90(image) if i == 5 else image, "05.png.*as if rotated by an EXIF"),
        (lambda image, _: np.rot90(0 * image), "as if rotated"),  # nothing shows which way
    ],
)
def test_other_sizes_than_those_given_are_the_cause_that_is_named(write, change, words):
    with pytest.raises(SceneError, match=words):
        check_capture(write(change, **SIZE))


def test_masks_of_ones_are_understood(write):
    folder = write()
    (folder / "masks").mkdir()
    for i in range(len(poses())):
        mask = np.ones((HEIGHT, WIDTH), np.uint8)
        mask[:20] = 0
        cv2.imwrite(str(folder / f"masks/{i:02d}.png"), mask)
    found = check_capture(folder)
    assert found.verdict == "fits" and not any("constant" in note for note in found.notes)


def test_masks_are_undistorted_with_their_photographs(write):
    folder = write(**SIZE, k1=-0.2)
    (folder / "masks").mkdir()
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:100, :90] = 255
    for i in range(len(poses())):
        cv2.imwrite(str(folder / f"masks/{i:02d}.png"), mask)
    frame = list_photographs(folder).frames[0]
    small = read_small(frame, Reading(), WIDTH)
    (right,) = read_photos({"train": [frame]}, Reading())["train"]
    np.testing.assert_array_equal(small.rgb, right.rgb)
    np.testing.assert_array_equal(small.mask, right.mask)
    assert (small.mask != mask).any()


def test_the_key_holds_the_code_that_reads_and_compares(write, monkeypatch):
    hashed = []

    def spy(files):
        files = list(files)
        hashed.extend(f"{file.parent.name}/{file.stem}" for file in files)
        return hash_files(files)

    hash_files = check.hash_files
    monkeypatch.setattr(check, "hash_files", spy)
    monkeypatch.setattr(check, "cached", lambda path, key, *_, **__: key)
    folder = write()
    key = check_capture(folder)
    assert {"checks/judge", "checks/mistakes"} < set(hashed)
    readers = ("sift", "small_photos", "distortion", "photo_reading", "photo_masks", "corrections")
    assert {f"captures/{name}" for name in readers} < set(hashed)
    monkeypatch.setattr(cv2, "__version__", "0.1")
    assert check_capture(folder) != key


def test_the_key_holds_a_files_lens_but_no_photograph_twice(write, monkeypatch):
    texts = []

    def spy(data):
        texts.append(data)
        return content_hash(data)

    content_hash = check.content_hash
    monkeypatch.setattr(check, "content_hash", spy)
    monkeypatch.setattr(check, "cached", lambda path, key, *_, **__: key)
    every = [f"images/{i:02d}.png" for i in range(len(poses()))]
    folder = write(train_filenames=every)
    key = check_capture(folder)
    assert texts[-1].count(b"file_path") == len(every)
    assert texts[-1].count(b"images/03.png") < 10
    assert check_capture(folder) == key
    fields = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps(fields | {"k1": 0.01}))
    assert check_capture(folder) != key


def test_few_photographs_are_in_memory_at_full_size(write, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    running, most, lock, read = [], [], threading.Lock(), evidence.read_small

    def spy(*given):
        with lock:
            running.append(given)
            most.append(len(running))
        time.sleep(0.02)  # in which other threads would begin
        photo = read(*given)
        running.pop()
        return photo

    monkeypatch.setattr(evidence, "read_small", spy)
    monkeypatch.setattr(evidence, "find_matches", lambda features: features)
    assert evidence.gather(list_photographs(write()).frames, Reading()).names
    assert 1 < max(most) <= MAX_CONCURRENT


def test_points_that_measure_nearness_do_not_lie_where_masks_hide(write, monkeypatch):
    folder = write()
    (folder / "points3d.ply").unlink()
    (folder / "masks").mkdir()
    for i in range(len(poses())):
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:20] = 0
        cv2.imwrite(str(folder / f"masks/{i:02d}.png"), mask)
    given = []

    def spy(photos, *cameras):
        given.append([photo.mask for photo in photos])
        return find(photos, *cameras)

    find = folders._triangulate
    monkeypatch.setattr(folders, "_triangulate", spy)
    load_scene(folder, split="closest")
    assert len(given) > 1 and all(not masks[0][:20].any() for masks in given)


def test_points_seen_follow_the_pose():
    """Photograph 0 gets the pose of photograph 2, and with it what that pose saw."""
    frames = [
        Frame(None, "", None, None, pose, None, ({}, {}), seen=np.array([i]))
        for i, pose in enumerate(poses()[:3])
    ]
    corrected = correct_frames(frames, ["order=2,0,1"], opengl=True)
    assert [int(frame.seen[0]) for frame in corrected] == [2, 0, 1]


def test_photographs_of_one_name_are_told_apart(write, photographs, tmp_path):
    """Two folders, `a` and `b`, of the same names; a/02 and b/02 show each other's view."""
    other = {2: "08.png", 8: "02.png"}
    folder = write(
        lambda image, i: photographs[0][other[i]] if i in other else image,
        name=lambda i: f"images/{'ab'[i // 6]}/{i % 6:02d}.png",
    )
    found = check_capture(folder)
    assert "the poses of a/02.png and b/02.png are exchanged" in found.sentence
    assert {"a/02.png", "b/02.png"} == {name for name, _ in found.worst[:2]}
    assert write_check(folder, "corner", found, list_photographs(folder), Reading()).exists()
