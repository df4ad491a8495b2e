"""Ctrl-C ends a program at once with one sentence, and a run resumes by the command in it."""

import os
import pathlib
import shlex
import signal
import subprocess
import sys
import time

import pytest
from conftest import QUICKLY

from jaxcloseup.app.cli.main import PROGRAMS


ROOT = pathlib.Path(__file__).parents[2]
SECONDS = 10  # much less than a compilation or a chunk of steps, on a busy computer


@pytest.fixture
def start():
    """Start Python; what is still running at the end of the test is killed."""
    started = []

    def call(*arguments, before=signal.default_int_handler):
        # A test session that a shell started in the background ignores Ctrl-C.
        ours = signal.signal(signal.SIGINT, before)
        process = subprocess.Popen(
            [sys.executable, *arguments],
            cwd=ROOT,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "XLA_FLAGS": QUICKLY},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        signal.signal(signal.SIGINT, ours)
        started.append(process)
        return process

    yield call
    for process in started:
        process.kill()
        process.communicate()


def stop(process):
    """Press Ctrl-C; returns what is left of the outputs."""
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=SECONDS)
    assert process.returncode == 130, err
    assert "Traceback" not in err and "Traceback" not in out
    return out, err


def wait_for(lines, ending):
    seen = []
    for line in lines:
        seen.append(line)
        if line.rstrip().endswith(ending):
            return
        assert len(seen) < 10_000, seen[-10:]
    raise AssertionError("".join(seen))


@pytest.mark.parametrize(
    ("program", "imported"),
    [*((program, " experiments") for program in PROGRAMS if program != "export"), ("run", " jax")],
)
def test_imports_are_interrupted(start, program, imported):
    process = start("-X", "importtime", "-m", f"experiments.{program}")
    wait_for(process.stderr, imported)
    _, err = stop(process)
    assert f"experiments.{program}: stopped\n" in err


def test_the_command_is_interrupted(start):
    begin = (
        "import sys; sys.argv = ['jaxcloseup', 'run']; import jaxcloseup.app.cli.main as command"
    )
    process = start("-X", "importtime", "-c", f"{begin}; command.main()")
    wait_for(process.stderr, " jax")
    _, err = stop(process)
    assert "jaxcloseup run: stopped\n" in err


def test_a_run_is_interrupted_and_resumes(start, capture_folder, tmp_path):
    """First between two checkpoints, then while it compiles."""
    out = tmp_path / "a run"
    flags = ["--method=nerf", f"--scene={capture_folder}", "--downscale=1", f"--output_dir={out}"]
    settings = ["depth=1", "width=8", "num_coarse=4", "num_fine=4", "num_rays=8"]
    settings += ["direction_width=8", "baseline_steps=1000000"]
    command = [*flags, "--save_every=1", "--compilation_cache=", *(f"--set={s}" for s in settings)]
    process = start("-m", "experiments.run", *command)
    while not list(out.glob("checkpoints/baseline/*[0-9]")):  # unfinished ones have an ending
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    _, err = stop(process)
    (sentence,) = err.splitlines()
    said, _, resume = sentence.partition("resume it with python ")
    assert said == "experiments.run: stopped: "
    assert shlex.split(resume) == ["-m", "experiments.run", *command, "--resume"]
    assert not list(out.rglob(".*.part"))

    refused = start("-m", "experiments.run", *command)
    _, err = refused.communicate()
    assert refused.returncode == 1 and "resume its training with --resume, or name" in err

    process = start(*shlex.split(resume))
    wait_for(process.stdout, "resumed")
    stop(process)


def test_a_file_that_is_being_written_is_not_said_to_fail(start, tmp_path):
    """Its unfinished file is removed while the main thread would write on."""
    begin = "import pathlib, sys, time; from jaxcloseup.app.cli.interrupt import *; "
    begin += "from jaxcloseup.io.files import writing; folder = pathlib.Path(sys.argv[1]); "
    begin += "from jaxcloseup.app.cli.output_folder import remove_unfinished; "
    begin += "when_stopped(lambda: remove_unfinished(folder) or time.sleep(1) or 'ended'); "
    begin += "end_at_ctrl_c('it')\n"
    write = "with writing(folder / 'a'): print('begun'); time.sleep(0.5)"
    process = start("-c", f"{begin}{write}", str(tmp_path))
    wait_for(process.stdout, "begun")
    _, err = stop(process)
    assert err == "it: ended\n"
    assert not list(tmp_path.iterdir())


def test_a_program_in_the_background_ignores_it(start):
    """A shell asks that of it by ignoring the signal before it starts it."""
    process = start(
        "-X", "importtime", "-m", "experiments.bench", "--suite=none", before=signal.SIG_IGN
    )
    wait_for(process.stderr, " experiments")
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode != 130
