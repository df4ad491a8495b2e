"""The program closeup: what it starts, what it writes, and its page in a browser."""

import dataclasses
import json
import re
import shutil
from types import SimpleNamespace

import cv2
import jax
import numpy as np
import plane
import pytest
from absl import flags
from absl.testing import flagsaver
from browser import open_browser, wait

from jaxcloseup.app.cli import closeup as program
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.share.closeups import CloseUp
from jaxcloseup.app.share.scene_page import write_page


@pytest.fixture
def closeup(tmp_path, monkeypatch):
    """Run the program on a source with flags; returns its output folder."""
    monkeypatch.chdir(tmp_path)
    flags.FLAGS(["closeup"])

    def call(source, **given):
        given = {"output_dir": str(tmp_path / "out")} | given
        promotion = jax.numpy_dtype_promotion("standard")
        with promotion, flagsaver.flagsaver(compilation_cache="", **given):
            program.main(["closeup", str(source)])
        return tmp_path / "out"

    return call


@pytest.fixture
def started(monkeypatch):
    """The programs that the command starts, which leave what they would make."""
    commands = []

    def start(name, *given):
        commands.append([name, *given])

    monkeypatch.setattr(program, "_start", start)
    monkeypatch.setattr(program, "_present", lambda folder, run, asked, title: commands.append(run))
    return commands


def write_photographs(folder):
    folder.mkdir()
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(folder / name), np.zeros((4, 4, 3), np.uint8))
    return folder


def data_of(page):
    """What a page says of its scene."""
    text = (page / "data.js").read_text()
    return json.loads(text.removeprefix("const DATA = ").removesuffix(";\n"))


def test_photographs_get_poses_and_are_trained_on_as_far_as_that_is_not_done(
    closeup, started, tmp_path, capsys
):
    photographs = write_photographs(tmp_path / "photographs")
    out = closeup(photographs, minutes=3.0, at=["best"])
    find, train, shown = started
    assert find == ["process", f"--images={photographs}", f"--output_dir={out / 'capture'}"]
    assert train[:3] == ["run", f"--scene={out / 'capture'}", f"--output_dir={out / 'run'}"]
    assert "--minutes=3" in train and "--split=listed" in train
    assert "--resume" not in train and shown == out / "run"
    assert "photographs without poses" in capsys.readouterr().out
    # Stopped while it trained, then finished.
    (out / "run" / "checkpoints").mkdir(parents=True)
    closeup(photographs)
    assert started[4][-1] == "--resume"
    (out / "run" / "results.json").write_text("{}")
    closeup(photographs)
    assert started[6:] == [out / "run"]


def test_captures_and_videos_are_told_from_photographs(closeup, started, capture_folder, tmp_path):
    closeup(capture_folder, fix=True, check=False)
    assert started[0][:2] == ["run", f"--scene={capture_folder}"]
    assert started[0][-2:] == ["--nocheck", "--fix"] and "--split=listed" in started[0]
    closeup("table", output_dir=str(tmp_path / "drawn"))
    assert "--split=listed" not in started[2]  # a drawn scene has no lists
    video = tmp_path / "walk.mp4"
    video.write_bytes(b"")
    closeup(video, output_dir=None)
    assert started[4][:2] == ["process", f"--video={video}"]
    assert started[6] == program.pathlib.Path("outputs/walk/closeup/run")


def test_a_folder_holds_closeups_of_one_source(closeup, started, tmp_path, capsys):
    photographs = write_photographs(tmp_path / "monday")
    out = closeup(photographs)
    other = write_photographs(tmp_path / "tuesday")
    cv2.imwrite(str(other / "c.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(
        SystemExit, match=r"out holds close-ups of .*monday, not of .*tuesday: name"
    ):
        closeup(other)
    closeup(shutil.move(photographs, tmp_path / "moved"))  # the same photographs
    with pytest.raises(SystemExit, match=r"holds close-ups of .*monday, not of table"):
        closeup("table")
    assert "other files" not in capsys.readouterr().out
    cv2.imwrite(str(tmp_path / "moved" / "c.png"), np.zeros((4, 4, 3), np.uint8))
    shutil.move(tmp_path / "moved", photographs)
    (out / "run").mkdir()
    (out / "run" / "results.json").write_text("{}")
    closeup(photographs)
    assert "monday has other files than those that" in capsys.readouterr().out


@pytest.mark.parametrize(
    "name", ["mesh/a.ply", "share/index.html", "run/results.json", "source.json"]
)
def test_a_folder_that_no_closeup_began_stays_as_it_is(closeup, started, tmp_path, name):
    photographs, mine = write_photographs(tmp_path / "photographs"), tmp_path / "mine" / name
    mine.parent.mkdir(parents=True)
    mine.write_text("{}")
    with pytest.raises(SystemExit, match=r"--output_dir=.*mine already exists and is not empty"):
        closeup(photographs, mesh=True, output_dir=str(tmp_path / "mine"))
    assert [path for path in (tmp_path / "mine").rglob("*") if path.is_file()] == [mine]
    assert mine.read_text() == "{}" and not started


def write_run(folder):
    (folder / "checkpoints").mkdir(parents=True)
    return folder


@pytest.mark.parametrize("named", [False, True])
def test_closeups_of_a_run_go_into_its_folder(closeup, started, tmp_path, named):
    run = write_run(tmp_path / "run")
    closeup(run, output_dir=str(run) if named else None)
    assert started == [run] and not (run / "source.json").exists()
    mine = run / "mesh" / "mine.ply"
    mine.parent.mkdir()
    mine.touch()
    with pytest.raises(SystemExit, match="mesh already exists and is not empty: name a new"):
        closeup(run, output_dir=str(run) if named else None, mesh=True)
    assert mine.exists() and started == [run]


def test_a_mesh_that_was_cut_off_is_made_anew(closeup, started, monkeypatch, tmp_path):
    run, out = write_run(tmp_path / "run"), tmp_path / "out"
    endings = iter(["glb", "json"])

    def start(name, *given):
        assert not (out / "mesh").exists()
        started.append(name)
        (out / "mesh").mkdir()
        (out / "mesh" / f"mesh.{(ending := next(endings))}").touch()
        if ending == "glb":
            raise SystemExit(130)

    monkeypatch.setattr(program, "_start", start)
    with pytest.raises(SystemExit):
        closeup(run, mesh=True)
    closeup(run, mesh=True)
    closeup(run, mesh=True)  # it is there
    assert started == [run, "mesh", run, "mesh", run]
    assert {path.name for path in out.iterdir()} == {".lock", "source.json", "mesh"}


def test_a_link_to_nothing_is_no_photograph(closeup, started, tmp_path):
    photographs = write_photographs(tmp_path / "photographs")
    (photographs / "x.jpg").symlink_to("moved.jpg")
    out = closeup(photographs)
    files = json.loads((out / "source.json").read_text())["files"]
    assert [name for name, _ in files] == ["a.png", "b.png"]


def test_flags_that_come_after_training_are_said_to_change_nothing(
    closeup, started, tmp_path, capsys
):
    photographs = write_photographs(tmp_path / "photographs")
    out = closeup(photographs, minutes=3.0, check=False)
    (out / "run").mkdir()
    (out / "run" / "results.json").write_text("{}")
    capsys.readouterr()
    closeup(photographs, minutes=3.0, check=False)
    closeup(photographs)
    assert "stays as it is" not in capsys.readouterr().out
    closeup(photographs, minutes=20.0, check=False, fix=True)
    said = (
        "run is trained and stays as it is: to train with --minutes=20 --fix, name another folder"
    )
    assert said in capsys.readouterr().out
    # An earlier version did not write down how it trained.
    about = json.loads((out / "source.json").read_text())
    del about["check"]
    (out / "source.json").write_text(json.dumps(about))
    closeup(photographs, check=False)
    assert "to train with --nocheck, name" in capsys.readouterr().out
    run = write_run(tmp_path / "trained")
    closeup(run, output_dir=None)
    assert "stays as it is" not in capsys.readouterr().out
    closeup(run, output_dir=None, minutes=30.0)
    said = f"{run} is trained and stays as it is: to train with --minutes=30, name its capture"
    assert said in capsys.readouterr().out


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (-9, r"closeup: the program run was ended by signal 9 .*, perhaps for lack of memory: go"),
        (-11, r"closeup: the program run was ended by signal 11 \([^)]*\): go on with the same"),
        (3, "^3$"),  # it has said why
    ],
)
def test_a_program_that_is_killed_is_one_sentence(monkeypatch, code, said):
    monkeypatch.setattr(program.subprocess, "run", lambda _: SimpleNamespace(returncode=code))
    with pytest.raises(SystemExit, match=said) as ended:
        program._start("run", "--minutes=3")
    assert isinstance(ended.value.code, int) == (code > 0)


def test_folders_are_called_by_their_whole_name(tmp_path):
    """A date is no file ending."""
    (tmp_path / "2024.05.01").mkdir()
    assert program._name(str(tmp_path / "2024.05.01")) == "2024.05.01"
    assert program._name(str(tmp_path / "walk.mp4")) == "walk"
    assert program._name(str(tmp_path / "walk" / "photos")) == "walk"


@pytest.mark.parametrize(
    ("source", "given", "said"),
    [
        ("nothing", {}, "nothing does not exist"),
        ("table", {"data": "."}, r"--data=\. is for a run whose capture was moved"),
        ("table", {"at": ["train_001"]}, "--at=train_001 must be PHOTOGRAPH:x,y"),
    ],
)
def test_a_mistake_is_one_sentence_before_anything_is_written(
    closeup, started, tmp_path, source, given, said
):
    with pytest.raises(SystemExit, match=said):
        closeup(source, **given)
    assert not started and not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def presented(kept, tmp_path_factory):
    """The output of two calls for one run: a pixel of a photograph, then another."""
    run = shutil.copytree(kept, tmp_path_factory.mktemp("run") / "kept")
    (run / "dolly.webp").touch()
    flags.FLAGS(["closeup"])
    with jax.numpy_dtype_promotion("standard"), pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxcloseup.app.share.present._FRAMES", 2)
        for at, single in (("2:16,12", False), ("0:20,10", True), ("1:18,12", False)):
            with flagsaver.flagsaver(compilation_cache="", at=[at], near=2.0, single_file=single):
                program.main(["closeup", str(run)])
    return run


def test_closeups_are_nearer_and_the_page_keeps_earlier_ones(presented, capture_folder):
    data = data_of(presented / "share")
    assert [one["name"] for one in data["closeups"]] == ["2_16_12_2x", "0_20_10_2x", "1_18_12_2x"]
    # A run's report has one of its own.
    endings = {path.suffix for path in presented.glob("dolly.*")}
    assert endings & {".mp4", ".webm"} and ".webp" in endings
    picture = cv2.imread(str(presented / "closeups" / "2_16_12_2x.png")).astype(float)
    photograph = cv2.imread(str(capture_folder / "train" / "2.png")).astype(float)
    assert picture.shape == photograph.shape
    # The middle of the close-up is the pixel of the photograph, which is half as large.
    part = photograph[12 - 4 : 12 + 5, 16 - 6 : 16 + 7]
    half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    found = half[6 - 4 : 6 + 5, 8 - 6 : 8 + 7]
    assert np.abs(found - part).mean() < 0.5 * np.abs(part - part.mean(axis=(0, 1))).mean()
    # As three.js has it: the camera looks along -z at the point.
    first = data["closeups"][0]
    matrix = np.array(first["matrix"]).reshape(4, 4).T
    ahead = np.array(first["point"]) - matrix[:3, 3]
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), -matrix[:3, 2], atol=1e-5)
    np.testing.assert_allclose(first["target"], first["point"], atol=1e-5)


def test_a_field_without_splats_is_one_sentence(closeup, kept, monkeypatch):
    without = dataclasses.replace(METHODS["surfels"], splats=None)
    monkeypatch.setitem(METHODS, "surfels", without)
    with pytest.raises(SystemExit, match="--method=surfels, which has no splats for a page: make"):
        closeup(kept)


def test_an_empty_pixel_is_one_sentence(closeup, kept):
    with pytest.raises(SystemExit, match=r"--at=2:500,1 is outside the view"):
        closeup(kept, at=["2:500,1"])
    with pytest.raises(SystemExit, match=r"--at=none is no training view"):
        closeup(kept, at=["none:5,1"])


def test_a_page_of_one_file_needs_no_other(closeup, presented):
    out = closeup(presented, at=["0:20,10"], near=2.0, single_file=True)
    text = (out / "share" / "index.html").read_text()
    assert "<script src" not in text and "<link" not in text and "data:image/webp" in text
    assert sorted(path.name for path in (out / "share").iterdir()) == ["index.html", "licenses.txt"]


def test_a_photographs_name_is_no_markup_of_the_page(tmp_path):
    """Browsers take `<!--<script` for the begin of what only `</script>` twice would end."""
    camera, gray = plane.camera_above(0.0, 0.0, 3.0), np.full((24, 32, 3), 99, np.uint8)
    name = "<!--<script>_16_12_2x"
    one = CloseUp(name, camera, np.zeros(3), gray, gray, "here", "by little")
    page = write_page(
        tmp_path,
        [one],
        title="a </script> b",
        splats=b"",
        overview=camera,
        distance=3.0,
        up=np.array([0.0, 0, 1]),
        single_file=True,
    )
    (data,) = re.findall(r"const DATA = (.*);\n", page.read_text())
    assert "<" not in data
    assert json.loads(data)["closeups"][0]["name"] == name


def differ(image, expected):
    return np.abs(image.astype(float) - expected).mean()


def screenshot(driver):
    return cv2.imdecode(np.frombuffer(driver.get_screenshot_as_png(), np.uint8), 1)


STATE = "return document.body.dataset.state === arguments[0]"


def test_the_page_flies_to_a_closeup_and_shows_it_without_a_network(presented):
    with open_browser() as driver:
        driver.execute_cdp_cmd("Network.enable", {})
        driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": ["http*", "ws*"]})
        driver.get((presented / "share" / "index.html").as_uri())
        wait(driver, STATE, "free")
        names = driver.execute_script(
            "return performance.getEntriesByType('resource').map((entry) => entry.name)"
        )
        assert all(name.startswith(("file:", "data:", "blob:")) for name in names)
        driver.find_element("css selector", "#strip button").click()
        wait(driver, STATE, "shown")
        picture = "const p = document.getElementById('picture'); return p.complete && "
        wait(driver, picture + "getComputedStyle(p).opacity === '1' && p.naturalWidth")
        shown = screenshot(driver)
        assert driver.execute_script(picture + "p.naturalWidth") == plane.WIDTH
        # The scene behind the picture, drawn by the browser, shows the same from the same place.
        driver.execute_script("document.getElementById('picture').style.visibility = 'hidden'")
        height = shown.shape[0]
        middle = np.s_[height // 4 : height // 2, 300:600]
        off = [differ(screenshot(driver)[middle], shown[middle])]
        while off[-1] > 25 and len(off) < 60:
            off.append(differ(screenshot(driver)[middle], shown[middle]))
        assert off[-1] < 25
        assert differ(shown[middle], shown[middle].mean(axis=(0, 1))) > 10
        driver.find_element("id", "error").click()
        legend = "return document.getElementById('legend').hidden"
        assert not driver.execute_script(legend)
        driver.find_element("id", "back").click()
        wait(driver, STATE, "free")
        assert driver.execute_script(legend)
        logs = [entry["message"] for entry in driver.get_log("browser")]
    assert not [message for message in logs if "Error" in message]


def test_a_picture_within_the_page_is_saved(closeup, presented):
    """Browsers refuse to open addresses that hold a picture. Without WebGL there are no pins."""
    out = closeup(presented, at=["0:20,10"], near=2.0, single_file=True)
    with open_browser() as driver:
        driver.execute_cdp_cmd(
            "Page.addScriptToEvaluateOnNewDocument",
            {"source": "HTMLCanvasElement.prototype.getContext = () => null"},
        )
        driver.get((out / "share" / "index.html").as_uri())
        wait(driver, STATE, "free")
        assert not driver.find_elements("css selector", ".pin")
        driver.find_element("css selector", "#strip button").click()
        wait(driver, STATE, "shown")
        link = driver.find_element("id", "full")
        assert link.get_attribute("download").endswith("x.webp")
        assert link.text == "Save the picture"
