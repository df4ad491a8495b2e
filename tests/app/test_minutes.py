"""`--minutes`: the steps that fit, the settings that repeat them."""

import dataclasses
import time
import types

import jax
import jax.numpy as jnp
import pytest
from tiny_runs import TINY, TINY_SURFELS

from jaxcloseup.app.methods.method import CoarseConfig, WindowConfig
from jaxcloseup.app.methods.settings import with_settings
from jaxcloseup.app.run import minutes
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.read_photographs import ReadPhotographs
from jaxcloseup.captures.load import load_scene


@pytest.mark.parametrize("wanted", [0.5, 2.0])
def test_steps_and_schedules_follow_from_the_time_of_a_step(monkeypatch, wanted):
    coarse = CoarseConfig(TINY_SURFELS.field, steps=20)
    field = dataclasses.replace(TINY_SURFELS.field, capacity=20_000, means_lr_steps=90)
    preset = dataclasses.replace(
        TINY_SURFELS, coarse=coarse, field=field, windows=WindowConfig(), baseline_steps=100
    )
    times = minutes._Times(reading=0.0, before=6.0, step=0.01)
    monkeypatch.setattr(minutes, "_time_steps", lambda *_: times)
    monkeypatch.setattr(minutes, "Programs", lambda *_: types.SimpleNamespace(read="read"))
    finest = {100: 4}  # by steps: more read finer photographs
    monkeypatch.setattr(minutes, "finest_read", lambda of, _: finest.get(of.baseline_steps, 3))
    fitted, given, read = minutes.fit_minutes(preset, None, wanted)
    assert isinstance(read, minutes.ReadPhotographs)  # what a resumed run would read, too
    finest[100] = 3
    assert minutes.fit_minutes(preset, None, wanted).read == "read"
    assert fitted.baseline_steps == 6000 * wanted - 600
    with monkeypatch.context() as patch:  # half of the minutes are for the steps
        slow = times._replace(before=50.0 * wanted)
        patch.setattr(minutes, "_time_steps", lambda *_: slow)
        assert minutes.fit_minutes(preset, None, wanted).preset.baseline_steps == 3000 * wanted
    assert fitted.field.means_lr_steps == pytest.approx(0.9 * fitted.baseline_steps, abs=10)
    assert fitted.field.capacity == pytest.approx(20_000 * (wanted / 5) ** 0.5, abs=500)
    assert with_settings(preset, given) == fitted
    # What the user has set stays.
    fixed = {"capacity", "means_lr_steps"}
    fitted, given, _ = minutes.fit_minutes(preset, None, wanted, fixed=fixed)
    assert given == [f"baseline_steps={fitted.baseline_steps}"]
    assert (fitted.field.capacity, fitted.field.means_lr_steps) == (20_000, 90)
    with pytest.raises(ValueError, match="--minutes chooses baseline_steps"):
        minutes.fit_minutes(preset, None, wanted, fixed={"baseline_steps"})


def test_steps_are_timed_on_the_scene(capture_folder, monkeypatch):
    monkeypatch.setattr(minutes, "_WARMING", 2)
    monkeypatch.setattr(minutes, "_FEW", 1)
    monkeypatch.setattr(minutes, "_MANY", 3)
    monkeypatch.setattr(minutes, "_FEWEST", 1)
    scene = load_scene(str(capture_folder), downscale=2)
    with jax.numpy_dtype_promotion("standard"):
        programs = Programs(dataclasses.replace(TINY, downscale=2), scene)
        reading, before, step = minutes._time_steps(programs)
        fitted, given, _ = minutes.fit_minutes(dataclasses.replace(TINY, downscale=2), scene, 0.1)
    assert reading == before == 0 and 0 < step < 5
    assert fitted.baseline_steps >= 1
    assert given[0] == f"baseline_steps={fitted.baseline_steps}"


def test_reading_photographs_is_no_part_of_the_time(capture_folder, monkeypatch):
    """A method without a coarse model reads finer photographs, too."""
    scene = load_scene(str(capture_folder), downscale=2)
    preset = dataclasses.replace(TINY, downscale=2, windows=WindowConfig(finest=1))
    programs, read = Programs(preset, scene), ReadPhotographs.pyramid

    def read_slowly(self, finest=1):
        if not self._pyramids:
            time.sleep(0.2)
        return read(self, finest)

    monkeypatch.setattr(ReadPhotographs, "pyramid", read_slowly)
    monkeypatch.setattr(minutes, "initial_state", lambda *_: None)
    monkeypatch.setattr(minutes, "_steps", lambda *_: (None, 0.01))
    start = time.perf_counter()
    reading, *_ = minutes._time_steps(programs)
    assert 0.2 <= reading < time.perf_counter() - start


def test_compiling_is_no_part_of_the_time():
    """A run compiles once, however many steps it takes."""

    @jax.jit
    def compiled_slowly(x):
        for i in range(40):
            x = x @ jnp.sin(x + i)
        return x

    start = time.perf_counter()
    result, seconds = minutes._timed(lambda: compiled_slowly(jnp.eye(3)))
    assert result.shape == (3, 3)
    assert 0 <= seconds < 0.8 * (time.perf_counter() - start)
    _, again = minutes._timed(lambda: time.sleep(0.1))
    assert 0.1 <= again < 1
