"""Exposures against photographs whose gains, and whose camera's choice, are known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest

from jaxcloseup.photos.exposures import (
    Taken,
    at_middle_exposure,
    fit_metering,
    look_at_points,
    meter,
    predict_gain,
    solve_gains,
    stack_curves,
    take,
)
from jaxcloseup.photos.pyramids import photograph_pyramid
from jaxcloseup.photos.views import camera_at
from jaxcloseup.photos.windows import cut_window, photograph_windows


VIEWS = 8


def known_gains(curve):
    """Return log gains `[V, 3]`, 0 on average: exposures up to 1.4 stops apart, and tints."""
    rng = np.random.default_rng(0)
    gains = rng.uniform(-0.5, 0.5, (VIEWS, 1)) + 0.05 * rng.standard_normal((VIEWS, 3))
    return curve * (gains - gains.mean(0))


@pytest.fixture(scope="module")
def plain():
    """Photographs of a plane from several sides, with half the light, and their depths."""
    places = np.random.default_rng(1).uniform(-1, 1, (VIEWS, 2))
    views, depths = plane.make_views([plane.camera_above(x, y, 4.0) for x, y in places])
    return views.replace(rgb=0.5 * views.rgb + 0.05), depths


def seen_logs(views, depths):
    """Return what `look_at_points` says of points on the plane, `[V, P, 3]`."""
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-2, 2, (400, 2)), np.zeros(400)])
    points = jnp.asarray(points, jnp.float32)
    look = jax.jit(look_at_points)
    looks = [
        look(camera_at(views.cameras, v), depths[v], views.rgb[v], views.weight[v], points)
        for v in range(len(views))
    ]
    return np.stack(looks), points


def taken_with(rgb, log_gains):
    """Return colors of sRGB in float64 with so much more light."""
    rgb = np.asarray(rgb, np.float64)
    light = np.where(rgb < 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    light *= np.exp(log_gains)
    return np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def as_bytes(colors):
    return np.rint(255 * np.clip(colors, 0, 1)).astype(np.float32) / 255


def test_gains_are_recovered(plain):
    """Photographs are bytes, taken with the curve of sRGB."""
    views, depths = plain
    log_gains = known_gains(1.0)
    taken = views.replace(
        rgb=jnp.asarray(as_bytes(taken_with(views.rgb, log_gains[:, None, None])))
    )
    found = solve_gains(seen_logs(taken, depths)[0])
    np.testing.assert_allclose(found.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(found, log_gains, atol=0.02)


def test_without_noise_the_gains_are_those_of_all_equations():
    """The oracle solves for gains and colors at once, in float64."""
    rng = np.random.default_rng(3)
    gains = known_gains(0.5)
    logs = gains[:, None] + rng.normal(-1, 0.4, (100, 3))
    logs[rng.random((VIEWS, 100)) < 0.3] = np.nan
    view, point = np.nonzero(np.isfinite(logs[..., 0]))
    rows = np.zeros((len(view) + 1, VIEWS + 100))
    rows[np.arange(len(view)), view] = rows[np.arange(len(view)), VIEWS + point] = 1
    rows[-1, :VIEWS] = 1  # the middle
    wanted = np.concatenate([logs[view, point], np.zeros((1, 3))])
    oracle = np.linalg.lstsq(rows, wanted, rcond=None)[0][:VIEWS]
    np.testing.assert_allclose(oracle, gains, atol=1e-9)
    np.testing.assert_allclose(solve_gains(logs), oracle, atol=0.02)


def test_highlights_do_not_move_gains():
    rng = np.random.default_rng(4)
    gains = known_gains(0.5)
    logs = gains[:, None] + rng.normal(-1, 0.4, (500, 3)) + 0.02 * rng.standard_normal((8, 500, 3))
    shine = rng.random((VIEWS, 500)) < 0.15
    logs[shine] += rng.uniform(0.2, 1, (shine.sum(), 1))
    np.testing.assert_allclose(solve_gains(logs), gains, atol=0.02)


def test_a_photograph_without_matches_has_the_middle_exposure():
    gains = known_gains(0.5)
    logs = gains[:, None] + np.random.default_rng(5).normal(-1, 0.4, (100, 3))
    logs[3] = np.nan
    found = solve_gains(logs)
    np.testing.assert_allclose(found[3], -found[[0, 1, 2, 4, 5, 6, 7]].sum(0), atol=1e-9)
    assert np.abs(found - found[3] - (gains - np.delete(gains, 3, 0).mean(0)))[:3].max() < 0.03


def test_what_is_clipped_dark_or_hidden_is_not_compared(plain):
    views, depths = plain
    logs, points = seen_logs(views, depths)
    camera = camera_at(views.cameras, 0)
    shown = np.isfinite(logs[0, :, 0])
    assert 50 < shown.sum() < 400
    x, y, z = ((np.asarray(points) - np.asarray(camera.position)) @ np.asarray(camera.rotation)).T
    column, row = plane.FOCAL * x / z + plane.WIDTH / 2, plane.FOCAL * y / z + plane.HEIGHT / 2
    inside = (column > 0) & (column < plane.WIDTH) & (row > 0) & (row < plane.HEIGHT)
    np.testing.assert_array_equal(shown, inside)
    for changed in (
        {"rgb": views.rgb.at[0].set(1.0)},
        {"rgb": views.rgb.at[0].set(0.01)},
        {"weight": views.weight.at[0].set(0)},
    ):
        assert np.isnan(seen_logs(views.replace(**changed), depths)[0][0]).all()
    assert np.isnan(seen_logs(views, depths * 1.1)[0]).all()
    # What lies half a pixel from a mask has a part of it.
    masked = views.replace(
        rgb=jnp.full_like(views.rgb, 0.5).at[:, :, 20:].set(0.1),
        weight=views.weight.at[:, :, 20:].set(0),
    )
    known = seen_logs(masked, depths)[0][0]
    known = known[np.isfinite(known)]
    assert len(known) > 50 and np.ptp(known) < 1e-4


def test_metering_is_a_weighted_mean_of_light():
    rng = np.random.default_rng(6)
    image, weight = rng.uniform(0, 1, (5, 7, 3)), rng.uniform(0, 1, (5, 7))
    light_of = np.where(image < 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    total, light = 0.0, np.zeros(3)
    for row in range(5):
        for column in range(7):
            y, x = (row + 0.5) / 5 - 0.5, (column + 0.5) / 7 - 0.5
            share = weight[row, column] * np.exp(-(x**2 + y**2) / (2 * 0.3**2))
            total, light = total + share, light + share * light_of[row, column]
    arrays = jnp.asarray(image, jnp.float32), jnp.asarray(weight, jnp.float32)
    np.testing.assert_allclose(meter(*arrays, 0.3), np.log(light / total), rtol=1e-5)


def camera_that_meters(slope, count=30, noise=0.0):
    """Return log gains and photographs of a camera that chooses gains by the middle of a view."""
    rng = np.random.default_rng(7)
    weight = jnp.ones((12, 16))
    contents = [
        np.clip(rng.uniform(0.2, 0.5) + 0.1 * rng.standard_normal((12, 16, 3)), 0.02, 1)
        for _ in range(count)
    ]
    metered = np.array([meter(jnp.asarray(c, jnp.float32), weight, 0.35) for c in contents])
    brightness = metered.mean(1, keepdims=True)
    gains = slope * (brightness - brightness.mean()) + noise * rng.standard_normal((count, 1))
    gains = np.repeat(gains - gains.mean(), 3, axis=1)
    taken = [
        (jnp.asarray(as_bytes(taken_with(c, g))), weight)
        for c, g in zip(contents, gains, strict=True)
    ]
    return gains, taken, contents


def test_the_camera_s_choice_is_learned():
    gains, taken, contents = camera_that_meters(-0.8)
    metering = fit_metering(gains, taken)
    assert metering.width == np.float32(0.35)
    np.testing.assert_allclose(metering.slopes, [-0.8, 0], atol=0.01)
    for content, gain in zip(contents[:4], gains, strict=False):
        predicted = predict_gain(metering, jnp.asarray(content, jnp.float32), taken[0][1])
        np.testing.assert_allclose(predicted, np.exp(gain), rtol=0.02)


@pytest.mark.parametrize("color", [0.0, 0.5, 1 / 255], ids=["black", "masked", "capped"])
def test_photographs_that_show_nothing_are_no_evidence_of_a_choice(color):
    """Their light has no logarithm, and would outweigh all others."""
    gains, taken, _ = camera_that_meters(-0.8)
    rgb, weight = jnp.full((12, 16, 3), color), jnp.full((12, 16), float(color != 0.5))
    if color == 1 / 255:  # noise of the sensor
        rgb = rgb.at[::2].set(0)
    found = fit_metering(np.concatenate([gains, np.zeros((1, 3))]), [*taken, (rgb, weight)])
    jax.tree.map(np.testing.assert_array_equal, found, fit_metering(gains, taken))


@pytest.mark.filterwarnings("error")
def test_photographs_of_which_none_shows_anything_say_nothing_of_a_choice():
    gains, taken, contents = camera_that_meters(-0.8)
    metering = fit_metering(gains, [(jnp.zeros_like(rgb), weight) for rgb, weight in taken])
    image = jnp.asarray(contents[0], jnp.float32)
    np.testing.assert_array_equal(predict_gain(metering, image, taken[0][1]), 1)


@pytest.mark.filterwarnings("error")
def test_one_photograph_says_nothing_of_a_choice():
    gains, taken, _ = camera_that_meters(-0.8)
    np.testing.assert_array_equal(fit_metering(gains[:1], taken[:1]).slopes, [0, 0])


def test_a_choice_that_has_nothing_to_do_with_the_view_is_not_predicted():
    gains, taken, contents = camera_that_meters(0.0, count=60, noise=0.2)
    # As taken, bright photographs show bright gains: the content is what they show without them.
    metering = fit_metering(gains, taken)
    np.testing.assert_array_equal(metering.slopes, 0)
    image = jnp.asarray(contents[0], jnp.float32)
    np.testing.assert_array_equal(predict_gain(metering, image, taken[0][1]), 1)
    metering = metering.replace(slopes=jnp.array([-1.0, -1.0]))
    np.testing.assert_array_equal(predict_gain(metering, image, jnp.zeros((12, 16))), 1)


def test_photographs_of_a_curve_are_straightened_and_taken_again(plain):
    """The camera encodes light by a cube root; another one in the same capture by sRGB."""
    views, _ = plain
    curve = jnp.linspace(0, 1, 256) ** 3
    log_gains = jnp.asarray(known_gains(1.0), jnp.float32)
    curves = stack_curves({"film": curve}, ["film", "other"] * (VIEWS // 2))
    pyramid = photograph_pyramid(views)
    taken = jnp.asarray(as_bytes(np.asarray(views.rgb)))
    middle = at_middle_exposure(views.replace(rgb=taken), log_gains, curves)
    colors = np.asarray(taken, np.float64)
    light = np.where(colors < 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    light[::2] = colors[::2] ** 3
    light *= np.exp(-np.asarray(log_gains, np.float64))[:, None, None]
    expected = np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(middle.rgb, expected, atol=1e-3)
    shown = dataclasses.replace(pyramid, gains=jnp.exp(log_gains), curves=curves)
    for view in (2, 3):
        np.testing.assert_allclose(shown.image(view, 0)[..., :3], middle.rgb[view], atol=3e-3)
        how = Taken(jnp.exp(log_gains[view]), curves[view])
        np.testing.assert_allclose(take(middle.rgb[view], how), taken[view], atol=5e-3)


def test_windows_show_photographs_at_the_middle_exposure(plain):
    views, _ = plain
    plain_pyramid = photograph_pyramid(views)
    log_gains = jnp.asarray(known_gains(1.0), jnp.float32)
    pyramid = dataclasses.replace(plain_pyramid, gains=jnp.exp(log_gains))
    windows = photograph_windows(views.cameras, pyramid, whole_share=1.0)
    bytes_of = np.asarray(plain_pyramid.image(2, 0))
    expected = taken_with(bytes_of[..., :3] / 255, -log_gains[2])
    window = cut_window(windows, 2, 0, jnp.zeros(2, jnp.int32))
    np.testing.assert_allclose(window.rgb, expected, rtol=1e-4)
    np.testing.assert_array_equal(window.weight, 1)
    np.testing.assert_allclose(pyramid.image(2, 0)[..., :3], expected, rtol=1e-4)
    middle = at_middle_exposure(
        views.replace(rgb=jnp.asarray(bytes_of[None, ..., :3])), log_gains[2:3]
    )
    np.testing.assert_allclose(middle.rgb[0], expected, rtol=1e-4)
