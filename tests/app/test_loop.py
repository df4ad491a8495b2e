"""Where a stage reports and saves, with steps that only count."""

import pathlib
from types import SimpleNamespace

import pytest

from jaxcloseup.app.run.loop import Paused, Training, train_stage
from jaxcloseup.artifacts.checkpoints import CheckpointError


class Kept:
    """Checkpoints in memory."""

    folder = pathlib.Path("checkpoints")

    def __init__(self):
        self.saved = []

    def load(self, stage, like):
        return self.saved[-1] if self.saved else None

    def save(self, stage, done, state, progress):
        self.saved.append((done, state, {**progress, "history": [*progress["history"]]}))


def train(kept, steps, save_every, pause=lambda: False):
    def run(state, data, *, count):
        return state + count, {"skipped": 0}

    programs = SimpleNamespace(run=run, growth=1, make_room=lambda growth: None)
    training = Training(programs, kept, save_every=save_every, pause=pause)
    assert train_stage(training, "baseline", 0, None, steps=steps) == steps
    return [entry["step"] for entry in training.history["baseline"]]


def test_the_first_report_comes_soon_and_saves_as_often_as_asked():
    kept = Kept()
    steps = train(kept, 1000, 40)
    assert steps == [20, *range(60, 1000, 40), 1000]
    assert [done for done, *_ in kept.saved] == [*range(60, 1000, 40), 1000]
    assert train(Kept(), 30_000, 1000) == [20, *range(520, 30_000, 500), 30_000]


def test_a_resumed_stage_reports_at_the_same_steps():
    kept, whole = Kept(), train(Kept(), 1000, 40)
    train(kept, 1000, 40)
    del kept.saved[3:]
    assert train(kept, 1000, 40) == whole


def test_a_stage_is_not_resumed_from_another_start():
    """Stages that were asked for anew may come before it."""
    programs = SimpleNamespace(
        run=lambda state, data, *, count: (state + count, {"skipped": 0}),
        growth=1,
        make_room=lambda growth: None,
    )
    kept = Kept()
    training = Training(programs, kept)
    stage = {"steps": 5, "begins_at": "control"}
    assert train_stage(training, "test_time", 0, None, **stage) == 5
    assert train_stage(training, "test_time", 9, None, **stage) == 5
    with pytest.raises(CheckpointError, match="test_time began at control, and would begin at clo"):
        train_stage(training, "test_time", 9, None, steps=5, begins_at="closeup")


def test_a_paused_stage_keeps_its_state_and_goes_on():
    kept, asked = Kept(), iter([False, False, True])
    with pytest.raises(Paused, match="baseline 160/1000"):
        train(kept, 1000, 70, pause=lambda: next(asked))
    assert kept.saved[-1][:2] == (160, 160)
    assert train(kept, 1000, 70) == train(Kept(), 1000, 70)
