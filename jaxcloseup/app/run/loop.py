"""One stage of training: steps in chunks, with checkpoints and reports."""

import dataclasses
from collections.abc import Callable
from typing import Any

from jaxcloseup.app import progress
from jaxcloseup.app.run.logs import TrainLog
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.step_data import ArmsData, StepData
from jaxcloseup.app.run.timers import timed
from jaxcloseup.artifacts.checkpoints import CheckpointError, Checkpoints
from jaxcloseup.training.state import TrainState


PERSISTENT = 10  # steps in a row whose loss is not finite
_REPORTS = 10  # reports of a stage at least
_FIRST_STEPS = 20  # steps before the first report: the time left should be known soon


class Paused(Exception):
    """A stage was asked to pause, and its state is kept."""


class TrainingError(Exception):
    """Training cannot go on; the message says why, in one sentence."""


@dataclasses.dataclass
class Training:
    """Training on one scene with one preset."""

    programs: Programs
    checkpoints: Checkpoints  # keep the states of every stage
    log: TrainLog | None = None  # gets every report; None keeps none
    save_every: int = 1000  # steps between checkpoints
    report_every: int = 500  # steps between reports at most
    # Asked after every report; True keeps the state and ends the stage early with `Paused`.
    pause: Callable[[], bool] = lambda: False
    # Filled with the wall time of each part.
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    # Filled with the metrics of each stage, for each chunk of steps with `step`, counted within the
    # stage.
    history: dict[str, list[dict[str, Any]]] = dataclasses.field(default_factory=dict)


def train_stage(
    training: Training,
    stage: str,
    state: TrainState,
    data: StepData | ArmsData,
    *,
    steps: int,
    begins_at: str = "",
) -> TrainState:
    """Take `steps` steps of the kind that learns from `data`, and report ten times or more often.

    Resumes from the stage's newest checkpoint, if there is one, with the same next steps.
    `begins_at` names the stage whose state it begins with, where that is not always the same.

    Returns:
      The state after the last step.

    Raises:
      Paused: `training.pause` says so.
      CheckpointError: the checkpoint began at another stage, or cannot be read.
      TrainingError: `PERSISTENT` steps in a row, or all steps of the stage, were not finite; the
        last good state is kept.
    """
    with timed(training.seconds, stage):
        chunk = max(1, min(-(-steps // _REPORTS), training.report_every, training.save_every))
        done, state, history = _resume(training, stage, state, steps, begins_at)
        training.history[stage] = history
        saved, failing, good = done, 0, (done, state)
        while done < steps:
            count = min(chunk if done else min(chunk, _FIRST_STEPS), steps - done)
            state, metrics = training.programs.run(state, data, count=count)
            done += count
            failing = failing + count if metrics["skipped"] == count else 0
            if failing >= min(PERSISTENT, steps):
                done, state = good
                history[:] = [entry for entry in history if entry["step"] <= done]
                if done > saved:
                    _save(training, stage, done, state, begins_at)
                raise TrainingError(_why_stopped(stage, done, failing, training.checkpoints))
            if not failing:
                good = done, state
            history.append({"step": done} | metrics)
            report_steps(stage, done, steps, metrics)
            if training.log is not None:
                training.log.write(history[-1])
            paused = done < steps and training.pause() and not failing
            if done == steps or paused or (done - saved >= training.save_every and not failing):
                _save(training, stage, done, state, begins_at)
                saved = done
            if paused:
                raise Paused(f"{stage} {done}/{steps}")
    return state


def report_steps(stage: str, done: int, steps: int, metrics: dict[str, Any]) -> None:
    """Print how far a stage is, and the means of its newest steps."""
    print("  ".join([progress.count(stage, done, steps), *describe_means(metrics)]), flush=True)


def describe_means(metrics: dict[str, Any]) -> list[str]:
    """Format the means among the metrics of steps; counts are left out."""
    return [f"{key} {value:.4g}" for key, value in metrics.items() if isinstance(value, float)]


def _resume(
    training: Training, stage: str, state: TrainState, steps: int, begins_at: str
) -> tuple[int, TrainState, list[dict[str, Any]]]:
    """Return the steps taken, the state and the history of a stage's newest checkpoint, if any."""
    done, history = 0, []
    kept = training.checkpoints.load(stage, state)
    if kept is not None:
        done, state, stored = kept
        if (before := stored.get("begins_at", begins_at)) != begins_at:
            raise CheckpointError(
                f"{training.checkpoints.folder / stage} began at {before}, and would begin at "
                f"{begins_at} now: remove it to train it anew, or resume with the same --stages"
            )
        history = stored["history"]
        training.programs.make_room(stored["growth"])
        print(f"{stage} {done}/{steps}  resumed")
    progress.count(stage, done, steps)
    if training.log is not None:
        training.log.begin(stage, history)
    return done, state, history


def _save(training: Training, stage: str, done: int, state: TrainState, begins_at: str) -> None:
    kept: dict[str, Any] = {"history": training.history[stage]}
    kept |= {"growth": training.programs.growth, "begins_at": begins_at}
    training.checkpoints.save(stage, done, state, kept)


def _why_stopped(stage: str, done: int, failing: int, checkpoints: Checkpoints) -> str:
    where = f", whose state is kept in {checkpoints.folder}" if done else ""
    return (
        f"{stage} stopped after {done} good steps{where}: loss or gradient was not finite in each "
        f"of the next {failing}: lower the learning rate, or look for broken photographs or poses"
    )
