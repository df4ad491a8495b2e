"""One stage of training: steps in chunks, with checkpoints, rates and the time left."""

import dataclasses
import time
from typing import Any

from experiments.training.logs import TrainLog
from experiments.training.programs import Programs
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.train import TrainState


PERSISTENT = 10  # steps in a row whose loss is not finite


class TrainingError(Exception):
    """Training cannot go on; the message says why, in one sentence."""


@dataclasses.dataclass
class _Progress:
    """How far a stage has come.

    Attributes:
      done: steps taken.
      saved: steps of the newest checkpoint.
      state: after these steps.
      history: metrics of each chunk, with `step`.
    """

    done: int
    saved: int
    state: TrainState
    history: list[dict[str, Any]]


def run_stage(
    name: str,
    programs: Programs,
    kind: str,
    state: TrainState,
    *data: Any,
    steps: int,
    checkpoints: Checkpoints,
    save_every: int,
    log: TrainLog | None = None,
) -> tuple[TrainState, list[dict[str, Any]]]:
    """Take `steps` steps, reporting ten times or at least every 500 steps.

    Resumes from the stage's newest checkpoint, if there is one, with the same next steps.

    Args:
      name: the stage's name.
      programs: what is compiled.
      kind: kind of step, as `Programs.run` knows it.
      state: the state before the first step.
      *data: as `Programs.run` takes it.
      steps: how many.
      checkpoints: keep the states.
      save_every: steps between checkpoints, rounded up to a report; the last state is always kept.
      log: gets every report.

    Returns:
      The state, and for each chunk its metrics with `step`, counted within the stage.

    Raises:
      TrainingError: `PERSISTENT` steps in a row, or all steps of the stage, were not finite; the
        last good state is kept.
    """
    chunk = max(1, min(-(-steps // 10), 500))
    progress = _resume(name, programs, state, checkpoints, steps)
    begun = progress.done
    if log is not None:
        log.begin(name, progress.history)

    def keep():
        kept = {"history": progress.history, "growth": programs.growth}
        checkpoints.save(name, progress.done, progress.state, kept)
        progress.saved = progress.done

    start = time.perf_counter()
    failing, good = 0, (progress.done, progress.state)
    while progress.done < steps:
        count = min(chunk, steps - progress.done)
        progress.state, values = programs.run(kind, progress.state, *data, count=count)
        progress.done += count
        failing = failing + count if values["skipped"] == count else 0
        if failing >= min(PERSISTENT, steps):
            progress.done, progress.state = good
            progress.history = [e for e in progress.history if e["step"] <= progress.done]
            if progress.done > progress.saved:
                keep()
            raise TrainingError(_why_stopped(name, progress.done, failing, checkpoints))
        if not failing:
            good = progress.done, progress.state
        progress.history.append({"step": progress.done} | values)
        rate = (progress.done - begun) / (time.perf_counter() - start)
        _print_progress(name, progress.done, steps, rate, values)
        if log is not None:
            log.write(progress.history[-1])
        if progress.done == steps or (progress.done - progress.saved >= save_every and not failing):
            keep()
    return progress.state, progress.history


def _resume(name, programs, state, checkpoints, steps):
    kept = checkpoints.load(name, state)
    if kept is None:
        return _Progress(0, 0, state, [])
    done, state, stored = kept
    programs.make_room(stored["growth"])
    print(f"{name:>9} {done}/{steps}  resumed")
    return _Progress(done, done, state, stored["history"])


def _why_stopped(name, done, failing, checkpoints):
    where = f", whose state is kept in {checkpoints.folder}" if done else ""
    return (
        f"{name} stopped after {done} good steps{where}: loss or gradient was not finite in each "
        f"of the next {failing}: lower the learning rate, or look for broken photographs or poses"
    )


def _print_progress(name, done, steps, rate, values):
    left = int((steps - done) / rate)
    numbers = {key: value for key, value in values.items() if isinstance(value, float)}
    shown = "  ".join(f"{key} {value:.4g}" for key, value in numbers.items())
    print(
        f"{name:>9} {done:>{len(str(steps))}}/{steps}  {rate:6.1f} steps/s  "
        f"{left // 60}:{left % 60:02d} left  {shown}",
        flush=True,
    )
