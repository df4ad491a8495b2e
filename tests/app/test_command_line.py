"""Flags of `experiments.run`: what they set, and one sentence for each that makes no sense."""

import importlib
import json
import os
import pathlib
import re
import subprocess
import sys

import numpy as np
import pytest
from absl import flags
from absl.testing import flagsaver
from tiny_capture import paper_capture, write_image
from tiny_runs import TINY

from jaxcloseup.app.cli import chosen as training_flags
from jaxcloseup.app.cli import main as command
from jaxcloseup.app.cli import run as program
from jaxcloseup.app.cli import sweep
from jaxcloseup.app.cli import training_flags as define_flags
from jaxcloseup.app.cli.start import LOCK, check_unused, lock_output_dir
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import plain_config, settings_of
from jaxcloseup.app.run import stage_names as names
from jaxcloseup.app.sweep.arms import KINDS
from jaxcloseup.fields.splats.config import AdaptiveConfig
from jaxcloseup.photos.scene import SceneError


ROOT = pathlib.Path(__file__).parents[2]


@pytest.fixture
def parsed_flags():
    flags.FLAGS(["run"])
    with flagsaver.flagsaver(compilation_cache=""):
        yield


def test_help_lists_the_flags_that_programs_share():
    keys = flags.FLAGS.key_flags_by_module_dict()
    defined = flags.FLAGS.flags_by_module_dict()[define_flags.__name__]
    shared = {flag.name for flag in defined} | {"output_dir"}
    for module in (program, sweep):
        assert shared <= {flag.name for flag in keys[module.__name__]}
    assert "preset" in shared


def test_the_command_knows_all_programs(monkeypatch, capsys):
    found = {path.stem for path in (ROOT / "experiments").glob("[a-z]*.py")} - {"bench"}
    assert set(command.PROGRAMS) == found
    for words in ([], ["--help"]):
        monkeypatch.setattr("sys.argv", ["jaxcloseup", *words])
        command.main()
        said = capsys.readouterr().out
        assert all(f"  {name} " in said for name in found)
    monkeypatch.setattr("sys.argv", ["jaxcloseup", "train"])
    with pytest.raises(SystemExit, match="jaxcloseup: train is not a program: choose run, sweep"):
        command.main()


def test_the_command_runs_a_program_from_any_folder(tmp_path):

    def call(*words):
        return subprocess.run(
            [sys.executable, "-m", "jaxcloseup", "evaluate", *words],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )

    done = call("-h")
    assert done.returncode == 0
    assert "Score a folder of rendered images" in done.stdout and "--renders" in done.stdout
    done = call("--render=a")
    assert done.returncode == 1
    assert done.stderr == (
        "experiments.evaluate: --render is not a flag: perhaps --renders is meant; --help lists "
        "all flags\n"
    )


def test_nothing_to_resume_is_one_sentence(parsed_flags, tmp_path):
    with (
        flagsaver.flagsaver(scene="table", output_dir=str(tmp_path), resume=True),
        pytest.raises(SystemExit, match="--resume finds no run in --output_dir="),
    ):
        program.main(["run"])


def test_an_unknown_scene_is_one_sentence(parsed_flags, tmp_path):
    with (
        flagsaver.flagsaver(scene="tabel", output_dir=str(tmp_path / "out")),
        pytest.raises(SystemExit, match="tabel"),
    ):
        program.main(["run"])
    assert not (tmp_path / "out").exists()


def test_format_and_split_reach_the_capture(parsed_flags, capture_folder, capsys):
    with flagsaver.flagsaver(format="transforms", split="every8"):
        options = training_flags.load_options_from_flags(TINY)
        scene = training_flags.load(str(capture_folder), options)
        names = training_flags.names_from_flags()
    assert (names["format"], names["split"]) == ("transforms", "every8")
    assert scene.metadata["split"] == "every8" and scene.test is None
    printed = capsys.readouterr().out
    assert "reading transforms_train.json" in printed and "every 8th of its" in printed
    assert set(training_flags.names_from_flags()) == {"method", "preset"}
    with flagsaver.flagsaver(split="zoom", zoom=2):
        options = training_flags.load_options_from_flags(TINY)
        assert training_flags.load(str(capture_folder), options).metadata["times_nearer"][0] == 2
        assert training_flags.names_from_flags()["zoom"] == 2
    with (
        flagsaver.flagsaver(invert_masks=True, alpha_mode="mask"),
        pytest.raises(ValueError, match="no photograph has a mask to invert"),
    ):
        training_flags.load(str(capture_folder), training_flags.load_options_from_flags(TINY))


def test_photographs_too_small_for_their_scores_are_refused(parsed_flags, tmp_path):
    """The capture has 8 x 6 pixels, and the built-in scene 10 x 6."""
    with pytest.raises(SceneError, match=r"8 x 6 pixels, but SSIM needs 11 .* --downscale"):
        training_flags.load(str(paper_capture(tmp_path)), {})
    write_image(tmp_path / "test/a.png", np.zeros((11, 10, 3), np.uint8))
    for name in ("a", "b"):
        write_image(tmp_path / f"train/{name}.png", np.zeros((40, 40, 3), np.uint8))
    with pytest.raises(SceneError, match="10 x 11 pixels"):
        training_flags.load(str(tmp_path), {})
    write_image(tmp_path / "test/a.png", np.zeros((11, 11, 3), np.uint8))
    assert training_flags.load(str(tmp_path), {}).name == tmp_path.name


@pytest.mark.parametrize("scene", [".", "..", "../here/", "../here", "inside/.."])
def test_results_stay_in_their_folder(tmp_path, monkeypatch, scene):
    (tmp_path / "here" / "inside").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    folder = training_flags.choose_output_dir(None, scene, "nerf")
    name = (tmp_path if scene == ".." else tmp_path / "here").name
    assert folder.parent == pathlib.Path("outputs", name, "nerf")
    folder = training_flags.choose_output_dir(None, "table", "nerf")
    assert folder.parent == pathlib.Path("outputs", "table", "nerf")


def test_a_format_that_is_not_there_is_one_sentence(parsed_flags, capture_folder, tmp_path):
    given = {"scene": str(capture_folder), "output_dir": str(tmp_path / "out"), "format": "llff"}
    with (
        flagsaver.flagsaver(**given),
        pytest.raises(SystemExit, match="holds no capture in the format llff"),
    ):
        program.main(["run"])
    assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_is_refused_before_any_work(parsed_flags, tmp_path):
    (tmp_path / "results.json").write_text("{}")
    with (
        flagsaver.flagsaver(scene="table", output_dir=str(tmp_path)),
        pytest.raises(SystemExit, match="already exists and is not empty"),
    ):
        program.main(["run"])
    assert (tmp_path / "results.json").read_text() == "{}"


def test_a_folder_that_cannot_be_made_is_one_sentence(parsed_flags, capture_folder, tmp_path):
    (tmp_path / "file").write_text("")
    folder = tmp_path / "file" / "out"
    with (
        flagsaver.flagsaver(scene=str(capture_folder), downscale=1, output_dir=str(folder)),
        pytest.raises(
            SystemExit, match=f"--output_dir={folder} cannot be created .*: name a folder"
        ),
    ):
        program.main(["run"])


@pytest.mark.parametrize("module", [program, sweep])
def test_a_folder_that_another_process_trains_in_is_refused(
    parsed_flags, capture_folder, tmp_path, module
):
    (tmp_path / "checkpoints").mkdir()
    scene = {"scene": str(capture_folder), "scenes": [str(capture_folder)], "downscale": 1}
    with (
        lock_output_dir(tmp_path),
        flagsaver.flagsaver(**scene, output_dir=str(tmp_path), resume=True, arms=["control"]),
        pytest.raises(SystemExit) as error,
    ):
        module.main(["run"])
    name = module.__name__.rpartition(".")[2]
    assert error.value.code == (
        f"experiments.{name}: --output_dir={tmp_path} is in use by the process {os.getpid()}: wait "
        "until it ends, or name another folder"
    )
    assert not list((tmp_path / "checkpoints").iterdir())


def test_a_dead_process_leaves_no_lock(tmp_path):
    code = (
        "import os, pathlib, sys\n"
        "from jaxcloseup.app.cli.start import lock_output_dir\n"
        "lock = lock_output_dir(pathlib.Path(sys.argv[1]))\n"
        "os._exit(0)"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path], check=True, cwd=ROOT)
    assert check_unused(tmp_path) == tmp_path  # although the file of the lock is there
    with lock_output_dir(tmp_path):
        assert (tmp_path / LOCK).read_text() == str(os.getpid())


def test_flags_override_the_preset(parsed_flags):
    settings = ["closeup_steps=7", "compute_dtype=bfloat16", "rgb_tolerance=0.1", "chunk=none"]
    with flagsaver.flagsaver(method="nerf", preset="paper", set=settings, downscale=3):
        preset = training_flags.preset_from_flags()
    assert preset.closeup_steps == 7 and preset.downscale == 3
    assert preset.field.compute_dtype == "bfloat16" and preset.labels.rgb_tolerance == 0.1
    before = METHODS["nerf"].presets["paper"]
    assert preset.baseline_steps == before.baseline_steps == 200_000
    assert before.labels.rgb_tolerance == 0.05
    assert plain_config(preset)["labels"]["depth_tolerance"] == "inf"
    json.dumps(plain_config(preset), allow_nan=False)


def test_an_unknown_stage_is_refused(parsed_flags):
    with pytest.raises(flags.IllegalFlagValueError, match="--stages takes names of baseline"):
        flags.FLAGS.stages = ["baseline", "polish"]


def test_a_preset_of_the_other_method_is_one_sentence(parsed_flags, tmp_path):
    with (
        flagsaver.flagsaver(method="surfels", preset="released", output_dir=str(tmp_path / "out")),
        pytest.raises(SystemExit, match="--preset=released is not for --method=surfels"),
    ):
        program.main(["run"])
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("method", "text", "message"),
    [
        (
            "ngp",
            "compute_dtype=bfloat16",
            "has no setting compute_dtype: .*--set=help lists",
        ),
        ("ngp", "grid.levels=0", "grid.levels must be between 1 and 64"),
        ("nerf", "depth_share=2", "depth_share must be between 0 and 1"),
        ("nerf", "capacity=500", "method nerf has no setting capacity: --set=help lists all"),
        ("surfels", "compute_dtype=bfloat16", "method surfels has no setting compute_dtype"),
        ("surfels", "num_rays=4", "method surfels has no setting num_rays"),
        ("surfels", "num_windows=0", "num_windows must be between 1 and 2147483647"),
        ("surfels", "capacity", "must be name=value"),
        ("surfels", "capacity=many", "capacity must be a whole number between 1 and 100000000"),
        ("surfels", "capacity=0", "capacity must be between 1 and 100000000"),
        ("surfels", "sh_degree=4", "sh_degree must be between 0 and 3"),
        ("surfels", "density.every=0", "density.every must be between 1 and 2147483647"),
        ("surfels", "depth=deep", "depth must be median or expected"),
        ("surfels", "means_lr=0.1", "means_lr must be two numbers between 0 and inf"),
        ("surfels", "color_ridge=much", "color_ridge must be a number between 0 and inf or none"),
        ("surfels", "gated=perhaps", "gated must be true or false"),
        (
            "surfels",
            "density=adaptive",
            "setting density: perhaps .*density.growth or .* is meant",
        ),
    ],
)
def test_a_setting_that_makes_no_sense_is_one_sentence(
    parsed_flags, tmp_path, method, text, message
):
    out = tmp_path / "out"
    with (
        flagsaver.flagsaver(method=method, output_dir=str(out), set=[text]),
        pytest.raises(SystemExit, match=f"--set={text}.*{message}") as error,
    ):
        program.main(["run"])
    assert "\n" not in error.value.code and not out.exists()


def test_settings_of_nested_records_have_their_path(parsed_flags):
    settings = ["density.growth=1.2", "raster.tile=16", "capacity=300", "means_lr=0.1:0.01"]
    with flagsaver.flagsaver(method="surfels", set=settings):
        field = training_flags.preset_from_flags().field
    assert (field.density.growth, field.raster.tile, field.capacity) == (1.2, 16, 300)
    assert field.means_lr == (0.1, 0.01)


@pytest.mark.parametrize("method", METHODS)
def test_any_method_takes_several_windows_a_step(parsed_flags, method):
    with flagsaver.flagsaver(method=method, windows=3):
        assert training_flags.preset_from_flags().train.num_windows == 3


def test_every_setting_is_listed_with_values_that_it_may_have(parsed_flags, capsys):
    for name, method in METHODS.items():
        given = flagsaver.flagsaver(method=name, preset="paper", set=["help"])
        with given, pytest.raises(SystemExit) as end:
            program.main(["run"])
        assert end.value.code == 0
        said = capsys.readouterr().out
        shown = re.findall(r"^  (\S+)=", said, re.M)
        known = settings_of(method.presets["paper"])
        assert shown == list(known)
        words = " ".join(said.split())
        for setting in known.values():
            assert f"{setting.limits.help}; {setting.wanted}" in words
        assert "use_mask=true keep labels only where both warps agree in color; true or f" in words


def test_flags_know_all_names():
    """Modules that define flags import no JAX, so they repeat the names of what imports it."""
    assert names.ARMS == KINDS


@pytest.mark.parametrize("name", command.PROGRAMS)
def test_help_does_not_wait_for_jax(name):
    """Importing JAX and what needs it takes seconds; absl and the flags take a twentieth of one."""
    for words in ([name, "-h"], [name, "--help"]):
        done = subprocess.run(
            [sys.executable, "-X", "importtime", "-m", "jaxcloseup", *words],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0
        imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
        assert "absl.flags" in imported and not imported & {"jax", "numpy", "cv2", "matplotlib"}
        doc = importlib.import_module(f"jaxcloseup.app.cli.{name}").__doc__
        assert done.stdout.startswith(doc.splitlines()[0])
        shared = {"run": "The capture:", "render": "Cameras:", "view": "Computers:"}
        assert shared.get(name, "--") in done.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["run", "--seed=-1"],
            "--seed=-1 must be a whole number between 0 and 9223372036854775807",
        ),
        (["run", "--zoom=1"], "--zoom=1 must be a whole number of at least 2"),
        (["run", "--resume=si"], "--resume=si must be true or false"),
        (["run", "--split=all"], "--split=all must be one of given, every8, closest, zoom"),
        (["run", "--stages=polish"], "--stages takes names of baseline, control, closeup, "),
        (["run", "table"], "table is not a flag: flags begin with --"),
        (["run", "--scene"], "--scene needs a value"),
        (["render", "--fps=fast"], "--fps=fast must be a number"),
        (["render", "--pixels=1,2"], "--pixels is not a flag: perhaps --pixel is meant; --help"),
    ],
)
def test_wrong_words_are_one_sentence(words, message):
    done = subprocess.run(
        [sys.executable, "-m", "jaxcloseup", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1 and done.stdout == "" and done.stderr.count("\n") == 1
    assert done.stderr.startswith(f"experiments.{words[0]}: {message}")


def test_help_has_a_line_for_each_method_with_its_paper():
    for method in METHODS.values():
        assert re.fullmatch(r".+ \(.+ et al\. 20\d\d\)", method.help)


def test_an_unknown_method_is_one_sentence(parsed_flags):
    with pytest.raises(flags.IllegalFlagValueError, match="should be one of <surfels"):
        flags.FLAGS["method"].parse("nothing")


def test_surfels_can_be_cloned_and_split(parsed_flags):
    with flagsaver.flagsaver(method="surfels", preset="quick_adaptive", set=["capacity=300"]):
        field = training_flags.preset_from_flags().field
    assert isinstance(field.density, AdaptiveConfig)
    assert field.capacity == 300 and field.opacity_weight == 0
