"""Response curves against a camera whose curve and exposures are known."""

import numpy as np
import pytest

from jaxcloseup.photos.exposures import solve_gains
from jaxcloseup.photos.responses import LEVELS, SRGB, fit_response, straighten


VIEWS, POINTS = 24, 600


def shoulder(light):
    """Return colors of a camera that compresses highlights, of twice the light of white too."""
    return 1.3 * light**0.7 / (light**0.7 + 0.6)


def srgb(light):
    return np.interp(light, SRGB, np.linspace(0, 1, LEVELS))


def take(response, *, noise=0.0, seed=0, views=VIEWS, share=0.3):
    """Return log gains `[V, 1]`, and log light `[V, P, 3]` that sRGB reads from bytes."""
    rng = np.random.default_rng(seed)
    gains = rng.uniform(-0.7, 0.7, (views, 1))
    light = gains[:, None] + rng.uniform(np.log(0.02), np.log(0.9), (POINTS, 3))
    colors = np.rint(255 * np.clip(response(np.exp(light)), 0, 1)) / 255
    logs = np.log(np.interp(colors, np.linspace(0, 1, LEVELS), SRGB).clip(1e-6))
    logs = logs + noise * rng.standard_normal(logs.shape)
    shown = ((colors > 0.03) & (colors < 0.97)).all(-1) & (rng.random(logs.shape[:2]) < share)
    return gains - gains.mean(), np.where(shown[..., None], logs, np.nan)


def far_off(found, light):
    """Return by how much light `[N]` is off after the best power and scale are applied."""
    design = np.stack([found, np.ones_like(found)], 1)
    return np.abs(design @ np.linalg.lstsq(design, light, rcond=None)[0] - light)


@pytest.mark.parametrize(("noise", "bound"), [(0.0, 0.02), (0.05, 0.04)])
def test_curve_and_gains_are_recovered(noise, bound):
    gains, logs = take(shoulder, noise=noise)
    curve = fit_response(logs)
    straight, shown = straighten(logs, curve), np.isfinite(logs)
    lights = np.geomspace(1e-4, 4, 2000)
    exact = np.log(np.interp(srgb(np.exp(logs[shown])), shoulder(lights), lights))
    assert np.quantile(far_off(straight[shown], exact), 0.95) < bound
    assert np.quantile(far_off(logs[shown], exact), 0.95) > 4 * bound
    found = solve_gains(straight)
    scale = (found * gains).sum() / (3 * (gains**2).sum())
    np.testing.assert_allclose(found, scale * gains.repeat(3, 1), atol=bound)


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_many_photographs_tell_a_curve_too(share):
    """Whether most show few of the points, or each shows most of them."""
    logs = take(shoulder, views=1000, share=share)[1]
    few = fit_response(take(shoulder)[1])
    np.testing.assert_allclose(fit_response(logs)[64:], few[64:], rtol=0.1)


def test_a_curve_has_a_slope_of_1_and_keeps_the_mean():
    _, logs = take(shoulder)
    curve = fit_response(logs)
    assert curve.shape == (LEVELS,) and curve[0] == 0 and np.all(np.diff(curve) > 0)
    shown = np.isfinite(logs)
    np.testing.assert_allclose(straighten(logs, curve)[shown].mean(), logs[shown].mean(), atol=0.01)


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.2])
def test_a_camera_of_srgb_keeps_its_colors(noise):
    assert fit_response(take(srgb, noise=noise)[1]) is None


def test_photographs_of_one_exposure_tell_no_curve():
    rng = np.random.default_rng(1)
    logs = rng.uniform(-3, -0.2, (POINTS, 3)) + 0.05 * rng.standard_normal((VIEWS, POINTS, 3))
    assert fit_response(logs) is None


def test_few_points_tell_no_curve():
    assert fit_response(take(shoulder)[1][:, :100]) is None
    assert fit_response(np.full((3, 500, 3), np.nan)) is None
