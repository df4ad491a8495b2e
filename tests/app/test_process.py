"""Poses of photographs and of a video of a built-in scene, against the exact ones."""

import json
import os
import pathlib
import re
import shlex
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import PIL.Image
import pytest
from absl import flags
from posing import (
    FOCAL,
    FOCAL_IN_EXIF,
    FRAMES,
    HEIGHT,
    OTHERS,
    WIDTH,
    errors,
    photograph,
    poses_by_name,
    run_process,
    save,
    summary_of,
    walk_around,
)
from wrong_input import HEIC, put

from jaxcloseup.app.process import solver_process
from jaxcloseup.app.process.pairs import (
    choose_pairing,
    expected_seconds,
    pairs_to_match,
    similarity,
)
from jaxcloseup.app.process.photo_folder import copy_photographs, list_files
from jaxcloseup.app.process.video_frames import choose_frames
from jaxcloseup.artifacts import video as video_writer
from jaxcloseup.artifacts.video import write_video
from jaxcloseup.captures.load import SceneError, load_scene


pycolmap = pytest.importorskip("pycolmap")

ROOT = pathlib.Path(__file__).parents[2]


@pytest.fixture(scope="module")
def walk():
    """Frames `[F, H, W, 3]` of a camera that moves around a scene, and its poses."""
    poses = walk_around("bench", FRAMES)
    return photograph("bench", poses), poses


@pytest.fixture(scope="module")
def folder(walk, tmp_path_factory):
    """Photographs as people have them, and a few of another scene: its negatives."""
    made = tmp_path_factory.mktemp("photographs")
    rgb, _ = walk
    for i, one in enumerate(rgb):
        save(made / f"walk {i:02d}.{'jpg' if i == 6 else 'png'}", one, turned=i == 6)
    for i, one in enumerate(rgb[:OTHERS]):
        save(made / f"negative_{i}.png", 255 - one)
    (made / "z copy.png").write_bytes((made / "walk 00.png").read_bytes())
    (made / "cut.jpg").write_bytes((made / "walk 06.jpg").read_bytes()[:9000])
    (made / "gray.png").write_bytes(cv2.imencode(".png", np.full((90, 120, 3), 128))[1].tobytes())
    (made / "notes\x1b.txt").write_text("of the walk")
    return made


@pytest.fixture(scope="module")
def capture(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("captures") / "walk"
    run_process(images=str(folder), output_dir=str(out))
    return out


def test_poses_of_photographs(capture, walk):
    """Rotations to 0.2 degrees, positions to 1 % of the extent, the focal length to 2 %."""
    scene, found = poses_by_name(capture)
    indices = {name: int(name[-2:]) for name in found}
    assert sorted(indices.values()) == list(range(FRAMES))
    away, turned = errors(list(found.values()), walk[1][list(indices.values())])
    assert away.max() < 0.01 and turned.max() < 0.2
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0, 0], FOCAL, rtol=0.02)
    assert len(scene.points) > 1000
    assert scene.metadata["format"] == "colmap"


def test_an_orientation_is_applied_once(capture, walk):
    """The photograph that is stored sideways comes out like its neighbors, with its EXIF."""
    path = capture / "images" / "walk_06.jpg"
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert stored.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(stored.astype(int) - walk[0][6]).mean() < 4
    with PIL.Image.open(path) as image:
        exif = image.getexif()
        assert exif.get(0x0112, 1) == 1 and exif.get_ifd(0x8769)[0xA405] == FOCAL_IN_EXIF


def test_upright_photographs_are_copied_as_they_are(capture, folder):
    copies = {path.name for path in (capture / "images").iterdir()}
    assert "walk_03.png" in copies and len(copies) == FRAMES + OTHERS + 1
    assert (capture / "images/walk_03.png").read_bytes() == (folder / "walk 03.png").read_bytes()


def test_focal_lengths_come_from_exif(capture):
    """The solution starts from it: 43.27 mm are the diagonal of a frame 36 mm x 24 mm."""
    database = pycolmap.Database.open(str(capture / "colmap" / "database.db"))
    starts = {camera.width: camera for camera in database.read_all_cameras()}
    database.close()
    expected = FOCAL_IN_EXIF / np.hypot(36, 24) * np.hypot(WIDTH, HEIGHT)
    assert starts[WIDTH].focal_length_x == pytest.approx(expected, rel=1e-3)
    assert starts[WIDTH].has_prior_focal_length and not starts[120].has_prior_focal_length
    assert len(starts) == 2  # photographs of one lens share it
    assert summary_of(capture)["lenses"][0]["focal_length_in_exif"] is True


def test_what_is_left_out_is_named_with_a_reason(capture):
    summary = summary_of(capture)
    assert summary["photographs"] == FRAMES + OTHERS + 1
    assert summary["registered"] == FRAMES and summary["other_models"] == [OTHERS]
    left_out = summary["left_out"]
    assert "another model" in left_out["negative_2.png"]
    assert left_out["z copy.png"] == "is the same file as walk 00.png"
    assert "truncated" in left_out["cut.jpg"]
    assert left_out["gray.png"].startswith("has only 0 features")
    assert left_out["notes\\x1b.txt"] == "is not a photograph"
    assert len(left_out) == OTHERS + 4
    assert 0 < summary["reprojection_error"] < 1
    picture = cv2.imread(str(capture / "cameras.png"))
    assert picture.shape[0] > 500 and picture.std() > 10


def test_poses_of_a_video(walk, tmp_path, monkeypatch):
    """A video by the program's own writer; a third of its frames is blurred, and none is taken."""
    monkeypatch.setattr(video_writer, "_has_ffmpeg", lambda: False)  # the same codec everywhere
    rgb, poses = walk
    frames = [cv2.blur(one, (9, 9)) if i % 3 == 1 else one for i, one in enumerate(rgb)]
    video, out = write_video(tmp_path / "walk", frames, fps=12), tmp_path / "capture"
    run_process(video=str(video), count=12, output_dir=str(out))
    scene, found = poses_by_name(out)
    indices = [int(name.removeprefix("frame_")) for name in found]
    assert len(indices) == summary_of(out)["photographs"] >= 8
    assert all(i % 3 != 1 for i in indices)
    away, turned = errors(list(found.values()), poses[indices])
    # A dozen small frames after lossy compression: docs/programs.md has a real video's figures.
    assert away.max() < 0.01 and turned.max() < 0.4
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0, 0], FOCAL, rtol=0.03)


def test_the_same_command_continues_and_gives_the_same(walk, tmp_path):
    """Ctrl-C while it matches; then the same model as without it, to the last bit."""
    source, cut, whole = tmp_path / "source", tmp_path / "cut off", tmp_path / "whole"
    source.mkdir()
    for i, one in enumerate(walk[0][:10:2]):
        small = cv2.resize(one, (320, 180), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(source / f"{i}.png"), small[..., ::-1])
    command = [f"--images={source}", f"--output_dir={cut}", "--compilation_cache="]
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        [sys.executable, "-m", "experiments.process", *command],
        cwd=ROOT,
        env={**os.environ, "XLA_FLAGS": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    signal.signal(signal.SIGINT, ours)
    try:
        assert any(line.startswith("matching") for line in process.stdout)
        children = pathlib.Path(f"/proc/{process.pid}/task/{process.pid}/children")
        solvers = children.read_text().split() if children.exists() else []
        began = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
        assert time.monotonic() - began < 10  # 2 seconds on a quiet computer
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 130
    resume = shlex.join(["python", "-m", "experiments.process", *command])
    assert said == f"experiments.process: stopped: continue it with {resume}\n"
    deadline = time.monotonic() + 10
    while any(pathlib.Path(f"/proc/{one}").exists() for one in solvers):
        assert time.monotonic() < deadline, "the solver goes on"
        time.sleep(0.05)

    before = json.loads((cut / "process.json").read_text())["stages"]
    assert list(before) == ["photographs", "features"]
    run_process(images=str(source), output_dir=str(cut))
    after = json.loads((cut / "process.json").read_text())["stages"]
    assert {name: after[name] for name in before} == before
    assert list(after) == ["photographs", "features", "matches", "mapping"]
    run_process(images=str(source), output_dir=str(whole))
    models = [sorted((out / "sparse" / "0").iterdir()) for out in (cut, whole)]
    assert [path.name for path in models[0]] == [path.name for path in models[1]]
    for one, other in zip(*models, strict=True):
        assert one.read_bytes() == other.read_bytes(), one.name

    with pytest.raises(SystemExit, match=r"made from something else \(lens was perspective and"):
        run_process(images=str(source), output_dir=str(whole), lens="fisheye")


# Parts.


def test_photographs_in_subfolders(tmp_path, capsys):
    """Of two cameras, with equal names, beside what is no photograph of the scene."""
    write_noise(tmp_path / "in", 2)
    for i, name in enumerate(["left cam", "right", "masks", "images_2", ".hidden", "made"]):
        write_noise(tmp_path / "in" / name, 2 + i)
    (tmp_path / "in/made/process.json").write_text("{}")
    names = ["0.png", "1.png", "left cam/0.png", "left cam/1.png"]
    names += [f"right/{i}.png" for i in range(3)]
    found, left_out = list_files(tmp_path / "in")
    assert [path.as_posix() for path in found] == names and not left_out
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


# Bad input.


def write_noise(folder, count):
    """Small photographs without anything in common."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for i in range(count):
        picture = rng.integers(0, 255, (60, 80, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{i}.png"), picture)


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


def test_photographs_without_a_model_are_one_sentence(walk, tmp_path):
    """Of nothing in common; all the same file; all from one place."""
    write_noise(tmp_path / "noise", 4)
    with pytest.raises(SystemExit, match="no two photographs show the same"):
        run_process(images=str(tmp_path / "noise"), output_dir=str(tmp_path / "out"))
    assert not (tmp_path / "out" / "sparse").exists()
    log = (tmp_path / "out" / "colmap" / "log.txt").read_text()
    assert "Traceback" not in log
    (tmp_path / "same").mkdir()
    (tmp_path / "place").mkdir()
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"same/{i}.png"), walk[0][0])
        cv2.imwrite(str(tmp_path / f"place/{i}.png"), np.roll(walk[0][0], 3 * i, axis=1))
    with pytest.raises(SystemExit, match=r"only 1 different photographs .* is the same file as 0"):
        run_process(images=str(tmp_path / "same"), output_dir=str(tmp_path / "out2"))
    with pytest.raises(SystemExit, match="3 of 3 photographs overlap, but no poses fit them"):
        run_process(images=str(tmp_path / "place"), output_dir=str(tmp_path / "out3"))


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
