"""Detail of close-ups that photographs resolve, and error curves of labels, on known cases."""

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from tiny_runs import TINY

from jaxcloseup.app.score.audit import audit_labels, error_curve, left_out_curve
from jaxcloseup.app.score.footprints import resolved_by_photographs
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import pixel_grid
from jaxcloseup.labels.config import pseudo_settings
from jaxcloseup.labels.make import label_sources


@pytest.mark.parametrize("heights", [(4.0,), (4.0, 2.0), (2.0, 4.0)])
def test_stripes_have_the_contrast_of_the_nearest_photograph(heights):
    scene, depths = plane.make_scene([plane.camera_above(0.0, 0.0, height) for height in heights])
    close = plane.camera_above(0.1, 0.0, 1.0)
    resolved, seen = resolved_by_photographs(scene, close, depths)
    assert seen.all()
    # The blur's standard deviation is half a source pixel, less the close-up's own pixel.
    pixel = min(heights) / plane.FOCAL
    variance = pixel**2 / 4 - (1 / plane.FOCAL) ** 2 / 12
    expected = np.exp(-2 * np.pi**2 * variance / plane.STRIPES**2)
    inner = resolved[6:-6, 6:-6] - 0.5
    assert np.abs(inner).max() / 0.4 == pytest.approx(expected, rel=0.1)


def test_unseen_pixels_are_not_resolved():
    scene, depths = plane.make_scene([plane.camera_above(1.0, 0.0, 1.0)])
    close = plane.camera_above(0.0, 0.0, 1.0)
    _, seen = resolved_by_photographs(scene, close, depths)
    # The photograph is 1 unit, or 30 pixels, to the right.
    x = np.asarray(pixel_grid(plane.HEIGHT, plane.WIDTH))[..., 0]
    np.testing.assert_array_equal(seen, x > 30)


def test_error_curves_of_a_perfect_and_of_a_random_score():
    error = np.linspace(0, 1, 20_001)
    mixed = np.random.default_rng(0).permutation(error)
    knows = error_curve(error, error, 40_002)
    assert knows["ause"] == pytest.approx(0, abs=1e-9)
    assert knows["error"] == knows["oracle"]
    # Errors are uniform on [0, 1]: the mean of the best share f is f / 2.
    np.testing.assert_allclose(knows["error"], np.arange(1, 21) / 40, atol=1e-4)
    assert knows["coverage"][-1] == 0.5
    blind = error_curve(mixed, error, 40_002)
    np.testing.assert_allclose(blind["error"], 0.5, atol=0.02)
    # The area between 1 / 2 and f / 2 from f = 1 / 20 on, divided by the mean error.
    assert blind["ause"] == pytest.approx(0.5, abs=0.02)
    # A perfect score, with a tenth of leaked labels, which come last.
    leaks = error_curve(error, error, 20_001, {"leaked": error > 0.9})
    np.testing.assert_allclose(leaks["leaked"][:18], 0, atol=1e-9)
    assert leaks["leaked"][-1] == pytest.approx(0.1, abs=1e-3)
    assert error_curve(np.zeros(0), np.zeros(0), 10) is None


def test_labels_from_exact_depth_are_sorted_and_never_leak():
    cameras = [plane.camera_above(x, 0.1 * x, 4.0, tilt=0.1 * x) for x in (-1.0, 0.0, 1.0)]
    scene, depths = plane.make_scene(cameras)
    sources = label_sources(scene.train, depths)
    options = {"render_depth": lambda camera: plane.surface(camera).depth, "count": 3}
    strict = settings().replace(rgb_tolerance=jnp.float32(0.02))
    masked = audit_labels(jax.random.key(0), depths, scene, sources, strict, **options)
    no_mask = strict.replace(use_mask=jnp.float32(0))
    whole = audit_labels(jax.random.key(0), depths, scene, sources, no_mask, **options)
    # Without a mask, every pixel that the source sees is kept; the curve does not use the mask.
    assert masked["kept"] < 0.5 < whole["kept"] == 1
    curve = masked["curve"]
    assert curve == whole["curve"]
    assert curve["leaked"] == [0.0] * 20
    assert 0.05 < curve["coverage"][-1] < 1
    assert all(np.less_equal(curve["oracle"], np.add(curve["error"], 1e-9)))


def test_left_out_photographs_measure_labels_and_model():
    cameras = [plane.camera_above(x, 0.1 * x, 4.0, tilt=0.1 * x) for x in (-1.0, 0.0, 1.0)]
    views, depths = plane.make_views(cameras)

    def render(camera):  # a model with exact depth and colors off by 0.1
        rgb, depth, _ = plane.photograph(camera)
        rgb, depth = (jnp.asarray(a, jnp.float32) for a in (rgb - 0.1, depth))
        return Rendering(rgb, depth, jnp.ones_like(depth))

    curve = left_out_curve(label_sources(views, depths), render, settings())
    np.testing.assert_allclose(curve["model"], 0.1, atol=5e-3)
    assert max(curve["error"]) < 0.02
    assert 0.3 < curve["coverage"][-1] <= 1


def settings():
    return pseudo_settings(TINY.labels).replace(leave_out_source=jnp.float32(0))
