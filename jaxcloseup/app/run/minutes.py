"""A preset that trains for a given time on this computer: steps are timed before the run."""

import functools
import math
import time
from collections.abc import Callable, Collection
from typing import Any, NamedTuple, TypeVar

import jax

from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.settings import settings_of, with_settings
from jaxcloseup.app.run.corrected_poses import corrects_poses
from jaxcloseup.app.run.keys import run_keys
from jaxcloseup.app.run.photograph_sizes import finest_read
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.read_photographs import ReadPhotographs
from jaxcloseup.app.run.states import initial_state, refine_state, with_depths
from jaxcloseup.app.run.step_data import TrainData
from jaxcloseup.app.run.timers import timed_compiling
from jaxcloseup.photos.scene import Scene


_USUAL = 5.0  # minutes for which a preset's number of surfels was chosen
_WARMING = 60  # steps, in which most programs are traced and compiled
_FEW, _MANY, _SECONDS = 20, 200, 5.0  # steps that are timed, and about how long they may take
_FEWEST = 100  # steps

_Result = TypeVar("_Result")


class Fitted(NamedTuple):
    """A preset that takes a given time."""

    preset: Preset
    given: list[str]  # the settings that make it
    read: ReadPhotographs  # what timing it made of the photographs


def fit_minutes(
    preset: Preset, scene: Scene, minutes: float, *, fixed: Collection[str] = ()
) -> Fitted:
    """Return the preset whose stage 1 takes so many minutes here, and the settings that make it.

    The number of steps follows from their time on this computer, the schedules of learning rates
    from the number of steps, and the number of surfels from the minutes, as their square root. The
    same settings repeat the training anywhere.

    Args:
      preset: what is trained.
      scene: what was photographed.
      minutes: wall time from here to the end of stage 1, without reading photographs. Steps get
        half of it, however long everything else takes.
      fixed: names of settings that stay as they are.

    Raises:
      ValueError: the number of steps is fixed.
    """
    if "baseline_steps" in fixed:
        raise ValueError("--minutes chooses baseline_steps: leave out one of the two")
    given: list[str] = []
    if preset.coarse is not None and "capacity" not in fixed:
        times = math.sqrt(minutes / _USUAL)
        given.append(f"capacity={max(1000, 1000 * round(preset.field.capacity * times / 1000))}")
        preset = with_settings(preset, given)
    programs = Programs(preset, scene)
    start = time.perf_counter()
    seconds = _time_steps(programs)
    left = 60 * minutes - (time.perf_counter() - start - seconds.reading) - seconds.before
    steps = max(_FEWEST, 10 * round(max(left, 30 * minutes) / seconds.step / 10))
    given += [f"baseline_steps={steps}", *_schedules(preset, steps, fixed)]
    fitted = with_settings(preset, given)
    # More steps may read finer photographs, and match these: a resumed run would, from the start.
    same = finest_read(fitted, scene) == finest_read(preset, scene)
    return Fitted(fitted, given, programs.read if same else ReadPhotographs(scene))


def _schedules(preset: Preset, steps: int, fixed: Collection[str]) -> list[str]:
    """Return the settings that stretch schedules of learning rates to a number of steps."""
    share = steps / preset.baseline_steps
    return [
        f"{name}={max(1, round(share * schedule.value))}"
        for name, schedule in settings_of(preset).items()
        if name in ("means_lr_steps", "lr_decay_steps") and name not in fixed
    ]


class _Times(NamedTuple):
    """Seconds, without compiling."""

    reading: float  # of photographs, which the run does not read again
    before: float  # the first step of stage 1: the coarse model, and what makes it finer
    step: float


def _time_steps(programs: Programs) -> _Times:
    """Time everything that a run does until the end of stage 1."""
    preset, keys, reading, before = programs.preset, run_keys(0), 0.0, 0.0
    finest = finest_read(preset, programs.scene)
    if finest < programs.scene.metadata.get("downscale", 1):
        # First, because matching and steps read a capture's finest photographs too; without
        # exposures, which come from matching.
        _, reading = _timed(lambda: programs.read.pyramid(finest))
    stereo, matching = _timed(lambda: programs.stereo)
    if preset.coarse is None:
        state = initial_state(programs, keys, stereo)
    else:
        coarse = programs.coarse
        state = initial_state(coarse, keys, stereo)
        state, each = _steps(coarse, state, TrainData(with_depths(coarse, stereo)))
        state, refining = _timed(functools.partial(refine_state, programs, state))
        before = preset.coarse.steps * each + refining
        if corrects_poses(preset, programs.scene):
            before += matching  # once more, after cameras were moved
    data = TrainData(with_depths(programs, stereo))
    return _Times(reading, before, _steps(programs, state, data)[1])


def _steps(programs: Programs, state: Any, data: TrainData) -> tuple[Any, float]:
    """Return the state after some steps, and the mean seconds of one of the later ones.

    Each call sorts surfels, which a run does seldom, so many steps are timed in one.
    """
    (state, _), warming = _timed(lambda: programs.run(state, data, count=_WARMING))
    count = round(min(max(_FEW, _SECONDS * _WARMING / warming), _MANY))
    (state, _), seconds = _timed(lambda: programs.run(state, data, count=count))
    return state, seconds / count


def _timed(call: Callable[[], _Result]) -> tuple[_Result, float]:
    """Return what a call returns, and its seconds without compiling."""
    compiling: dict[str, float] = {}
    start = time.perf_counter()
    with timed_compiling(compiling):
        result = jax.block_until_ready(call())
    return result, max(1e-6, time.perf_counter() - start - compiling["compile"])
