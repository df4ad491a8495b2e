"""What programs do with the check of a capture: print, refuse, correct, and record."""

import json

import numpy as np
import pytest
from absl import flags
from absl.testing import flagsaver
from textured_corner import write_corner, write_points

from jaxcloseup.app.cli import check as program
from jaxcloseup.app.run.capture_check import fitting_options
from jaxcloseup.app.run.manifest import about_scene
from jaxcloseup.app.run.scene_input import load
from jaxcloseup.photos.scene import SceneError


@pytest.fixture(scope="module")
def inverted(tmp_path_factory):
    """A capture whose matrices are world-to-camera."""
    folder = tmp_path_factory.mktemp("inverted") / "capture"
    fields = write_corner(folder)
    for frame in fields["frames"]:
        frame["transform_matrix"] = np.linalg.inv(frame["transform_matrix"]).tolist()
    (folder / "transforms.json").write_text(json.dumps(fields))
    return str(folder)


def fitting(name, options=None, *, fix=False, allow_misfit=False):
    return fitting_options(name, options or {}, fix=fix, allow_misfit=allow_misfit)


def test_built_in_scenes_are_not_checked():
    assert fitting("table", {"downscale": 8}) == ({"downscale": 8}, None)


def test_a_misfit_is_refused_corrected_or_allowed(inverted, capsys):
    with pytest.raises(SceneError, match=r"world-to-camera.* give --fix .* or give --allow_misfit"):
        fitting(inverted)
    options, found = fitting(inverted, {"downscale": 1}, fix=True)
    assert options == {"downscale": 1, "corrections": ["inverse"]}
    assert json.loads(json.dumps(found))["verdict"] == "misfit"
    assert "the matrices are world-to-camera" in capsys.readouterr().out
    # What a run records loads the corrected scene again.
    scene = load(inverted, options)
    recorded = about_scene(scene, {"downscale": 1})["load_options"]
    again = load(inverted, json.loads(json.dumps(recorded)))
    np.testing.assert_array_equal(again.train.cameras.camtoworld, scene.train.cameras.camtoworld)
    assert fitting(inverted, allow_misfit=True)[0] == {}


def test_points_that_fit_nothing_are_replaced_aloud(tmp_path, capsys):
    folder = tmp_path / "capture"
    write_corner(folder)
    write_points(folder, np.random.default_rng(0).uniform(0.5, 4, (800, 3)))
    options, found = fitting(str(folder))
    assert options == {"corrections": ["points=none"]} and found["verdict"] == "fits"
    assert "its points are not used, but points that are triangulated" in capsys.readouterr().out


def test_the_program_writes_a_page_and_fails_on_a_misfit(inverted, tmp_path, capsys):
    flags.FLAGS(["check"])
    with flagsaver.flagsaver(output_dir=str(tmp_path / "page"), compilation_cache=""):
        with pytest.raises(SystemExit) as stop:
            program.main(["check", inverted])
        assert stop.value.code == 1
        with pytest.raises(SystemExit, match="name one folder"):
            program.main(["check"])
    page = (tmp_path / "page/check.html").read_text()
    assert "world-to-camera" in page and "Photographs whose features fit" in page
    assert "give --fix to read it with inverse" in capsys.readouterr().out
