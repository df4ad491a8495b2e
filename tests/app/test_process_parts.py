"""Parts of the program process, and one sentence for each mistake."""

import os
import pathlib
import re
import sys
import warnings
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from absl import flags
from posing import run_process, write_noise
from textured_corner import texture
from wrong_input import HEIC, put

from jaxcloseup.app.process import capture_stages, solver_process, video_frames
from jaxcloseup.app.process.from_above import draw_cameras
from jaxcloseup.app.process.pairs import (
    choose_pairing,
    expected_seconds,
    pairs_to_match,
    similarity,
)
from jaxcloseup.app.process.photo_folder import copy_photographs, list_files
from jaxcloseup.app.process.video_frames import choose_frames, extract_frames
from jaxcloseup.app.run import manifest
from jaxcloseup.artifacts.video import write_video
from jaxcloseup.captures.load import SceneError, load_scene


pycolmap = pytest.importorskip("pycolmap")


def test_photographs_in_subfolders(tmp_path, capsys):
    """Of two cameras, with equal names, beside what is no photograph of the scene."""
    write_noise(tmp_path / "in", 2)
    for i, name in enumerate(["images", "left cam", "masks", "images_2", ".hidden", "made"]):
        write_noise(tmp_path / "in" / name, 2 + i)
    (tmp_path / "in/made/process.json").write_text("{}")
    names = ["0.png", "1.png", "images/0.png", "images/1.png"]
    names += [f"left cam/{i}.png" for i in range(3)]
    found, left_out = list_files(tmp_path / "in")
    assert [path.as_posix() for path in found] == names and list(left_out) == ["made/"]
    for i, name in enumerate(names):  # none is a copy of another
        image = np.random.default_rng(i).integers(0, 255, (60, 80, 3))
        cv2.imwrite(str(tmp_path / "in" / name), image)
    with pytest.raises(SystemExit, match="no two photographs show the same"):
        run_process(images=str(tmp_path / "in"), output_dir=str(tmp_path / "out"))
    assert "lie in 3 folders, each with a lens of its own" in capsys.readouterr().out
    database = pycolmap.Database.open(str(tmp_path / "out/colmap/database.db"))
    lenses = {image.name: image.camera_id for image in database.read_all_images()}
    database.close()
    assert set(lenses) == {name.replace(" ", "_") for name in names}
    groups = {(pathlib.PurePath(name).parent, lens) for name, lens in lenses.items()}
    assert len(groups) == len(set(lenses.values())) == 3


def test_results_of_this_package_are_no_photographs(tmp_path):
    """They are left out with all below them, and this is said; the folder that is given counts."""
    marks = [capture_stages.NAME, "source.json", manifest.NAME]
    write_noise(tmp_path / "in", 3)
    (tmp_path / "in" / manifest.NAME).write_text("{}")
    for i, mark in enumerate(marks):
        (tmp_path / f"in/outputs/{i}/share").mkdir(parents=True)
        (tmp_path / f"in/outputs/{i}" / mark).write_text("{}")
        write_noise(tmp_path / f"in/outputs/{i}/closeups", 3)
        write_noise(tmp_path / f"in/outputs/{i}/share/closeups", 3)
    found, left_out = list_files(tmp_path / "in")
    assert [path.name for path in found] == ["0.png", "1.png", "2.png"]
    assert left_out.pop(manifest.NAME) == "is not a photograph"
    assert list(left_out) == ["outputs/0/", "outputs/1/", "outputs/2/"]
    for mark, why in zip(marks, left_out.values(), strict=True):
        assert why.startswith(f"holds {mark}, as results of jaxcloseup do: move photographs")
    for path in found:
        (tmp_path / "in" / path).unlink()
    words = r"0 photographs .* beside 1 files .*, and outputs/0/ holds process\.json, as results"
    with pytest.raises(solver_process.ProcessingError, match=words):
        list_files(tmp_path / "in")


def test_jpegs_of_another_ending_are_photographs(tmp_path):
    names = ["0.jfif", "1.JFIF", "2.jpg"]
    for i, name in enumerate(names):
        data = cv2.imencode(".jpg", np.full((60, 80, 3), 50 * i, np.uint8))[1]
        (tmp_path / name).write_bytes(data.tobytes())
    found, left_out = list_files(tmp_path)
    assert [path.name for path in found] == names and not left_out
    copied, left_out = copy_photographs(found, tmp_path, tmp_path / "out")
    assert [copy.name for copy in copied] == ["0.jpg", "1.jpg", "2.jpg"] and not left_out


def test_numbered_folders_hold_photographs_unless_beside_their_originals(tmp_path):
    write_noise(tmp_path / "images_1", 2)
    write_noise(tmp_path / "images_2", 2)
    assert len(list_files(tmp_path)[0]) == 4
    write_noise(tmp_path / "images", 2)
    found = {path.parent.name for path in list_files(tmp_path)[0]}
    assert found == {"images", "images_1"}


def test_frames_are_sharp_and_evenly_spread():
    """Equal steps along the path, not in time, and the sharpest near each."""
    rng = np.random.default_rng(0)
    sharpness = rng.uniform(size=400)
    motion = np.where(np.arange(400) < 200, 1e-6, rng.uniform(0.01, 0.02, 400))  # first at rest
    motion[0] = 0
    chosen = choose_frames(sharpness, motion, 10)
    assert len(chosen) == 10 and sum(i < 200 for i in chosen) <= 1
    path, part = np.cumsum(motion), motion.sum() / 10
    places = path[chosen] / part - np.arange(10)
    assert (places > 0.25).all() and (places < 0.75).all()
    for i, frame in enumerate(chosen[1:], 1):
        near = np.flatnonzero(np.abs(path / part - i - 0.5) <= 0.25)
        assert sharpness[frame] == sharpness[near].max()
    assert choose_frames(sharpness, motion, 400) == list(range(400))


@pytest.mark.parametrize(
    ("aspect", "size"),
    [("4:3", (85, 48)), ("8:9", (64, 54)), ("1:1", (64, 48)), ("0:0", (64, 48)), ("9:1", (64, 48))],
)
def test_frames_of_a_video_have_square_pixels(tmp_path, aspect, size):
    """Of the given aspect in the file; none is given, or none that a camera has, in the last."""
    picture, chroma = texture(0)[:48, :, 0], np.full((2, 48, 64), 128, np.uint8).tobytes()
    with open(tmp_path / "video.y4m", "wb") as file:
        file.write(f"YUV4MPEG2 W64 H48 F25:1 Ip A{aspect} C444\n".encode())
        for i in range(0, 40, 4):
            file.write(b"FRAME\n" + picture[:, i : i + 64].tobytes() + chroma)
    (tmp_path / "out").mkdir()
    copied, count = extract_frames(tmp_path / "video.y4m", 3, tmp_path / "out")
    assert count == 10 and len(copied) == 3
    for copy in copied:
        assert copy.size == size
        shown = cv2.imread(str(tmp_path / "out" / copy.name))
        assert shown.shape == (*size[::-1], 3)


@pytest.mark.parametrize(("degrees", "shape"), [(0, (40, 60)), (90, (60, 40)), (180, (40, 60))])
def test_pixels_of_a_turned_video_are_turned_with_it(monkeypatch, degrees, shape):
    """The file says how wide pixels are as stored; the reader turns frames upright."""
    stored = np.zeros((40, 30, 3), np.uint8)
    given = {
        cv2.CAP_PROP_SAR_NUM: 2.0,
        cv2.CAP_PROP_SAR_DEN: 1.0,
        cv2.CAP_PROP_ORIENTATION_META: degrees,
    }
    upright = np.rot90(stored, degrees // 90)
    opened = SimpleNamespace(
        get=given.get, grab=lambda: True, retrieve=lambda: (True, upright), release=lambda: None
    )
    monkeypatch.setattr(video_frames, "open_video", lambda _: opened)
    ((_, frame),) = video_frames._frames(pathlib.Path("video.mp4"), [0])
    assert frame.shape == (*shape, 3)


def test_pairs():
    rng = np.random.default_rng(0)
    places = rng.integers(0, 255, (4, 60, 128))
    # Photographs of four places in turn: descriptors of one place differ by noise.
    descriptors = [
        np.clip(places[i % 4] + rng.integers(-20, 20, (60, 128)), 0, 255).astype(np.uint8)
        for i in range(160)
    ]
    descriptors[7] = np.zeros((0, 128), np.uint8)
    likeness = similarity(descriptors)
    kind = np.arange(160) % 4
    same = (kind[:, None] == kind) & ~np.eye(160, dtype=bool)
    seen = np.arange(160) != 7
    assert (
        likeness[same & seen & seen[:, None]].min()
        > likeness[~same & (kind[:, None] != kind)].max()
    )
    pairs = pairs_to_match("retrieval", descriptors)
    assert pairs == sorted(set(pairs)) and all(i < j for i, j in pairs)
    assert {(i, i + 1) for i in range(159)} <= set(pairs)
    others = [(i, j) for i, j in pairs if j != i + 1 and 7 not in (i, j)]
    assert all(kind[i] == kind[j] for i, j in others)
    assert len(pairs) < 160 * 32
    pairs = set(pairs_to_match("sequential", descriptors))
    assert {(i, i + step) for step in (*range(1, 11), 16, 32, 64) for i in range(96)} <= pairs
    pairs = pairs_to_match("exhaustive", descriptors)
    assert len(pairs) == len(set(pairs)) == 160 * 159 // 2 and all(i < j for i, j in pairs)
    # Pairs that follow each other are of few photographs.
    assert max(len(set(sum(pairs[at : at + 64], ()))) for at in range(0, len(pairs), 64)) <= 32
    # What was measured on two cores.
    assert expected_seconds([(800, 600)] * 97, "exhaustive", 2) == pytest.approx(86, rel=0.2)
    assert expected_seconds([(3024, 4032)] * 45, "exhaustive", 2) == pytest.approx(374, rel=0.2)
    assert choose_pairing("auto", 100, video=False) == "exhaustive"
    assert choose_pairing("auto", 101, video=False) == "retrieval"
    assert choose_pairing("auto", 10, video=True) == "sequential"
    assert choose_pairing("exhaustive", 900, video=True) == "exhaustive"


def test_flags_that_make_no_sense_are_one_sentence(tmp_path):
    write_noise(tmp_path / "few", 2)
    (tmp_path / "empty").mkdir()
    (tmp_path / "texts").mkdir()
    for i in range(3):
        (tmp_path / "texts" / f"{i}.txt").write_text("")
        (tmp_path / "few" / f"{i}.heic").write_text("")
        put(f"heic/{i}.HEIC", HEIC)(tmp_path)
    (tmp_path / "video.mp4").write_bytes(b"no video" * 1000)
    os.mkfifo(tmp_path / "pipe")
    video, images, out = str(tmp_path / "video.mp4"), str(tmp_path / "few"), str(tmp_path / "out")
    for given, message in (
        ({}, "give either --images=FOLDER or --video=FILE"),
        ({"images": images, "video": video}, "give either"),
        ({"images": images}, "--output_dir is missing"),
        ({"images": images, "count": 5, "output_dir": out}, "--count is for --video"),
        ({"images": f"{images}/0.png", "output_dir": out}, "is not a folder: name a folder"),
        ({"images": f"{images}/none", "output_dir": out}, "is not a folder"),
        ({"images": images, "output_dir": out}, "holds 2 photographs .* beside 3 files"),
        ({"images": str(tmp_path / "empty"), "output_dir": out}, "holds 0 photographs"),
        ({"images": str(tmp_path / "texts"), "output_dir": out}, "holds 0 photographs .* 3 files"),
        (
            {"images": str(tmp_path / "heic"), "output_dir": out},
            "holds 0 photographs .* and 0.HEIC is a HEIC photograph, which is not read: export it",
        ),
        ({"video": images, "output_dir": out}, "cannot be read .Is a directory.: name a video"),
        ({"video": str(tmp_path / "pipe"), "output_dir": out}, "cannot be read .Not an ordinary"),
        ({"video": f"{video}4", "output_dir": out}, "cannot be read .No such file"),
    ):
        with pytest.raises(SystemExit, match=message) as error:
            run_process(**given)
        assert "\n" not in error.value.code and error.value.code.startswith("jaxcloseup process: ")
        assert not (tmp_path / "out").exists()
    renamed = [pathlib.Path(f"heic/{i}.HEIC") for i in range(3)]
    with pytest.raises(
        solver_process.ProcessingError, match=r"only 0 .*0\.HEIC is a HEIC photograph, which"
    ):
        copy_photographs(renamed, tmp_path, tmp_path / "out")
    with pytest.raises(flags.IllegalFlagValueError, match="count"):
        run_process(video=video, count=2)
    write_noise(tmp_path / "noise", 3)
    with pytest.raises(SystemExit, match="already exists and is not empty"):
        run_process(images=str(tmp_path / "noise"), output_dir=images)
    assert len(list((tmp_path / "few").iterdir())) == 5


def test_a_video_that_is_none_or_shows_no_motion_is_one_sentence(tmp_path):
    (tmp_path / "video.mp4").write_bytes(b"no video" * 1000)
    still = np.random.default_rng(0).integers(0, 255, (64, 96, 3)).astype(np.uint8)
    for path, message in (
        (tmp_path / "video.mp4", "is not a video that can be read"),
        (write_video(tmp_path / "still", [still] * 12, fps=12), "hardly moves"),
        (write_video(tmp_path / "short", [still] * 2, fps=12), "has 2 readable frames"),
    ):
        with pytest.raises(SystemExit, match=message) as error:
            run_process(video=str(path), output_dir=str(tmp_path / "out"))  # the same again
        assert "\n" not in error.value.code
        assert not (tmp_path / "out" / "images").exists()
        assert (tmp_path / "out").exists() == (path.name != "video.mp4")


def test_pycolmap_is_not_installed(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    write_noise(tmp_path / "noise", 3)
    with pytest.raises(SystemExit, match=r"needs pycolmap: .* 'jaxcloseup\[colmap\]'"):
        run_process(images=str(tmp_path / "noise"), output_dir=str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_solver_that_dies_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(solver_process.sys, "executable", "false")
    message = r"pycolmap ended with code 1 in finding: .*log"
    given = {"names": ["a"] * 9999}
    with pytest.raises(solver_process.ProcessingError, match=message):
        solver_process.run_job("features", "finding", "photographs", tmp_path / "log", **given)


def test_a_run_on_photographs_names_the_command(tmp_path):
    folder = tmp_path / "my photos"
    write_noise(folder, 3)
    command = f"jaxcloseup process --images='{folder}' --output_dir='my photos_capture'"
    with pytest.raises(SceneError, match=re.escape(command)) as error:
        load_scene(folder)
    assert "\n" not in str(error.value) and "poses" in str(error.value)
    (tmp_path / "two").mkdir()
    folder.rename(tmp_path / "two" / "images")
    with pytest.raises(
        SceneError, match=r"process --images=\S*two/images --output_dir=two_capture"
    ):
        load_scene(tmp_path / "two")
    (tmp_path / "none").mkdir()
    with pytest.raises(SceneError, match=r"none holds no capture: add transforms_train\.json"):
        load_scene(tmp_path / "none")


def test_one_camera_is_shown_from_above():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shown = draw_cameras(np.eye(3, 4)[None], np.zeros((0, 3)), np.zeros((0, 3)))
    assert shown.startswith(b"\x89PNG")
