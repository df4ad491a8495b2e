"""Photographs whose names on disk are not those that a capture's files list."""

import pathlib
import unicodedata

import pytest
from tiny_capture import (
    POSE,
    colmap_capture,
    frame,
    paper_capture,
    single_file,
    write_image,
    write_json,
)
from wrong_input import all_of, listed, llff

from jaxcloseup.captures.load import load_scene
from jaxcloseup.photos.scene import DuplicateFileWarning


def single(folder):
    single_file(folder, 3)


def colmap(folder):
    pytest.importorskip("pycolmap")
    colmap_capture(folder, 3)


def rename(function):
    """Rename the photographs on disk; `function` takes and returns a path in the capture."""

    def change(folder):
        for path in sorted(folder.glob("images/*.png")):
            new = folder / function(path.relative_to(folder).as_posix())
            new.parent.mkdir(exist_ok=True)
            path.rename(new)
        if not any((folder / "images").iterdir()):
            (folder / "images").rmdir()

    return change


def accented(form):
    return unicodedata.normalize(form, "é")


CASE = "3 photographs were found under another case or Unicode form of their names, such as "
FOLDER = "3 photographs were found in another folder than listed, such as "
ENDING = "3 photographs were found with another ending, such as "


@pytest.mark.parametrize("make", [single, colmap])
@pytest.mark.parametrize(
    ("change", "note"),
    [
        (listed(".png", ".PNG"), CASE),
        (listed(".png", ".HEIC"), ENDING),
        (rename(lambda name: name.upper()), CASE),
        (rename(lambda name: name.replace("images", "Images")), None),
        (rename(lambda name: name.removeprefix("images/")), None),
        (
            all_of(
                rename(lambda name: name.replace("/0", f"/{accented('NFD')}0")),
                listed("00", f"{accented('NFC')}00"),
            ),
            CASE,
        ),
    ],
)
def test_names_of_another_system(tmp_path, make, change, note):
    """Each camera gets its own photograph, which its gray level tells."""
    make(tmp_path)
    change(tmp_path)
    scene = load_scene(tmp_path)
    assert scene.train.rgb[:, 0, 0, 0].tolist() == [1, 2]
    assert scene.test_far.rgb[:, 0, 0, 0].tolist() == [0]
    if note:
        assert scene.metadata["notes"][1].startswith(f"{tmp_path.name}: {note}")


@pytest.mark.parametrize(
    "place", ["C:\\\\Users\\\\me\\\\mine\\\\images\\\\", "/home/me/images/", "../"]
)
def test_paths_of_another_computer(tmp_path, place):
    single(tmp_path)
    listed("images/", place)(tmp_path)
    scene = load_scene(tmp_path)
    assert scene.train.rgb[:, 0, 0, 0].tolist() == [1, 2]
    assert f"{FOLDER}{place}".replace("\\\\", "\\") in scene.metadata["notes"][1]


def test_backslashes_need_no_note(tmp_path):
    single(tmp_path)
    listed("images/", ".\\\\images\\\\")(tmp_path)
    assert len(load_scene(tmp_path).metadata["notes"]) == 2


def test_llff_beside_its_photographs(tmp_path):
    llff(tmp_path)
    rename(lambda name: pathlib.PurePosixPath(name).name)(tmp_path)
    assert load_scene(tmp_path).train.rgb[:, 0, 0, 0].tolist() == [1, 2]


def test_views_without_photographs_are_not_scored(tmp_path):
    paper_capture(tmp_path)
    # The training photograph of the same name is not the one of the view.
    listed_views = [frame("test/a.png"), frame("test/b.png"), frame("test/c.png")]
    write_json(tmp_path / "transforms_test.json", listed_views)
    scene = load_scene(tmp_path)
    assert scene.names == {"train": ["a", "b"], "test": ["a"]}
    note = "transforms_test.json lists 2 views without photographs, which are not scored"
    assert scene.metadata["notes"] == (
        f"{tmp_path.name}: reading transforms_train.json",
        f"{tmp_path.name}: {note}",
    )
    (tmp_path / "test/a.png").unlink()
    assert load_scene(tmp_path).names == {"train": ["a", "b"]}


def test_what_is_not_used_is_counted(tmp_path):
    single(tmp_path)
    for name in ("images/9.png", "images/8.jpg", "masks/000.png", "masks/7.png", "extra/1.png"):
        write_image(tmp_path / name)
    for name in ("images_2/000.png", "cameras.png", "images/._0.png"):  # not worth a word
        write_image(tmp_path / name)
    note = (
        f"{tmp_path.name}: not used: 2 images in images/, 1 masks in masks/, the subfolder extra/"
    )
    assert note in load_scene(tmp_path).metadata["notes"]


@pytest.mark.parametrize("turned", [False, True])
def test_one_photograph_in_two_frames(tmp_path, turned):
    single(tmp_path)
    last = [0, 0, 1, 4] if turned else [0, 0, 1, 3]
    again = frame("./images/001.png", transform_matrix=[*POSE[:2].tolist(), last, [0, 0, 0, 1]])
    frames = [frame("images/001.png"), frame("images/002.png"), again]
    write_json(tmp_path / "transforms.json", frames)
    words = r"transforms\.json lists \./images/001\.png in more than one frame"
    words += ", with different poses: the first" if turned else ": the first frame of each is used"
    with pytest.warns(DuplicateFileWarning, match=words):
        scene = load_scene(tmp_path, split="every8")
    assert scene.metadata["files"]["test_far"] == [tmp_path / "images/001.png"]
    kept = scene.placement.poses_to_capture(scene.test_far.cameras.camtoworld)
    assert kept[0, 2, 3] == 3
