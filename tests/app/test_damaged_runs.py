"""Files of a run that somebody edited, or that a disk damaged: one sentence names what is wrong."""

import json

import pytest
from absl import flags
from absl.testing import flagsaver
from tiny_runs import KEPT, copy_of
from wrong_input import endless, pipe, terabyte

from jaxcloseup.app.cli import render, run, sweep
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import check_value, plain_config, settings_of, with_settings
from jaxcloseup.app.run import states
from jaxcloseup.app.run.keys import run_keys
from jaxcloseup.app.run.logs import TrainLog
from jaxcloseup.app.run.loop import TrainingError
from jaxcloseup.app.run.manifest import write_manifest
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.store.stored_config import preset_from_config
from jaxcloseup.app.store.stored_run import RunError, read_run
from jaxcloseup.artifacts.checkpoints import CheckpointError, Checkpoints
from jaxcloseup.captures.json_fields import read_object
from jaxcloseup.captures.load import load_scene
from jaxcloseup.photos.scene import SceneError


RUN = "checkpoints/run.json"
NESTED = "[" * 5000 + "]" * 5000


def without(name):
    return lambda fields: {key: value for key, value in fields.items() if key != name}


def with_setting(name, value):
    """The run with a setting of its surfels changed."""

    def change(fields):
        config = fields["config"]
        return fields | {"config": config | {"field": config["field"] | {name: value}}}

    return change


CAPACITY = r"config\.field\.capacity must be"


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("manifest.json", without("load_options"), "manifest.json: load_options must be an object"),
        ("manifest.json", without("data_sha256"), "manifest.json: data_sha256 must be a text"),
        ("manifest.json", lambda a: a | {"scene": 3}, "manifest.json: scene must be a text"),
        ("manifest.json", lambda _: NESTED, "manifest.json cannot be read .it is nested too deep"),
        (RUN, without("resolution"), "run.json: resolution must be a list"),
        (RUN, lambda a: a | {"resolution": [32] * 99}, "resolution must be a width and a height"),
        (RUN, without("seed"), "run.json: seed must be a whole number"),
        (RUN, lambda a: a | {"seed": 2**70}, "run.json: seed must be a whole number"),
        (RUN, lambda a: a | {"config": None}, "run.json: config must be an object"),
        (RUN, lambda _: NESTED, "run.json cannot be read .it is nested too deep"),
        (RUN, lambda _: "[]", "run.json cannot be read .it is not an object"),
        (RUN, with_setting("capacity", 0), f"{CAPACITY} between 1 and 100000000"),
        (RUN, with_setting("capacity", -1), f"{CAPACITY} between 1 and 100000000"),
        (RUN, with_setting("capacity", 10**12), f"{CAPACITY} between 1 and 100000000"),
        (RUN, with_setting("capacity", 10**999), f"{CAPACITY} a whole number between"),
        (RUN, with_setting("capacity", "a"), f"{CAPACITY} a whole number between"),
        (RUN, with_setting("capacity", 1.5), f"{CAPACITY} a whole number between"),
        (RUN, with_setting("capacity", True), f"{CAPACITY} a whole number between"),
        (RUN, with_setting("capacity", {"a": 1}), r"config\.field\.capacity holds fields"),
        (
            RUN,
            with_setting("sh_degree", 10**9),
            r"config\.field\.sh_degree must be between 0 and 3",
        ),
        (RUN, with_setting("depth", ["mean"]), r"config\.field\.depth must be median or expected"),
        (RUN, with_setting("means_lr", [1]), r"config\.field\.means_lr must be two numbers"),
        (RUN, with_setting("raster", None), r"config\.field\.raster must hold fields"),
        (RUN, lambda a: a | {"config": a["config"] | {"field": None}}, r"config\.field must hold"),
        (RUN, lambda a: a | {"config": a["config"] | {"method": [1]}}, "there is no method"),
    ],
)
def test_an_edited_run_is_one_sentence(kept, tmp_path, name, change, message):
    copy_of(kept, tmp_path / "run", name, change)
    with pytest.raises(RunError, match=message) as error:
        read_run(tmp_path / "run")
    assert "\n" not in str(error.value) and str(tmp_path / "run") in str(error.value)


def test_a_coarse_model_is_no_stage_to_render(kept, tmp_path):
    """Its state has other shapes than the preset's."""
    copy_of(kept, tmp_path, None, None)
    checkpoints = tmp_path / "checkpoints"
    (checkpoints / "coarse_baseline" / "20").mkdir(parents=True)
    assert read_run(tmp_path).stages == ["closeup"]
    (checkpoints / "closeup" / "3").rmdir()
    with pytest.raises(RunError, match="has no checkpoint yet: resume its training"):
        read_run(tmp_path)


@pytest.mark.parametrize("make", [pipe, endless, terabyte])
def test_a_file_that_does_not_end_is_not_read(kept, tmp_path, make):
    copy_of(kept, tmp_path, None, None)
    make(RUN)(tmp_path)
    message = r"run\.json cannot be read \((Not an ordinary file|More than 1024 MiB)"
    with pytest.raises(RunError, match=message):
        read_run(tmp_path)
    with pytest.raises(CheckpointError, match=message):
        Checkpoints(tmp_path / "checkpoints", {})
    make("transforms.json")(tmp_path)
    with pytest.raises(SceneError, match=r"transforms\.json cannot be read"):
        read_object(tmp_path / "transforms.json", "frames")


def test_the_program_says_so(kept, tmp_path):
    flags.FLAGS(["render"])
    broken = copy_of(kept, tmp_path / "broken", RUN, with_setting("capacity", 0))
    with (
        flagsaver.flagsaver(compilation_cache="", run=broken, views="test"),
        pytest.raises(SystemExit, match=r"^jaxcloseup render: .*capacity must be"),
    ):
        render.main(["render"])


@pytest.mark.parametrize(
    ("method", "setting"), [("surfels", "capacity=100000000"), ("nerf", "width=2147483647")]
)
def test_what_does_not_fit_into_memory_is_not_begun(capture_folder, monkeypatch, method, setting):
    monkeypatch.setattr(states, "installed_memory", lambda: 2**30)
    preset = with_settings(METHODS[method].presets["quick"], [setting])
    programs = Programs(preset, load_scene(str(capture_folder)))
    with pytest.raises(TrainingError, match=r"takes [\d.]+ GiB, but this computer has 1.0: choose"):
        states.initial_state(programs, run_keys(0))


@pytest.mark.parametrize("text", ["{}", NESTED, "[1]", '{"scenes": 3}'])
def test_a_sweep_with_another_manifest_is_one_sentence(capture_folder, tmp_path, text):
    flags.FLAGS(["sweep"])
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "manifest.json").write_text(text)
    scenes = {"scenes": [str(capture_folder)], "downscale": 1, "arms": ["control"]}
    with (
        flagsaver.flagsaver(compilation_cache="", output_dir=str(tmp_path), resume=True, **scenes),
        pytest.raises(SystemExit, match=r"manifest\.json.*: restore") as error,
    ):
        sweep.main(["sweep"])
    assert "\n" not in error.value.code


@pytest.mark.parametrize("text", ["[]", "{}", NESTED, '{"git_commit": [3]}'])
def test_a_damaged_manifest_is_written_anew(tmp_path, text):
    (tmp_path / "manifest.json").write_text(text)
    write_manifest(tmp_path, {"seed": 0})
    assert json.loads((tmp_path / "manifest.json").read_text())["seed"] == 0


def test_damaged_lines_of_the_log_are_left_out(tmp_path):
    rates = {"steps_per_second": 1.0, "seconds": 2.0}
    good = {"stage": "baseline", "step": 5, "loss": 0.5, **rates}
    bad = [{"stage": [[]]}, {"step": {}}, {"seconds": "a"}, {"steps_per_second": []}]
    lines = [json.dumps(good | change) for change in (*bad, {})]
    file = tmp_path / "stats" / "train.jsonl"
    file.parent.mkdir()
    file.write_text("\n".join([*lines, NESTED]))
    TrainLog(tmp_path).begin("control", [])
    assert list(map(json.loads, file.read_text().splitlines())) == [good]


def test_a_log_that_is_a_pipe_is_one_sentence(tmp_path):
    pipe("stats/train.jsonl")(tmp_path)
    with pytest.raises(
        OSError, match=r"^/.*train\.jsonl cannot be read .* ordinary file\): remove it"
    ):
        TrainLog(tmp_path).begin("control", [])


def test_every_preset_is_within_the_bounds_of_settings():
    for method in METHODS.values():
        for preset in method.presets.values():
            assert preset_from_config(json.loads(json.dumps(plain_config(preset)))) == (preset, {})
            for name, setting in settings_of(preset, method).items():
                kept = check_value(setting.value, setting.kind, setting.limits)
                assert kept == setting.value and setting.limits.help, name


def test_whole_numbers_may_stand_for_others():
    stored = plain_config(KEPT)
    stored["labels"]["lr_scale"] = 1
    preset, _ = preset_from_config(stored)
    assert preset == KEPT and isinstance(preset.labels.lr_scale, float)


def test_settings_that_a_run_found_for_itself_are_read_as_strictly(kept, tmp_path, capture_folder):
    flags.FLAGS(["run"])
    broken = copy_of(kept, tmp_path / "broken", RUN, without("config"))
    given = {"scene": str(capture_folder), "output_dir": str(broken), "check": False}
    with (
        flagsaver.flagsaver(compilation_cache="", resume=True, minutes=1.0, **given),
        pytest.raises(SystemExit, match=r"^jaxcloseup run: .*run\.json: config must be an object"),
    ):
        run.main(["run"])
