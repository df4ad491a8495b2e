"""Programs from the command line: help, flags and settings, and one sentence for each mistake."""

import importlib
import os
import pathlib
import re
import subprocess
import sys

import jax
import numpy as np
import pytest
from absl import flags
from absl.testing import flagsaver
from tiny_capture import paper_capture, write_image
from tiny_runs import TINY

from jaxcloseup.app.cli import doctor, sweep, topics
from jaxcloseup.app.cli import flags as shared
from jaxcloseup.app.cli import main as command
from jaxcloseup.app.cli import run as program
from jaxcloseup.app.cli.output_folder import (
    LOCK,
    check_unused,
    check_writable,
    choose_output_dir,
    lock_output_dir,
)
from jaxcloseup.app.cli.start import in_one_sentence
from jaxcloseup.app.run.scene_input import load
from jaxcloseup.photos.scene import SceneError


ROOT = pathlib.Path(__file__).parents[2]


def call(*words, folder=ROOT):
    """Run Python in a folder from which the package is found."""
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_command_knows_all_programs(monkeypatch, capsys):
    files = pathlib.Path(command.__file__).parent.glob("*.py")
    found = {path.stem for path in files if re.search(r"\ndef main\(\w+: list", path.read_text())}
    assert set(command.PROGRAMS) == found
    assert all((ROOT / "experiments" / f"{name}.py").is_file() for name in found - {"export"})
    for words in ([], ["--help"]):
        monkeypatch.setattr("sys.argv", ["jaxcloseup", *words])
        command.main()
        said = capsys.readouterr().out
        assert all(f"  {name} " in said for name in found)
    monkeypatch.setattr("sys.argv", ["jaxcloseup", "train"])
    with pytest.raises(SystemExit, match="jaxcloseup: train is not a program: choose closeup, run"):
        command.main()


def test_the_doctor_says_what_is_missing_and_what_to_do(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["jaxcloseup", "doctor"])
    command.main()
    said = capsys.readouterr().out
    assert re.search(rf"^jax +{re.escape(jax.__version__)}$", said, re.MULTILINE)
    monkeypatch.setattr(doctor.library, "missing", lambda: "the native library was not built")
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    monkeypatch.setitem(doctor.EXTRAS, "viewer", ("no-such-package", "the viewer"))
    said = doctor.describe()
    assert "not built; surfels on CPUs take several times as long: install g++, then" in said
    assert re.search(r'extra "viewer" +not installed; it would add: the viewer', said)


@pytest.mark.parametrize("name", command.PROGRAMS)
def test_help_does_not_wait_for_jax(name, tmp_path):
    """Importing JAX and what needs it takes seconds; absl and the flags take a twentieth of one."""
    done = call("-X", "importtime", "-m", "jaxcloseup", name, "-h", folder=tmp_path)
    assert done.returncode == 0
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "absl.flags" in imported and not imported & {"jax", "numpy", "cv2", "matplotlib"}
    doc = importlib.import_module(f"jaxcloseup.app.cli.{name}").__doc__
    assert done.stdout.startswith(doc.splitlines()[0])
    topic = {"run": "The capture:", "render": "Cameras:", "view": "The run:"}
    assert topic.get(name, "--") in done.stdout
    if name != "export":
        same = call("-m", f"experiments.{name}", "--help")
        assert same.stdout == done.stdout


def test_a_new_flag_is_one_line(tmp_path):
    """A program's file defines a flag, under a topic or none; its help and its errors know it."""
    source = (ROOT / "jaxcloseup" / "app" / "cli" / "mesh.py").read_text()
    line = 'flags.DEFINE_integer("trial", 3, "a trial flag", lower_bound=2)\n\n\ndef main('
    (tmp_path / "trial.py").write_text(source.replace("def main(", line))
    code = "import trial; from jaxcloseup.app.cli.start import start; start(trial)"
    done = call("-c", code, "--help", folder=tmp_path)
    assert "\n  --trial=3               a trial flag\n" in done.stdout
    done = call("-c", code, "--trial=1", folder=tmp_path)
    assert done.stderr == "jaxcloseup trial: --trial=1 must be a whole number of at least 2\n"


def test_usage_ends_quietly_where_nobody_reads():
    read, write = os.pipe()
    os.close(read)
    usage = [sys.executable, "-m", "jaxcloseup", "--help"]
    ended = subprocess.run(usage, stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert (ended.returncode, ended.stderr) == (0, b"")


def test_help_shows_each_shared_flag_under_one_topic():
    keys = flags.FLAGS.key_flags_by_module_dict()
    for module in (program, sweep):
        shown = keys[module.__name__]
        assert set(shared.TRAINING) <= {flag.name for flag in shown}
        listed = [flag.name for group in topics.flags_by_topic(shown).values() for flag in group]
        assert sorted(listed) == sorted(flag.name for flag in shown)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("run --seed=-1", "--seed=-1 must be a whole number between 0 and 4294967295"),
        ("run --zoom=1", "--zoom=1 must be a whole number of at least 2"),
        ("run --resume=si", "--resume=si must be true or false"),
        (
            "run --split=all",
            "--split=all must be one of given, listed, every8, closest, macro, zoom",
        ),
        ("run --stages=polish", "--stages takes names of baseline, control, closeup, "),
        ("run --method=magic", "--method=magic must be one of surfels, "),
        ("run --minutes=inf", "--minutes=inf must be a number of at least 0.1"),
        ("closeup x --near=nan", "--near=nan must be a number between 1 and 1000"),
        ("run table", "table is not a flag: flags begin with --"),
        ("check x --fix", "--fix is for training: give it to "),
        ("run --scene", "--scene needs a value"),
        ("render --fps=fast", "--fps=fast must be a number"),
        ("render --pixels=1,2", "--pixels is not a flag: perhaps --pixel is meant; --help lists"),
        ("evaluate --render=a", "--render is not a flag: perhaps --renders is meant; --help lists"),
    ],
)
def test_wrong_words_are_one_sentence(words, message):
    name, *rest = words.split()
    done = call("-m", "jaxcloseup", name, *rest)
    assert done.returncode == 1 and done.stdout == "" and done.stderr.count("\n") == 1
    assert done.stderr.startswith(f"jaxcloseup {name}: {message}")


def test_what_the_system_refuses_is_one_sentence(tmp_path):
    said = r"/none cannot be read or written \(No such file or directory\): name another place"
    with pytest.raises(SystemExit, match=said), in_one_sentence("run", OSError):
        (tmp_path / "none").read_bytes()


def test_a_place_that_is_read_only_is_refused_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)
    for make in (check_unused, check_writable):
        with pytest.raises(PermissionError, match=f"--output_dir={tmp_path}/a/b cannot be written"):
            make(tmp_path / "a" / "b")
    (tmp_path / "a").mkdir()
    assert check_unused(tmp_path / "a" / "b") == tmp_path / "a" / "b"


def test_sentences_repeat_how_the_program_was_started(tmp_path):
    done = call("-m", "experiments.run", "--zoom=1")
    assert done.stderr.startswith("experiments.run: --zoom=1 must be")
    command = "from jaxcloseup.app.cli.invocation import program_command; print(*"
    command += "program_command('run'))"
    script = tmp_path / "jaxcloseup"
    script.write_text(command)
    assert call(script, "run").stdout == "jaxcloseup run\n"
    for module in ("jaxcloseup", "experiments.run"):
        code = f"import sys; sys.orig_argv = ['python', '-m', '{module}', 'run']; {command}"
        words = "jaxcloseup run" if module == "jaxcloseup" else module
        assert call("-c", code).stdout == f"python -m {words}\n"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"output_dir": "here", "resume": True}, "--resume finds nothing to resume in"),
        ({"scene": "tabel"}, r"tabel is neither a folder nor a built-in"),
        ({"scene": "capture", "format": "llff"}, "holds no capture in the format llff"),
        ({"output_dir": "full"}, "already exists and is not empty"),
        (
            {"scene": "capture", "downscale": 1, "output_dir": "full/file/out"},
            "--output_dir=full/file/out cannot be created .*: name a folder",
        ),
        ({"preset": "released"}, "--preset=released is not for --method=surfels"),
    ],
)
def test_a_mistake_is_one_sentence_before_any_work(
    parsed_flags, capture_folder, tmp_path, monkeypatch, given, message
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("kept")
    if given.get("scene") == "capture":
        given = given | {"scene": str(capture_folder)}
    before = set(tmp_path.rglob("*"))
    with (
        flagsaver.flagsaver(**{"output_dir": "out", **given}),
        pytest.raises(SystemExit, match=f"^jaxcloseup run: .*{message}") as error,
    ):
        program.main(["run"])
    assert "\n" not in error.value.code and set(tmp_path.rglob("*")) == before


def test_format_and_split_reach_the_capture(parsed_flags, capture_folder, capsys):
    with flagsaver.flagsaver(format="transforms", split="every8"):
        scene = load(str(capture_folder), shared.load_options_from_flags(TINY))
        names = shared.names_from_flags()
    assert (names["format"], names["split"]) == ("transforms", "every8")
    assert scene.metadata["split"] == "every8" and scene.test is None
    printed = capsys.readouterr().out
    assert "reading transforms_train.json" in printed and "every 8th of its" in printed
    assert set(shared.names_from_flags()) == {"method", "preset"}
    with flagsaver.flagsaver(split="zoom", zoom=2):
        scene = load(str(capture_folder), shared.load_options_from_flags(TINY))
        assert scene.metadata["times_nearer"][0] == 2
        assert shared.names_from_flags()["zoom"] == 2
    with flagsaver.flagsaver(photographs=2, choose="spread"):
        chosen = {"photographs": 2, "choose": "spread"}
        assert shared.load_options_from_flags(TINY).items() >= chosen.items()
        assert shared.names_from_flags().items() >= chosen.items()
    with (
        flagsaver.flagsaver(invert_masks=True, alpha_mode="mask"),
        pytest.raises(ValueError, match="no photograph has a mask to invert"),
    ):
        load(str(capture_folder), shared.load_options_from_flags(TINY))


def test_photographs_too_small_for_their_scores_are_refused(tmp_path):
    """The capture has 8 x 6 pixels, and the built-in scene 10 x 6."""
    with pytest.raises(SceneError, match=r"8 x 6 pixels, but SSIM needs 11 .* --downscale"):
        load(str(paper_capture(tmp_path)), {})
    noise = np.random.default_rng(0).integers(0, 255, (40, 40, 3), np.uint8)
    write_image(tmp_path / "test/a.png", noise[:11, :10])
    for name in ("a", "b"):
        write_image(tmp_path / f"train/{name}.png", noise)
    with pytest.raises(SceneError, match="10 x 11 pixels"):
        load(str(tmp_path), {})
    write_image(tmp_path / "test/a.png", noise[:11, :11])
    assert load(str(tmp_path), {}).name == tmp_path.name


@pytest.mark.parametrize("scene", [".", "..", "../here/", "../here", "inside/..", "table"])
def test_results_stay_in_their_folder(tmp_path, monkeypatch, scene):
    (tmp_path / "here" / "inside").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    folder = choose_output_dir(None, scene, "nerf")
    name = {"..": tmp_path.name, "table": "table"}.get(scene, "here")
    assert folder.parent == pathlib.Path("outputs", name, "nerf")


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
        f"jaxcloseup {name}: --output_dir={tmp_path} is in use by the process {os.getpid()}: wait "
        "until it ends, or name another folder"
    )
    assert not list((tmp_path / "checkpoints").iterdir())


def test_a_dead_process_leaves_no_lock(tmp_path):
    code = (
        "import os, pathlib, sys\n"
        "from jaxcloseup.app.cli.output_folder import lock_output_dir\n"
        "lock = lock_output_dir(pathlib.Path(sys.argv[1]))\n"
        "os._exit(0)"
    )
    assert call("-c", code, tmp_path).returncode == 0
    assert check_unused(tmp_path) == tmp_path  # although the file of the lock is there
    with lock_output_dir(tmp_path):
        assert (tmp_path / LOCK).read_text() == str(os.getpid())
