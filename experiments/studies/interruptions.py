"""Stop `closeup` at random moments until it ends, and compare what it made with an unstopped one.

    python -m experiments.studies.interruptions --photographs=FOLDER

Half of the interruptions are Ctrl-C, half kill the program at once. All trainings take the settings
of the unstopped one, because `--minutes` chooses others whenever it times steps. Pictures, page,
splats, poses and scores are compared to the last byte, without what says how long something took,
and videos frame by frame. What is there in `--output_dir` is not made again.
"""

import itertools
import os
import pathlib
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from absl import app, flags

from experiments.studies.tables import print_table
from jaxcloseup.io.files import read_object


FLAGS = flags.FLAGS
# What begins a closeup: the settings of its training, and what says that the folder is its own.
_BEGUN = ("run/checkpoints/run.json", "source.json")
_MADE = ("closeups/*", "dolly.*", "share/**/*", "capture/sparse/**/*", "capture/images/*")
_MADE += ("run/results.json", "run/exposures.json", "run/poses.json", "run/splats/*")
_TIMES = ("time", "seconds", "minutes", "compil", "memory")  # in names of what is never the same


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_string("photographs", None, "folder of photographs", required=True)
    flags.DEFINE_integer("interruptions", 20, "how many, over as many ends as they take")
    flags.DEFINE_float("every", 40.0, "seconds from a start to an interruption, on average")
    flags.DEFINE_float("minutes", 0.1, "minutes of training, as of closeup")
    flags.DEFINE_integer("seed", 0, "seed of the moments")
    flags.DEFINE_string("output_dir", "outputs/studies/interruptions", "folder of the closeups")


def main(_: list[str]) -> None:
    """Make the unstopped close-ups, then interrupted ones, and print a table."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell ignores Ctrl-C
    root, rng = pathlib.Path(FLAGS.output_dir), np.random.default_rng(FLAGS.seed)
    root.mkdir(parents=True, exist_ok=True)
    whole, rows = root / "whole", list[list[str]]()
    if not (whole / "share" / "index.html").exists():
        _wait(_start(whole), None)
    for number in itertools.count():
        folder = root / str(number)
        if len(rows) >= FLAGS.interruptions:
            break
        if folder.exists():
            continue
        begin(whole, folder)
        moments = [*_interrupted(folder, rng)]
        end = ", ".join(differing(whole, folder)) or "the same"
        rows += [[str(number), *moment, end] for moment in moments]
        print(f"closeups {number}: {len(moments)} interruptions, {end}", flush=True)
    print_table("Interruptions", ["closeups", "by", "after (s)", "while", "the end"], rows)


def begin(whole: pathlib.Path, folder: pathlib.Path) -> None:
    """Begin close-ups in a new folder, with the settings of finished ones.

    Raises:
      OSError: a file of theirs is missing, or the folder cannot be written.
    """
    for name in _BEGUN:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(whole / name, folder / name)


def _interrupted(folder: pathlib.Path, rng: np.random.Generator) -> Iterator[list[str]]:
    """Stop close-ups until they end; yield how, when, and the line that was printed last."""
    while True:
        process, until = _start(folder), rng.exponential(FLAGS.every)
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
    except KeyboardInterrupt:
        os.killpg(process.pid, signal.SIGKILL)
        raise
    return True


def _last_line(folder: pathlib.Path) -> str:
    lines = (folder.parent / f"{folder.name}.txt").read_text().splitlines()
    return lines[-1].replace("|", "/")[:60] if lines else ""


def differing(one: pathlib.Path, other: pathlib.Path) -> list[str]:
    """Return the names of what one folder alone has, or what differs in both."""
    names = {
        str(path.relative_to(folder))
        for folder in (one, other)
        for pattern in _MADE
        for path in folder.glob(pattern)
        if path.is_file()
    }
    return [name for name in sorted(names) if _content(one / name) != _content(other / name)]


def _content(path: pathlib.Path) -> Any:
    """Return a file's content without times; None if there is no file."""
    if not path.is_file():
        return None
    if path.suffix == ".json":
        return _without_times(read_object(path))
    if path.suffix in (".webm", ".mp4"):  # they begin with the time of writing
        video, frames = cv2.VideoCapture(str(path)), list[bytes]()
        while (frame := video.read())[0]:
            frames.append(frame[1].tobytes())
        return frames
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
