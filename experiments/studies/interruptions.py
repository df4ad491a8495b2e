"""Stop `closeup` at random moments until it has ended, and compare its files with an unstopped one.

    python -m experiments.studies.interruptions --photographs=FOLDER

Half of the interruptions are Ctrl-C, half kill the program at once. All trainings take the settings
of the unstopped one, because `--minutes` chooses others whenever it times steps. Files are compared
to the last byte, but for those that say how long something took.
"""

import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from absl import app, flags

from experiments.studies.tables import print_table
from jaxcloseup.io.files import read_object


FLAGS = flags.FLAGS
_SETTINGS = pathlib.Path("run", "checkpoints", "run.json")
_TIMES = ("time", "seconds", "minutes", "compil", "memory")  # in names of what is never the same


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_string("photographs", None, "folder of photographs", required=True)
    flags.DEFINE_integer("interruptions", 20, "how many, over as many ends as they take")
    flags.DEFINE_float("minutes", 0.1, "minutes of training, as of closeup")
    flags.DEFINE_integer("seed", 0, "seed of the moments")
    flags.DEFINE_string("output_dir", "outputs/studies/interruptions", "folder of the closeups")


def main(_: list[str]) -> None:
    """Make the unstopped close-ups, then interrupted ones, and print a table."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell ignores Ctrl-C
    root, rng = pathlib.Path(FLAGS.output_dir), np.random.default_rng(FLAGS.seed)
    root.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    _wait(_start(root / "whole"), None)
    whole, seconds = root / "whole", time.monotonic() - began
    rows: list[list[str]] = []
    for number in range(FLAGS.interruptions):
        if len(rows) < FLAGS.interruptions:
            folder = root / str(number)
            (folder / _SETTINGS.parent).mkdir(parents=True)
            shutil.copy(whole / _SETTINGS, folder / _SETTINGS)
            moments = [*_interrupted(folder, rng, seconds)]
            end = ", ".join(differing(whole, folder)) or "same"
            rows += [[str(number), *moment, end] for moment in moments]
            print(rows[-1:], flush=True)
    print_table("interruptions", ["closeups", "by", "after (s)", "while", "the end"], rows)


def _interrupted(
    folder: pathlib.Path, rng: np.random.Generator, seconds: float
) -> Iterator[list[str]]:
    """Stop close-ups until they end; yield how, when, and the line that was printed last."""
    while True:
        process, until = _start(folder), rng.uniform(0, seconds)
        if _wait(process, until):
            return
        how = signal.SIGINT if rng.random() < 0.5 else signal.SIGKILL
        said = _last_line(folder)
        os.killpg(process.pid, how)
        process.wait()
        yield [how.name, f"{until:.0f}", said]


def _start(folder: pathlib.Path) -> subprocess.Popen:
    given = [FLAGS.photographs, f"--minutes={FLAGS.minutes:g}", f"--output_dir={folder}"]
    with (folder.parent / f"{folder.name}.txt").open("a") as said:
        return subprocess.Popen(
            [sys.executable, "-m", "jaxcloseup", "closeup", *given],
            stdout=said,
            stderr=said,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            start_new_session=True,
        )


def _wait(process: subprocess.Popen, seconds: float | None) -> bool:
    """Return whether a process has ended after some seconds; it must not fail."""
    try:
        if process.wait(seconds):
            sys.exit(f"the command failed with exit code {process.returncode}")
    except subprocess.TimeoutExpired:
        return False
    return True


def _last_line(folder: pathlib.Path) -> str:
    lines = (folder.parent / f"{folder.name}.txt").read_text().splitlines()
    return lines[-1].replace("|", "/")[:60] if lines else ""


def differing(one: pathlib.Path, other: pathlib.Path) -> list[str]:
    """Return the names of files that one folder alone has, or that differ in both."""
    names = {
        str(path.relative_to(folder))
        for folder in (one, other)
        for path in folder.rglob("*")
        if path.is_file()
    }
    return [name for name in sorted(names) if _content(one / name) != _content(other / name)]


def _content(path: pathlib.Path) -> Any:
    """Return a file's content without times; None if there is no file."""
    if not path.is_file():
        return None
    if path.suffix == ".json":
        return _without_times(read_object(path))
    if path.suffix == ".jsonl":
        return [_without_times(json.loads(line)) for line in path.read_text().splitlines()]
    return path.read_bytes()


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {
            name: _without_times(inner)
            for name, inner in value.items()
            if not any(word in name for word in _TIMES)
        }
    return [_without_times(inner) for inner in value] if isinstance(value, list) else value


if __name__ == "__main__":
    define_flags()
    app.run(main)
