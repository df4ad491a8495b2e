"""Kill five short runs fifty times (-9), resume them, and compare them with an uninterrupted run.

Kills come at random moments of all stages of a run, and always in the first checkpoint, the gate,
an evaluation and the report. All metrics and the history of every stage must be the same to the
last bit.
"""

import json
import pathlib
import random
import signal
import subprocess
import sys
import tempfile
import time


RUNS = 5
KILLS_PER_RUN = 10
COMMAND = (
    *("-m", "experiments.run", "--scene=table", "--save_every=20"),
    *("--set=coarse.steps=150", "--set=baseline_steps=60", "--set=closeup_steps=20"),
    *("--set=steps_per_target=1", "--set=fewest_target_steps=10"),
)
# What a run prints as it begins each part, in order. These four are in every run's kills.
ALWAYS = ("first checkpoint", "comparing labels with left-out", "scoring control", "writing the")
MOMENTS = (
    *("loading table", ALWAYS[0], "coarse_baseline", "adding surfels", "] baseline", "rendering"),
    *(ALWAYS[1], "] control", ALWAYS[2], "] closeup", "scoring closeup", "making the detail"),
    *("scoring detail", "] test_time", "with the truth", "rendering a dolly", ALWAYS[3]),
)
LATEST = 3.0  # seconds between what is printed and the kill


def run() -> None:
    """Print what each kill interrupted, and check that all runs end the same."""
    rng = random.Random(0)
    with tempfile.TemporaryDirectory() as folder:
        root = pathlib.Path(folder)
        start = time.perf_counter()
        if _start(root / "uninterrupted", root / "log.txt").wait():
            raise AssertionError((root / "log.txt").read_text()[-2000:])
        print(f"uninterrupted: {time.perf_counter() - start:.0f} s", flush=True)
        expected, kills = _outcome(root / "uninterrupted"), 0
        for index in range(RUNS):
            others = [moment for moment in MOMENTS if moment not in ALWAYS]
            chosen = {*ALWAYS, *rng.sample(others, KILLS_PER_RUN - len(ALWAYS))}
            target = root / f"killed_{index}"
            for moment in sorted(chosen, key=MOMENTS.index):
                kills += _kill(target, root / "log.txt", moment, rng.uniform(0, LATEST))
                steps = sorted(target.glob("checkpoints/*/[0-9]*"))
                newest = "/".join(steps[-1].parts[-2:]) if steps else "none"
                print(f"kill {kills}, {moment}: the newest checkpoint is {newest}", flush=True)
            if _start(target, root / "log.txt").wait():
                raise AssertionError((root / "log.txt").read_text()[-2000:])
            if _outcome(target) != expected:
                raise AssertionError(f"run {index} was killed and resumed, and ended differently")
    print(f"{kills} kills, {RUNS} runs: the same metrics and history every time")


def _kill(folder, log, moment, delay):
    """Start or resume a run, and kill it `delay` seconds after a moment; False if it ended."""
    process = _start(folder, log)
    while process.poll() is None:
        if moment == ALWAYS[0]:
            reached = any(folder.glob("checkpoints/*/*"))
        else:
            reached = moment in log.read_text()
        if reached:
            time.sleep(delay / 10 if moment == ALWAYS[0] else delay)
            break
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    if process.wait() not in (0, -signal.SIGKILL):
        raise AssertionError(log.read_text()[-2000:])
    return process.returncode != 0


def _start(folder, log):
    resume = ["--resume"] if (folder / "checkpoints").is_dir() else []
    # One that was killed before its first checkpoint has left nothing to resume.
    for one in () if resume or not folder.is_dir() else folder.iterdir():
        one.unlink()
    with log.open("w") as file:
        command = [sys.executable, *COMMAND, f"--output_dir={folder}", *resume]
        return subprocess.Popen(command, stdout=file, stderr=file)


def _outcome(folder):
    results = json.loads((folder / "results.json").read_text())
    return {name: results[name] for name in ("stages", "history", "labels", "gate")}
