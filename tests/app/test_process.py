"""Poses of photographs and of a video of a built-in scene, against the exact ones."""

import json
import os
import pathlib
import shlex
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import PIL.Image
import pytest
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
    write_noise,
)

from jaxcloseup.artifacts import video as video_writer
from jaxcloseup.artifacts.video import write_video


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
