"""What a run measures: scores of renders, and how far labels are to be trusted."""

import json

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest

from jaxcloseup.app.methods.surfels import REDUCED
from jaxcloseup.app.run.gate import AGREEMENT, gated, verdict, weigh_labels
from jaxcloseup.app.score.footprints import blur_to_footprint
from jaxcloseup.app.score.scores import score, score_image, summarize
from jaxcloseup.app.score.targets import Target
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.io.files import write_json
from jaxcloseup.labels.config import pseudo_settings
from jaxcloseup.labels.make import label_sources


@pytest.mark.parametrize("off", [1.0, 1.02, 1.3])
def test_labels_weigh_what_they_deserve(off):
    """With exact depth labels are right; the further depth is off, the fewer of them agree."""
    positions = (-0.6, -0.2, 0.2, 0.6)
    cameras = [plane.camera_above(x, 0.1 * x, 3.0, tilt=0.1 * x) for x in positions]
    views, depths = plane.make_views(cameras)

    def render(camera):
        rgb, depth, _ = plane.photograph(camera)
        depth = jnp.asarray(off * depth, jnp.float32)
        return Rendering(jnp.full(rgb.shape, 0.5), depth, jnp.ones(depth.shape))

    settings = pseudo_settings(REDUCED.labels)
    found = weigh_labels(label_sources(views, off * depths), render, settings)
    changed = gated(REDUCED.labels, found)
    low, high = AGREEMENT
    expected = np.clip((found["agreement"] - low) / (high - low), 0, 1)
    assert found["weight"] == pytest.approx(expected)
    assert changed.label_loss_weight == pytest.approx(expected * settings.label_loss_weight)
    changed = changed.replace(label_loss_weight=settings.label_loss_weight)
    jax.tree.map(np.testing.assert_array_equal, changed, settings)
    assert found["agreement"] == found["left_out"][0]["coverage"]
    assert found["left_out"][-1]["model_psnr"] < 15
    if off == 1.0:
        assert found["left_out"][-1]["label_psnr"] > 30
        assert found["weight"] > 0
    if off == 1.3:
        assert found["weight"] == 0
    assert ("labels are not used" in verdict(found)) == (found["weight"] == 0)


def test_numbers_that_are_not_finite_become_null(tmp_path):
    write_json(tmp_path / "results.json", {"a": [float("nan"), 1.5], "b": {"c": float("inf")}})
    text = (tmp_path / "results.json").read_text()
    assert json.loads(text) == {"a": [None, 1.5], "b": {"c": None}}


def test_a_perfect_render_has_no_psnr_but_a_reason():
    rgb = jnp.full((16, 16, 3), 0.5)
    ones = jnp.ones((16, 16))
    result = score(Rendering(rgb, ones, ones), Target("0", None, rgb, ones, ones * 3))
    assert result["psnr"] is None
    assert result["psnr_reason"] == "equals the truth"
    assert result["ssim"] == pytest.approx(1)


def test_scores_ignore_padding_and_say_what_is_missing():
    rgb = jax.random.uniform(jax.random.key(0), (24, 32, 3))
    weight = jnp.ones((24, 32)).at[:, 20:].set(0)
    spoilt = jnp.where(weight[..., None] > 0, rgb, 1 - rgb)
    seen = jnp.zeros((24, 32), jnp.int32).at[:, :5].set(2)
    target = Target("0", None, rgb, weight, seen)
    noisy = jnp.clip(spoilt + 0.1, 0, 1)
    result = score(Rendering(noisy, seen, seen), target)
    expected = cv2.PSNR(*(np.asarray(x[:, :20] * 255).round() for x in (noisy, rgb)), 255)
    np.testing.assert_allclose(result["psnr"], expected, atol=1e-3)
    assert result["coverage_seen1"] == pytest.approx(0.25)
    assert result["psnr_seen3"] is None
    assert result["psnr_seen3_reason"]
    summary = summarize({"0": result})
    assert summary["psnr_seen3"] is None
    assert summary["psnr_seen3_reason"] == result["psnr_seen3_reason"]


def test_a_view_without_counted_pixels_says_nothing_of_what_is_resolved():
    rng = np.random.default_rng(0)
    truth = jnp.asarray(rng.uniform(size=(64, 64, 3)), jnp.float32)
    counts = jnp.ones((64, 64))
    seen = score_image(0.9 * truth, truth, counts)
    masked = score_image(0.9 * truth, truth, 0 * counts)
    assert masked["resolves"] is None and "no pixel" in masked["resolves_reason"]
    assert seen["resolves"] == summarize({"0": seen, "1": masked})["resolves"] == 2
    # Where one view of many resolves something, their mean may not.
    blank = score_image(jnp.full_like(truth, 0.5), truth, counts)
    summary = summarize({"0": seen} | {str(i): blank for i in range(1, 20)})
    assert summary["resolves"] is None and "no period" in summary["resolves_reason"]


@pytest.mark.parametrize("footprint", [2.0, 5.0])
def test_blur_has_the_variance_of_the_source_pixel(footprint):
    image = np.zeros((61, 61, 3), np.float32)
    image[30, 30] = 1
    blurred = blur_to_footprint(image, np.full((61, 61), footprint))[..., 0]
    offset = np.arange(61) - 30
    assert blurred.sum() == pytest.approx(1, abs=1e-3)
    variance = (blurred.sum(axis=0) * offset**2).sum()
    # A box of the pixel's width and a tent of twice that, less the image's own pixel.
    expected = footprint**2 / 12 + footprint**2 / 6 - 1 / 12
    assert variance == pytest.approx(expected, rel=0.15)
