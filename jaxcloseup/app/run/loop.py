"""One stage of training: steps in chunks, with checkpoints."""

import dataclasses
from typing import Any

from jaxcloseup.app import progress
from jaxcloseup.app.run.logs import TrainLog
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.training.steps import TrainState


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
    reached = _resume(name, programs, state, checkpoints, steps)
    progress.count(name, reached.done, steps)
    if log is not None:
        log.begin(name, reached.history)

    def keep():
        kept = {"history": reached.history, "growth": programs.growth}
        checkpoints.save(name, reached.done, reached.state, kept)
        reached.saved = reached.done

    failing, good = 0, (reached.done, reached.state)
    while reached.done < steps:
        count = min(chunk, steps - reached.done)
        reached.state, values = programs.run(kind, reached.state, *data, count=count)
        reached.done += count
        failing = failing + count if values["skipped"] == count else 0
        if failing >= min(PERSISTENT, steps):
            reached.done, reached.state = good
            reached.history = [e for e in reached.history if e["step"] <= reached.done]
            if reached.done > reached.saved:
                keep()
            raise TrainingError(_why_stopped(name, reached.done, failing, checkpoints))
        if not failing:
            good = reached.done, reached.state
        reached.history.append({"step": reached.done} | values)
        numbers = {key: value for key, value in values.items() if isinstance(value, float)}
        shown = (f"{key} {value:.4g}" for key, value in numbers.items())
        print("  ".join([progress.count(name, reached.done, steps), *shown]), flush=True)
        if log is not None:
            log.write(reached.history[-1])
        if reached.done == steps or (reached.done - reached.saved >= save_every and not failing):
            keep()
    return reached.state, reached.history


def _resume(name, programs, state, checkpoints, steps):
    kept = checkpoints.load(name, state)
    if kept is None:
        return _Progress(0, 0, state, [])
    done, state, stored = kept
    programs.make_room(stored["growth"])
    print(f"{name} {done}/{steps}  resumed")
    return _Progress(done, done, state, stored["history"])


def _why_stopped(name, done, failing, checkpoints):
    where = f", whose state is kept in {checkpoints.folder}" if done else ""
    return (
        f"{name} stopped after {done} good steps{where}: loss or gradient was not finite in each "
        f"of the next {failing}: lower the learning rate, or look for broken photographs or poses"
    )
