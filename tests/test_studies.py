"""Tables of studies from files of made-up runs, whose numbers are easy to check."""

import dataclasses
import json
import re
import shutil
from types import SimpleNamespace

import jax
import numpy as np
import PIL.Image
import pytest
from tiny_runs import TINY, programs_of

from experiments.studies import (
    default_runs,
    detail_teachers,
    few_photographs,
    interruptions,
    methods_table,
    paper_nerf,
    paper_regime,
)
from experiments.studies.pictures import write_rows
from experiments.studies.tables import finished_runs, format_gain
from jaxcloseup.app.cli.closeup_folder import check_folder, check_source
from jaxcloseup.app.methods.method import TargetConfig
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import with_settings
from jaxcloseup.labels.config import LabelConfig


LEVELS = {"baseline": 20.0, "control": 21.0, "closeup": 21.5, "detail": 23.0}
LEVELS |= {"test_time_control": 21.25, "test_time": 22.25}


def write_run(folder, scene, gate=None, label="warp"):
    """Write results whose second view is 2 dB better, ordinary views 10 dB more."""

    def scores(level):
        views = {"a": {"psnr": level - 1}, "b": {"psnr": level + 1}}
        return {"psnr": level, "cc_psnr": level + 0.5, "ssim": 0.5, "views": views}

    stages = {
        stage: {"test": scores(level), "test_far": scores(level + 10), "zoom_1": scores(level)}
        for stage, level in LEVELS.items()
    }
    folder.mkdir()
    config = {"labels": {"label": label}, "targets": None}
    results = {"scene": scene, "stages": stages, "gate": gate, "config": config}
    (folder / "results.json").write_text(json.dumps(results))
    return str(folder)


def test_what_closeups_made_is_compared_but_for_times(tmp_path):
    """Checkpoints and logs, which depend on when a program was stopped, do not count."""
    one, other = tmp_path / "one", tmp_path / "other"
    for folder, seconds in ((one, 10), (other, 20)):
        for name in ("share/a/page.js", "closeups/a.png", "run/checkpoints/a", "capture/log.txt"):
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(str(seconds) if "check" in name or "log" in name else "same")
        results = {"psnr": 20.0, "seconds": {"baseline": seconds}, "rows": [{"time": seconds}]}
        (folder / "run" / "results.json").write_text(json.dumps(results))
    assert interruptions.differing(one, other) == []
    (other / "closeups" / "b.png").write_text("more")
    (other / "share" / "a" / "page.js").write_text("changed")
    (other / "run" / "results.json").write_text('{"psnr": 20.1, "rows": [{}]}')
    expected = ["closeups/b.png", "run/results.json", "share/a/page.js"]
    assert interruptions.differing(one, other) == expected == interruptions.differing(other, one)


def test_interrupted_closeups_begin_with_the_settings_of_finished_ones(tmp_path):
    source, whole, folder = (tmp_path / name for name in ("photographs", "whole", "0"))
    for path, text in {
        source / "a.jpg": "a",
        whole / "run" / "checkpoints" / "run.json": "{}",
        whole / "source.json": json.dumps({"source": str(source), "files": [["a.jpg", 1]]}),
        whole / "share" / "index.html": "a page",
    }.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    interruptions.begin(whole, folder)
    check_folder(str(source), "photographs", folder, mesh=False)  # closeup goes on in it
    check_source(str(source), "photographs", folder)
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert files == {"run/checkpoints/run.json", "source.json"}


def test_tables_of_default_runs(tmp_path, capsys):
    runs = [write_run(tmp_path / "a", "bench"), write_run(tmp_path / "b", "/data/plush")]
    default_runs.print_all(finished_runs(runs, tmp_path, ()))
    out = capsys.readouterr().out
    gain = "+2.00 (+2.00 to +2.00) | +2.00 | 31.50 / 33.50 | - / - | 0.500 / 0.500 | - / -"
    assert f"| plush, ordinary | 31.00 | **33.00** | {gain} |" in out
    assert "mean of drawn scenes, close-ups: +2.00 (+2.00 to +2.00) dB" in out
    labels = (
        "+0.500 (+0.500 to +0.500) | +0.500 | 21.25 | **22.25** | +1.00 (+1.00 to +1.00) | +1.00"
    )
    assert f"| bench | {labels} |" in out


def test_a_closed_gate_is_said(tmp_path, capsys):
    folder = write_run(tmp_path / "a", "bench", gate={"weight": 0.0})
    default_runs.print_all(finished_runs([folder], tmp_path, ()))
    assert "| bench | the gate admits no labels |" in capsys.readouterr().out
    folder = write_run(tmp_path / "b", "bench", gate={"weight": 0.0}, label="residual")
    default_runs.print_all(finished_runs([folder], tmp_path, ()))  # labels that it does not govern
    assert "| bench | +0.500 (+0.500 to +0.500) |" in capsys.readouterr().out


def test_the_table_of_few_photographs(tmp_path, capsys):
    (tmp_path / "runs").mkdir()
    write_run(tmp_path / "runs" / "table", "table")
    runs = finished_runs([], tmp_path / "runs", ["table"])  # it is there already
    few_photographs.print_photographs(runs, runs, "20 photographs")
    gain = "+2.00 (+2.00 to +2.00)"
    row = f"| table | 21.00 / 31.00 | 23.00 / 33.00 | {gain} | {gain} | 21.00 / 23.00 |"
    assert row in capsys.readouterr().out


def test_the_table_of_methods_has_means_of_drawn_scenes(capsys):
    def record(psnr):
        scores = {"test": {"psnr": psnr, "depth": 0.02}, "test_far": {"psnr": psnr + 5}}
        return {"arms": {"control": scores}, "core_seconds": 60 * psnr, "peak_bytes": None}

    found = {"ngp": {"room": record(20.0), "table": record(22.0), "plush": record(30.0)}}
    found["nerf"] = {"room": record(21.0), "plush": record(29.0)}  # it failed on the other
    methods_table.print_methods(found, "control")
    out = capsys.readouterr().out
    assert "| method | 2 drawn scenes: close-ups / ordinary |" in out
    assert "| ngp | 21.00 / 26.00 | 2.0 / - | 30.00 / 35.00 | 2.0 / - | 24.0 |" in out
    assert "| nerf | - / - | - / - | 29.00 / 34.00 | 2.0 / - | - |" in out


def test_gains_have_an_interval_over_views():
    values = [0.0, 1.0, 2.0, 3.0]
    mean, low, high = map(float, re.findall(r"[+-]\d\.\d\d", format_gain(values)))
    assert mean == 1.5 and 0 < low < mean < high < 3
    assert format_gain([0.5]) == "+0.50"


def test_pictures_stand_in_rows(tmp_path):
    tall, flat = np.zeros((30, 40, 3), np.uint8), np.full((20, 40, 3), 200, np.uint8)
    write_rows(tmp_path / "a.jpg", [[tall, flat], [flat]], ["one", "two"])
    with PIL.Image.open(tmp_path / "a.jpg") as picture:
        assert picture.size == (86, 30 + 24 + 20)
        assert np.abs(np.asarray(picture)[-10, 20].astype(int) - 200).max() < 8


def test_the_tables_of_the_papers_regime(tmp_path, capsys):
    folder = write_run(tmp_path / "a", "table")
    results = json.loads((tmp_path / "a" / "results.json").read_text())
    views = results["stages"]["control"]["test"]
    views |= {"ray_angle": 20.0}
    views["views"]["a"] |= {"ray_angle": 5.0, "depth_ratio": 4.0}
    views["views"]["b"] |= {"ray_angle": 35.0, "depth_ratio": 2.0}
    paper_regime.print_scene(
        "table", results, {"3DGS": finished_runs([folder], tmp_path, ())["table"]}
    )
    out = capsys.readouterr().out
    scores = "21.50 | 0.500 | 22.00 | - | 31.50 | 0.500"
    assert f"| labels by the text | {scores} | +0.50 (+0.50 to +0.50) | +0.50" in out
    assert "| 3DGS | 20.00 | 0.500 | 20.50 | - | 30.00 | 0.500 | - | - |" in out
    near, aside = (
        "1 | 5.0 | 4.0 | 20.00 | +0.50 | - | +2.00 |",
        "1 | 35.0 | 2.0 | 22.00 | +0.50 | - | +2.00 |",
    )
    assert f"| 0 to 10 | {near}" in out and f"| 30 to 45 | {aside}" in out
    assert f"| 4 to 6 | {near}" in out and f"| 1.5 to 2.5 | {aside}" in out


def test_the_ladder_says_what_each_step_adds(tmp_path, capsys):
    write_run(tmp_path / "a", "table")
    before = json.loads((tmp_path / "a" / "results.json").read_text())
    after = json.loads((tmp_path / "a" / "results.json").read_text())
    after["stages"]["control"]["test"]["views"] = {"a": {"psnr": 21.0}, "b": {"psnr": 24.0}}
    paper_regime.print_ladder("table", {"paper": before, "antialiasing": after})
    out = capsys.readouterr().out
    assert "| paper | 21.00 | 0.500 | 21.50 | - | 31.00 | 0.500 | - | - | 23.00 |" in out
    assert "| +1.50 (+1.00 to +2.00) | +0.00 (+0.00 to +0.00) | 23.00 |" in out


def test_each_step_of_the_ladder_keeps_those_before_it_since_a_preset(monkeypatch):
    made = []
    given = SimpleNamespace(shorter=1, given=["seed=0"], output_dir="runs")
    monkeypatch.setattr(paper_regime, "FLAGS", given)
    monkeypatch.setattr(paper_regime, "_run", lambda folder, scene, *words: made.append(words))
    assert paper_regime.ladder_results("table") == {}
    presets = [[word for word in words if "preset" in word] for words in made]
    assert presets == 3 * [["--preset=paper"]] + 2 * [["--preset=quick"]]
    settings = [{word for word in words if word.startswith("--set")} for words in made]
    assert settings[0] == settings[4] == set() and settings[1] < settings[2]
    assert settings[3] == {"--set=stereo.pixels=0"}
    assert all("--seed=0" in words for words in made)


def test_the_ladder_begins_at_the_other_tables_run_where_that_is_finished(tmp_path, monkeypatch):
    made = []
    given = SimpleNamespace(shorter=10, given=["choose=first"], output_dir=str(tmp_path))
    monkeypatch.setattr(paper_regime, "FLAGS", given)
    monkeypatch.setattr(paper_regime, "_run", lambda folder, *words: made.append(folder.name))
    paper_regime.ladder_results("table")
    (tmp_path / "paper_choose_first_shorter_10").mkdir()
    write_run(tmp_path / "paper_choose_first_shorter_10" / "table", "table")
    paper_regime.ladder_results("table")
    own = [f"ladder_{index}_choose_first_shorter_10" for index in range(5)]
    assert made == [*own, "paper_choose_first_shorter_10", *own[1:]]


def test_a_shorter_regime_has_no_other_proportions():
    preset = METHODS["surfels"].presets["paper_adaptive"]
    found = dict(text.split("=") for text in paper_regime.shorter(preset, 10))
    assert found["baseline_steps"] == "3000" and found["density.reset_every"] == "300"
    short = with_settings(preset, [f"{name}={value}" for name, value in found.items()])
    for before, after in ((preset.field, short.field), (preset.field.density, short.field.density)):
        for field in dataclasses.fields(before):
            name, values = field.name, [getattr(side, field.name) for side in (before, after)]
            if {name, f"density.{name}"} & set(found):
                assert values[0] == 10 * values[1]
            elif isinstance(values[0], int) and values[0] > 99:
                assert name == "capacity"  # no count of steps was forgotten


def test_arms_of_the_papers_regime_continue_a_stored_baseline(kept, tmp_path):
    folder = shutil.copytree(kept, tmp_path / "run")
    names = {"labels by the script": paper_regime.ARMS["labels by the script"]}
    with jax.numpy_dtype_promotion("standard"):
        found = paper_regime.train_arms(folder, names)
    scores = found["labels by the script"]
    assert scores["test"]["psnr"] > 10 and len(scores["test_far"]["views"]) == 1
    steps = folder / "arms" / "labels_by_the_script" / "diverse_0" / "2"
    assert steps.is_dir()
    shutil.rmtree(folder / "checkpoints")  # nothing is trained again
    assert paper_regime.train_arms(folder, names) == found


def test_the_papers_nerf_is_trained_piece_by_piece(capture_folder, tmp_path, capsys):
    names, field = (
        {"method": "nerf", "preset": "tiny"},
        dataclasses.replace(TINY.field, target_steps=2),
    )
    preset = dataclasses.replace(TINY, field=field, labels=LabelConfig(), targets=None)

    def piece(seconds):
        with jax.numpy_dtype_promotion("standard"):
            programs = programs_of(preset, capture_folder)
            return paper_nerf.do_piece(tmp_path, programs, names, seed=0, seconds=seconds)

    assert piece(0) == "baseline 3/30"
    assert piece(1e9) is None and "baseline 3/30  resumed" in capsys.readouterr().out
    stages = json.loads((tmp_path / "scores.json").read_text())["stages"]
    assert set(stages) == {"baseline", "control", "closeup", "test_time_control", "test_time"}
    assert [path.name for path in tmp_path.glob("checkpoints/*/")] == ["baseline"]
    paper_nerf.print_scores(stages)
    assert f"| test_time | {stages['test_time']['test']['psnr']:.2f} |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("lr_scale", "targets", "control", "test_time_control"),
    [(1.0, None, None, 1.0), (3.0, None, 3.0, 3.0), (3.0, 5.0, 3.0, 5.0)],
)
def test_controls_of_the_papers_nerf_learn_as_fast_as_those_of_a_run(
    monkeypatch, lr_scale, targets, control, test_time_control
):
    labels = LabelConfig(lr_scale=lr_scale)
    targets = targets and TargetConfig("warp", lr_scale=7.0, control_lr_scale=targets)
    preset = dataclasses.replace(TINY, labels=labels, targets=targets)
    scene = SimpleNamespace(test=SimpleNamespace(cameras=None))
    programs = SimpleNamespace(preset=preset, photographs=None, scene=scene)
    prepared = SimpleNamespace(data=None, steps=2)
    monkeypatch.setattr(paper_nerf, "prepare_target_views", lambda *_: prepared)
    start = SimpleNamespace(sources=None)
    found = {name: data for name, data, _ in paper_nerf._fine_tunings(programs, start)}
    assert found["control"].lr_scale == control
    assert found["test_time_control"].lr_scale == test_time_control


def test_exports_are_not_compared_where_photographs_are_masked():
    export_formats = pytest.importorskip("experiments.studies.export_formats", exc_type=ImportError)
    truth = np.full((4, 6, 3), 0.5, np.float32)
    image, weight = truth + np.float32(0.1), np.ones((4, 6), np.float32)
    image[:, :3], weight[:, :3] = 1, 0
    assert export_formats._psnr([image], [truth], [weight]) == pytest.approx(20, abs=1e-3)


def test_a_piece_ends_before_a_part_that_would_not_fit():
    times = iter([0.0, 10.0, 50.0, 140.0])
    clock = paper_nerf.Clock(180.0, lambda: next(times))
    clock.restart()
    assert not clock.is_over()  # a part took 40 s, and 130 are left
    assert clock.is_over()  # a part took 90 s, and 40 are left


def test_views_that_detail_harms_are_counted(tmp_path, capsys):
    folder = tmp_path / "some" / "run"
    folder.mkdir(parents=True)
    stages = {
        stage: {
            split: {"views": {name: {"cc_psnr": value} for name, value in views.items()}}
            for split, views in (("test", close), ("test_far", far))
        }
        for stage, close, far in (
            ("baseline", {"a": 20.0, "b": 21.0}, {"c": 30.0, "d": 30.0}),
            ("detail", {"a": 20.5, "b": 20.75}, {"c": 29.95, "d": 31.0}),
        )
    }
    (folder / "results.json").write_text(json.dumps({"stages": stages}))
    detail_teachers.print_harm([folder])
    out = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in out.splitlines()]
    assert ["some/run", "test", "2", "+0.12", "-0.25", "b -0.25"] in rows
    assert ["some/run", "test_far", "2", "+0.47", "-0.05", ""] in rows
    assert "1 of 4 views lose more than 0.1 dB: 25.0%" in out


def test_training_poses_alone_are_turned_by_half_a_pixel():
    count, focal = 300, 800.0
    frames = [
        {"file_path": f"{i}.png", "fl_x": focal, "transform_matrix": np.eye(4).tolist()}
        for i in range(2 * count)
    ]
    training = [frame["file_path"] for frame in frames[:count]]
    listed = {"frames": frames, "train_filenames": training}
    turned = detail_teachers.turn_training_poses(listed, np.random.default_rng(1))["frames"]
    poses = np.array([frame["transform_matrix"] for frame in turned])
    assert (poses[count:] == np.eye(4)).all()
    ahead = poses[:count, :3, 2]  # where the axis of view goes
    moved = focal * ahead[:, :2] / ahead[:, 2:]  # pixels by which the middle of the image moves
    np.testing.assert_allclose(moved.std(axis=0), detail_teachers.NOISE, rtol=0.1)
    np.testing.assert_allclose(np.linalg.det(poses[:count, :3, :3]), 1)
