"""Captures that cannot be loaded: each is refused in one sentence that says what to do."""

import pathlib
import shutil
import warnings

import numpy as np
import pytest
from tiny_capture import frame, single_file, write_json
from wrong_captures import CASES, CLEAR, HALF, PIXEL, ply, same, shrunk
from wrong_input import TRAIN, binary, llff, paper, put, refused, single, soon  # noqa: F401

from jaxcloseup.captures import photo_files
from jaxcloseup.captures.load import SceneError, SceneWarning, load_scene
from jaxcloseup.photos.scene import (
    BlankPhotographWarning,
    DuplicateFileWarning,
    PointsWarning,
    UnknownKeyWarning,
)


pytestmark = pytest.mark.usefixtures("soon")


@pytest.mark.parametrize(
    ("make", "change", "words", "options"),
    [
        (make, change, words, *(options or [{}]))
        for make, cases in CASES.items()
        for change, words, *options in cases
    ],
)
def test_a_wrong_capture_is_refused_in_one_sentence(tmp_path, make, change, words, options):
    said = refused(tmp_path, make, change, words, **options)
    assert options or str(tmp_path) in said


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_truncated_binary_models(tmp_path, name):
    binary(tmp_path)
    file = tmp_path / f"sparse/0/{name}.bin"
    data = file.read_bytes()
    for kept in range(0, len(data), 5):
        file.write_bytes(data[:kept])
        with pytest.raises(SceneError, match=rf"{name}\.bin is (truncated in record|empty)"):
            load_scene(tmp_path)
    file.write_bytes(data + b"12345")
    with pytest.raises(SceneError, match=rf"{name}\.bin has 5 bytes after its"):
        load_scene(tmp_path)


def test_no_capture(tmp_path):
    with pytest.raises(SceneError, match=r"holds no capture: add transforms_train\.json, transf"):
        load_scene(tmp_path)
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(SceneError, match="is not a folder: give the folder"):
        load_scene(tmp_path / "transforms.json")
    with pytest.raises(SceneError, match="is not a folder"):
        load_scene(tmp_path / "none")


def test_files_without_permission(tmp_path, monkeypatch):
    """Simulate missing permissions, because root may read every file."""
    paper(tmp_path)

    def refuse(path, *_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    for owner, name, words in (
        (photo_files, "read_bytes", r"t(rain|est)/.\.png cannot be read \(Permission denied\): r"),
        (pathlib.Path, "read_bytes", rf"{TRAIN} cannot be read \(Permission den"),
        (pathlib.Path, "is_file", r"\.json cannot be read \(Permission denied\): make it"),
    ):
        with monkeypatch.context() as patch, pytest.raises(SceneError, match=words):
            patch.setattr(owner, name, refuse)
            load_scene(tmp_path)


# Input that is unusual, and loads.


@pytest.mark.parametrize(
    ("make", "change", "options", "note"),
    [
        (paper, put("train/a.png", PIXEL), {}, None),
        (single, shrunk(HALF), {"downscale": 2}, "lacks 1 of 2 photographs, such as 001"),
        (lambda folder: single_file(folder, 1), same, {"split": "zoom"}, "unshrunk, 1 in all"),
    ],
)
def test_unusual_captures_load_without_a_warning(tmp_path, make, change, options, note):
    make(tmp_path)
    change(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(tmp_path, **options)
    assert len(scene.train) in (1, 2)
    assert note is None or note in scene.metadata["notes"][-1]


def test_unknown_fields_warn_once_per_file(tmp_path):
    paper(tmp_path)
    listed = [frame("train/a.png", time=0, sharpness=3), frame("train/b.png", time=1)]
    write_json(tmp_path / TRAIN, listed, aabb_scale=4, color="red")
    with pytest.warns(SceneWarning) as caught:
        load_scene(tmp_path)
    assert [warning.category for warning in caught] == [UnknownKeyWarning]
    words = f"{TRAIN}: these fields are ignored: color, time."
    assert str(caught[0].message).endswith(words)


def copy(name, other):
    return lambda folder: shutil.copy(folder / name, folder / other)


@pytest.mark.parametrize(
    ("make", "change", "category", "words", "count"),
    [
        (
            llff,
            put("split.json", {"train": ["0.png", "1.png"], "test": ["1.png"]}),
            DuplicateFileWarning,
            r"lists 1 photographs more than once: 1\.png \(train and",
            2,
        ),
        (
            llff,
            copy("images/0.png", "images/2.png"),
            DuplicateFileWarning,
            r"1 photographs are the same file as another, such as 2\.png as 0\.png: remove",
            2,
        ),
        (
            llff,
            put("images/1.png", CLEAR),
            BlankPhotographWarning,
            r"fully transparent photographs were left out: 1, such as 1\.png",
            1,
        ),
        (
            paper,
            put("train/a.png", np.full((30, 40, 3), 9)),
            BlankPhotographWarning,
            r"constant photographs show one color everywhere: 1, such as a\.png",
            2,
        ),
        (
            paper,
            ply(3, "1 2 3\n4 5 6\n1e39 0 0\n"),
            PointsWarning,
            "1 of 3 points are not finite",
            2,
        ),
    ],
)
def test_what_looks_like_a_mistake_warns(tmp_path, make, change, category, words, count):
    make(tmp_path)
    change(tmp_path)
    with pytest.warns(category, match=words):
        scene = load_scene(tmp_path)
    assert len(scene.train) == len(scene.names["train"]) == count


@pytest.mark.parametrize("options", [{}, {"split": "zoom", "zoom": 2}])
def test_transparent_photographs_are_in_no_split(tmp_path, options):
    llff(tmp_path)
    for i in range(2):  # the held-out one, and the one whose crop is held out
        put(f"images/{i}.png", CLEAR)(tmp_path)
    with pytest.warns(BlankPhotographWarning, match="left out: 2, such"):
        scene = load_scene(tmp_path, **options)
    assert scene.names == {"train": ["2"]} and scene.test is None and scene.test_far is None
    assert len(load_scene(tmp_path, alpha_mode="ignore", **options).train) == 2
