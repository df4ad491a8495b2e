"""Exposures that files state, against gains that two cameras made of them."""

import numpy as np
import pytest

from jaxcloseup.app.run import measured_exposures
from jaxcloseup.photos.exposures import solve_gains
from jaxcloseup.photos.stated_exposures import StatedExposure, fit_cameras, gains_of_files


OFFSETS = {"one": np.array([0.3, 0.2, 0.1]), "other": np.array([-1.0, -0.9, -1.1])}


@pytest.fixture
def taken():
    """Log gains `[V, 3]` of two cameras, known to 0.05, and what their files state."""
    rng = np.random.default_rng(0)
    cameras = ["one"] * 6 + ["other"] * 9
    stated = [StatedExposure(camera, rng.uniform(-1, 1)) for camera in cameras]
    gains = np.stack([OFFSETS[found.camera] + found.log_exposure for found in stated])
    return gains + 0.05 * rng.standard_normal(gains.shape), stated


def test_each_camera_has_its_own_offset(taken):
    found = fit_cameras(*taken)
    assert found.keys() == OFFSETS.keys()
    for camera, offset in OFFSETS.items():
        np.testing.assert_allclose(found[camera], offset, atol=0.05)


def test_photographs_without_a_statement_and_single_ones_say_nothing(taken):
    gains, stated = taken
    gains = np.concatenate([gains, [[5.0, 5.0, 5.0], [-5.0, -5.0, -5.0]]])
    found = fit_cameras(gains, [*stated, None, StatedExposure("third", 0.0)])
    assert found == {name: pytest.approx(offset) for name, offset in fit_cameras(*taken).items()}
    assert fit_cameras(gains, [None] * len(gains)) == {}


def test_files_that_do_not_explain_the_gains_are_not_believed(taken):
    """Such as those of an editor that evened the photographs out."""
    gains, stated = taken
    assert fit_cameras(0.05 * np.random.default_rng(1).standard_normal(gains.shape), stated) == {}
    shuffled = np.random.default_rng(2).permutation(len(gains))
    assert (
        fit_cameras(gains[shuffled], [found and found._replace(camera="") for found in stated])
        == {}
    )


def test_one_photograph_tells_no_camera(taken):
    gains, stated = taken
    assert fit_cameras(gains[:1], stated[:1]) == {}
    assert fit_cameras(gains[:0], []) == {}


def test_gains_follow_from_files_of_known_cameras(taken):
    _, stated = taken
    found = gains_of_files([*stated, None], {"other": OFFSETS["other"]})
    assert found.shape == (16, 3) and not found[:6].any() and not found[15].any()
    np.testing.assert_allclose(found[8], OFFSETS["other"] + stated[8].log_exposure)


def test_a_photograph_without_matches_has_the_exposure_of_its_file(taken):
    gains, stated = taken
    logs = gains[:, None] + np.random.default_rng(3).normal(-1, 0.4, (300, 3))
    logs[2] = np.nan
    found, offsets = measured_exposures._solve(logs, stated)
    assert offsets.keys() == OFFSETS.keys()
    np.testing.assert_allclose(found.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(found, gains - gains.mean(0), atol=0.1)
    assert np.abs(solve_gains(logs)[2] - (gains - gains.mean(0))[2]).max() > 0.2


def test_files_that_are_not_believed_change_no_gain(taken):
    """Photographs that an editor evened out, three of which match no other."""
    _, stated = taken
    rng = np.random.default_rng(4)
    logs = rng.normal(-1, 0.4, (300, 3)) + 0.02 * rng.standard_normal((15, 300, 3))
    logs[[1, 7, 9]] = np.nan
    found, offsets = measured_exposures._solve(logs, stated)
    assert offsets == {} and np.abs(found).max() < 0.02
