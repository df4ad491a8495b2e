"""Renders of a run at exposures that are predicted, chosen, or those of a photograph."""

import functools
import pathlib
import shutil
import types

import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.app.run import scoring
from jaxcloseup.app.run.exposed import expose, how_taken, render_exposed
from jaxcloseup.app.run.measured_exposures import write_exposures
from jaxcloseup.app.score.scores import evaluate
from jaxcloseup.app.score.targets import Target
from jaxcloseup.app.store.stored_run import RunError, load_run_scene, read_run, restore
from jaxcloseup.app.view.camera_paths import CameraError
from jaxcloseup.app.view.rendering import choose_exposure
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.photos.exposures import Exposures, Metering


GAINS = np.linspace(-0.4, 0.4, 15).reshape(5, 3).astype(np.float32)
LIGHT = 0.2140411  # that the gray of a half encodes, in the standard of sRGB


def metering(slope):
    values = 10.0, np.log([LIGHT / 2] * 3), [slope, 0.0]
    return Metering(*(jnp.asarray(value, jnp.float32) for value in values))


@pytest.fixture
def programs():
    """What `expose` and `choose_exposure` ask of programs: a camera that halves its exposures."""
    scene = types.SimpleNamespace(name="plane", names={"train": list("01234")})
    exposures = Exposures(jnp.asarray(GAINS), metering(-1.0))
    return types.SimpleNamespace(scene=scene, exposures=exposures, taken=None)


@pytest.fixture
def seen():
    """A view with twice the light of the photographs."""
    gray = jnp.full((6, 8, 3), 0.5)
    return Rendering(gray, jnp.ones((6, 8)), jnp.ones((6, 8)))


def colors_of(light):
    return 1.055 * np.asarray(light) ** (1 / 2.4) - 0.055


def test_a_view_gets_the_exposure_that_the_camera_would_choose(programs, seen):
    found = expose(programs, seen.rgb, seen)
    np.testing.assert_allclose(found, np.full((6, 8, 3), colors_of(LIGHT / 2)), rtol=1e-4)
    choose_exposure(programs, "auto")
    np.testing.assert_array_equal(expose(programs, seen.rgb, seen), found)


def test_exposures_are_chosen(programs, seen):
    choose_exposure(programs, "middle")
    np.testing.assert_allclose(expose(programs, seen.rgb, seen), seen.rgb, rtol=1e-5)
    choose_exposure(programs, "3")
    expected = np.broadcast_to(colors_of(LIGHT * np.exp(GAINS[3])), (6, 8, 3))
    np.testing.assert_allclose(expose(programs, seen.rgb, seen), expected, rtol=1e-4)
    with pytest.raises(CameraError, match="--exposure=7 is no training view of plane"):
        choose_exposure(programs, "7")


def test_a_photograph_whose_exposure_is_known_gets_it(programs, seen):
    stated = {"test": {"near": jnp.log(jnp.array([2.0, 1.0, 0.5]))}}
    programs.exposures = programs.exposures.replace(stated=stated)
    near = how_taken(programs, "test", "near")
    expected = np.broadcast_to(colors_of(LIGHT * np.array([2, 1, 0.5])), (6, 8, 3))
    np.testing.assert_allclose(expose(programs, seen.rgb, seen, near), expected, rtol=1e-4)
    np.testing.assert_allclose(how_taken(programs, "train", "3").gain, np.exp(GAINS[3]), rtol=1e-6)
    for split, name in (("test", "far"), ("test_far", "near"), (None, "near")):
        assert how_taken(programs, split, name).gain is None
    choose_exposure(programs, "middle")  # what the user asks for goes first
    np.testing.assert_allclose(expose(programs, seen.rgb, seen, near), seen.rgb, rtol=1e-5)
    programs.exposures = None
    assert how_taken(programs, "train", "3") is None


def test_a_camera_with_a_curve_takes_its_own_photographs(programs, seen):
    """Another camera's views stay as sRGB encodes them, and a view of none has the usual curve."""
    curve = jnp.linspace(0, 1, 256) ** 3
    cameras = {"train": dict.fromkeys("0123", "film") | {"4": "plain"}, "test": {"near": "plain"}}
    programs.exposures = programs.exposures.replace(curves={"film": curve}, cameras=cameras)
    light = LIGHT * np.exp(GAINS)
    for name, colors in (("3", light[3] ** (1 / 3)), ("4", colors_of(light[4]))):
        taken = how_taken(programs, "train", name)
        found = expose(programs, seen.rgb, seen, taken)
        np.testing.assert_allclose(found[2, 3], colors, atol=1e-3)
    assert how_taken(programs, "test", "near").curve is None
    choose_exposure(programs, "middle")
    np.testing.assert_allclose(expose(programs, seen.rgb, seen), LIGHT ** (1 / 3), atol=1e-3)


def test_held_out_views_are_scored_at_their_known_exposure(programs, seen, monkeypatch):
    """The photograph has 4.1 times the light of the middle, and its file says 4."""
    truth = colors_of(np.full((6, 8, 3), 4.1 * LIGHT / 2))
    targets = [
        Target(name, None, truth.astype(np.float32), np.ones((6, 8)), jnp.ones((6, 8)))
        for name in ("stated", "unknown")
    ]
    found = {"test": targets[:1], "test_reduced": targets}
    monkeypatch.setattr(scoring, "targets_by_split", lambda *_, **__: found)
    programs.exposures = programs.exposures.replace(
        stated={"test": {"stated": jnp.log(jnp.full(3, 4.0))}}
    )
    programs.scene.surface = None
    programs.scene.train = types.SimpleNamespace(cameras=types.SimpleNamespace(width=8, height=6))
    programs.scene.metadata = {}
    programs.scene.photographs_at = None
    programs.preset = types.SimpleNamespace(score_width=None)
    middle = seen._replace(rgb=jnp.full((6, 8, 3), colors_of(LIGHT / 2), jnp.float32))
    programs.render = lambda state, camera: middle
    start = types.SimpleNamespace(state=None, sources=types.SimpleNamespace(depths=None))
    held = scoring.hold_out(programs, start)
    render = functools.partial(render_exposed, programs, None)
    for split in found:
        views = evaluate(render, held.targets[split])[0]["views"]
        assert views["stated"]["psnr"] > 35
    assert views["unknown"]["psnr"] < 15


def test_photographs_of_one_exposure_leave_renders_alone(programs, seen):
    programs.exposures = None
    for exposure in ("auto", "middle", "0"):
        choose_exposure(programs, exposure)
        assert expose(programs, seen.rgb, seen) is seen.rgb


def test_a_run_gets_its_exposures_back(kept, tmp_path):
    run = pathlib.Path(shutil.copytree(kept, tmp_path / "run"))
    scene = load_run_scene(read_run(run))
    assert restore(read_run(run), scene, "baseline")[0].exposures is None
    exposures = Exposures(jnp.asarray(GAINS), metering(-0.5))
    write_exposures(run, exposures, scene.names["train"])
    programs, _ = restore(read_run(run), scene, "baseline")
    np.testing.assert_array_equal(programs.exposures.log_gains, GAINS)
    # What steps and labels read is at the middle exposure.
    light = np.asarray(scene.train.rgb[4], np.float64) / 255
    light = np.where(light < 0.04045, light / 12.92, ((light + 0.055) / 1.055) ** 2.4)
    expected = colors_of(light * np.exp(-GAINS[4]))
    bright = light.min(-1) > 0.05
    np.testing.assert_allclose(
        np.asarray(programs.train.rgb[4])[bright], expected[bright], rtol=1e-3
    )
    pyramid, _ = programs.pyramid()
    np.testing.assert_allclose(
        np.asarray(pyramid.image(4, 0))[..., :3][bright], expected[bright], rtol=1e-3
    )
    (run / "exposures.json").write_text("{}")
    with pytest.raises(RunError, match="does not hold the exposures of these photographs"):
        restore(read_run(run), scene, "baseline")
