"""Renders of a run at exposures that are predicted, chosen, or those of a photograph."""

import pathlib
import shutil
import types

import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.app.run.exposed import expose
from jaxcloseup.app.run.measured_exposures import write_exposures
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
    return types.SimpleNamespace(scene=scene, exposures=exposures, gain=None)


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
