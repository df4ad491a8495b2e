"""Finished runs on one scene, compared from the files that they left."""

import json

import cv2
import numpy as np
import pytest
from absl import flags
from absl.testing import flagsaver
from pages import Page

from jaxcloseup.app.cli import compare as program
from jaxcloseup.app.report.comparison import MOST_BYTES


NAMES = ("a", "b", "c", "d")


def write_picture(folder, stage, split, name, image):
    path = folder / "renders" / stage / split / "rgb" / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)


def write_run(folder, psnr, *, level=100, stages=("baseline", "control"), size=(40, 30), **changes):
    """What a run leaves that scores `psnr` on close-ups and 10 dB more on ordinary views."""
    folder.mkdir(parents=True)

    def score(values):
        views = {name: {"psnr": value} for name, value in zip(NAMES, values, strict=True)}
        return {"psnr": float(np.mean(values)), "ssim": 0.5, "views": views}

    far = [value + 10 for value in psnr]
    scores = {"test": score(psnr), "test_far": score(far)}
    results = {
        **{"scene": "somewhere", "method": "surfels", "preset": "quick", "seed": 0},
        **{"resolution": list(size), "finer_resolution": None, "seconds": {"baseline": 90.0}},
        **{"stages": dict.fromkeys(stages, scores), "config": {"field": {"capacity": 7}, "x": 1}},
    }
    (folder / "results.json").write_text(json.dumps(results | changes))
    (folder / "manifest.json").write_text(json.dumps({"data_sha256": "same"}))
    rng = np.random.default_rng(0)
    for split in ("test", "test_far"):
        for name in NAMES:
            truth = rng.integers(0, 256, (size[1], size[0], 3), np.uint8)
            write_picture(folder, "truth", split, name, truth)
            for stage in stages:
                write_picture(folder, stage, split, name, np.full_like(truth, level))
    return folder


@pytest.fixture
def compare(tmp_path):
    flags.FLAGS(["compare"])

    def call(*folders):
        out = tmp_path / "out"
        with flagsaver.flagsaver(runs=list(map(str, folders)), output_dir=str(out)):
            program.main(["compare"])
        return json.loads((out / "compare.json").read_text()), Page(
            (out / "report.html").read_text()
        )

    return call


def test_runs_of_one_quality_are_as_good_as_each_other(tmp_path, compare):
    runs = [write_run(tmp_path / name / "run", [20, 21, 22, 23], level=50) for name in "xy"]
    about, _ = compare(*runs)
    assert "21.5 dB: as good as y/run (better in 0 of 4 views)" in about["verdict"]


def test_runs_are_compared_by_their_last_fair_stage(tmp_path, compare, capsys):
    first = write_run(tmp_path / "x" / "one", [20, 21, 22, 23], level=50)
    config = {"field": {"capacity": 9}, "x": 1}
    stages = ("baseline", "control", "closeup", "test_time", "detail")
    second = write_run(
        tmp_path / "y" / "two", [22, 20.5, 26, 25], level=200, stages=stages, config=config, seed=3
    )
    about, page = compare(first, second)
    sentence = about["verdict"]
    parts = "Close-ups", "y/two", "23.4 dB", "1.88 dB better", "x/one", "3 of 4 views"
    assert sorted(parts, key=sentence.index) == list(parts) and sentence in page.text
    said = " ".join(capsys.readouterr().out.split())
    assert sentence in said and "x/one │ 21.50" in said and "y/two │ 33.38" in said
    assert [about["runs"][name]["stage"] for name in ("x/one", "y/two")] == ["control", "detail"]
    differ = {"seed": ["0", "3"], "stage": ["control", "detail"], "capacity": ["7", "9"]}
    assert about["differences"] == differ
    close_ups, ordinary, _, listed = page.tables
    assert [row[:2] for row in close_ups[1:]] == [["x/one", "21.50"], ["y/two", "23.38"]]
    assert [row[:2] for row in ordinary[1:]] == [["x/one", "31.50"], ["y/two", "33.38"]]
    assert {name: values for name, *values in listed[1:]} == differ
    # The best, middle and worst view by the mean of both: a slider for each run, and the truth.
    assert page.headings[2:5] == ["c", "a", "b"]
    assert page.tags.index("input") < page.tags.index("table")
    pictures = page.pictures()
    assert len(pictures) == 3 * 5
    for i in range(0, 15, 5):
        renders, truths = [pictures[i], pictures[i + 2]], [pictures[i + j] for j in (1, 3, 4)]
        assert [round(image.mean() / 10) for image in renders] == [5, 20]
        assert all((truth == truths[0]).all() for truth in truths) and truths[0].std() > 20
    assert "script" not in page.tags


def test_the_page_of_many_large_pictures_stays_small(tmp_path, compare):
    size = (480, 360)
    folders = [write_run(tmp_path / name, [20, 21, 22, 23], size=size) for name in ("u", "v", "w")]
    _, page = compare(*folders)
    assert 1e6 < (tmp_path / "out" / "report.html").stat().st_size <= MOST_BYTES
    assert page.pictures()[0].shape == (360, 480, 3)


def test_runs_without_close_ups_are_compared_on_ordinary_views(tmp_path, compare):
    folders = []
    for name, value in (("u", 20.0), ("v", 21.0)):
        folder = write_run(tmp_path / name, [value] * 4)
        results = json.loads((folder / "results.json").read_text())
        for splits in results["stages"].values():
            del splits["test"]
        (folder / "results.json").write_text(json.dumps(results))
        folders.append(folder)
    about, page = compare(*folders)
    assert about["verdict"].startswith("Ordinary views are best in v, with a PSNR of 31.0 dB")
    assert len(page.pictures()) == 15


def test_runs_that_trained_at_other_sizes_are_compared(tmp_path, compare):
    """Their photographs are reduced otherwise, so hashes differ; scored alike, they compare."""
    at = {"scored_at": [80, 60], "seconds": {"baseline": 120.0, "compile": 60.0}}
    folders = [
        write_run(tmp_path / name, [psnr] * 4, resolution=size, **at)
        for name, psnr, size in (("u", 20.0, [40, 30]), ("v", 21.0, [20, 15]))
    ]
    (folders[1] / "manifest.json").write_text('{"data_sha256": "other", "resumed": true}')
    about, _ = compare(*folders)
    assert about["verdict"].startswith("Close-ups are best in v, with a PSNR of 21.0 dB")
    # Compiling is part of a stage's seconds; those before a run was resumed are not known.
    assert about["differences"]["minutes"] == ["2", "-"]


def test_runs_that_cannot_be_compared_are_refused_in_a_sentence(tmp_path, compare):
    one = write_run(tmp_path / "one", [20, 21, 22, 23])

    def refuse(sentence, *folders):
        with pytest.raises(SystemExit, match=f"^jaxcloseup compare: {sentence}"):
            compare(*folders)
        assert not (tmp_path / "out").exists()

    other = write_run(tmp_path / "other", [20, 21, 22, 23], scene="elsewhere")
    small = write_run(tmp_path / "small", [20, 21, 22, 23], size=(20, 15))
    split = write_run(tmp_path / "split", [20, 21, 22, 23])
    (split / "manifest.json").write_text('{"data_sha256": "another"}')
    (tmp_path / "empty").mkdir()
    refuse("--runs must name at least two folders of runs", one)
    refuse("--runs must name at least two folders of runs", one, one)
    refuse("--runs: .*empty has no results.json", one, tmp_path / "empty")
    refuse("--runs cannot be compared: one shows somewhere and other shows elsewhere", one, other)
    refuse("--runs cannot be compared: one has views of 40 x 30 pixels and .*20 x 15", one, small)
    refuse("--runs cannot be compared: one and split have other photographs", one, split)

    damaged = write_run(tmp_path / "damaged", [20, 21, 22, 23])
    (damaged / "renders" / "control" / "test" / "rgb" / "a.png").write_bytes(b"")
    refuse("--runs: .*damaged.*a.png is not a readable image", one, damaged)
    for i, stages in enumerate(({}, {"control": []}, {"control": {"test": {"views": {"a": 1}}}})):
        folder = write_run(tmp_path / f"broken{i}", [20, 21, 22, 23])
        results = json.loads((folder / "results.json").read_text())
        (folder / "results.json").write_text(json.dumps(results | {"stages": stages}))
        refuse(".*results.json: stages must hold scores by stage and split", one, folder)
