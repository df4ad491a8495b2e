"""A short run, killed at ten random moments and resumed each time, against an uninterrupted run.

All metrics and the history of every stage must be the same to the last bit.
"""

import json
import pathlib
import random
import signal
import subprocess
import sys
import tempfile
import time


KILLS = 10
KILLS_PER_RUN = 2  # later kills would hit the restart, and no longer stage 1
COMMAND = (
    "-m",
    "experiments.run",
    "--scene=table",
    "--set=baseline_steps=700",  # relocation, harmonics and regularizers start earlier
    "--set=closeup_steps=20",
    "--save_every=50",
)


def run() -> None:
    """Print the checkpoint kept at each kill, and check that all runs end the same."""
    with tempfile.TemporaryDirectory() as folder:
        root = pathlib.Path(folder)
        start = time.perf_counter()
        _start(root / "uninterrupted", resume=False).wait()
        expected = _outcome(root / "uninterrupted")
        whole = time.perf_counter() - start
        print(f"uninterrupted: {whole:.0f} s")
        rng, killed, attempt = random.Random(0), 0, 0
        while killed < KILLS:
            target, before = root / f"killed_{attempt}", killed
            while not (target / "report.html").exists():
                process = _start(target, resume=(target / "checkpoints").is_dir())
                if killed < min(KILLS, before + KILLS_PER_RUN):
                    time.sleep(rng.uniform(0.1, 0.6) * whole)
                    if process.poll() is None:
                        process.send_signal(signal.SIGKILL)
                        killed += 1
                        steps = sorted(target.glob("checkpoints/*/[0-9]*"))
                        last = "/".join(steps[-1].parts[-2:]) if steps else "none"
                        print(f"kill {killed}: the newest checkpoint is {last}", flush=True)
                if process.wait() not in (0, -signal.SIGKILL):
                    raise AssertionError((root / "log.txt").read_text()[-2000:])
            attempt += 1
            if _outcome(target) != expected:
                raise AssertionError("a run that was killed and resumed ended differently")
        print(f"{killed} kills, {attempt} runs: the same metrics and history every time")


def _start(folder, *, resume):
    flags = [f"--output_dir={folder}", *(["--resume"] if resume else [])]
    with (folder.parent / "log.txt").open("a") as log:
        return subprocess.Popen([sys.executable, *COMMAND, *flags], stdout=log, stderr=log)


def _outcome(folder):
    results = json.loads((folder / "results.json").read_text())
    return {name: results[name] for name in ("stages", "history", "labels", "gate")}
