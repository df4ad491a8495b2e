"""Scoring folders of images: pairs by name, and one sentence for each mismatch."""

import json
import math

import cv2
import numpy as np
import pytest
from absl import flags
from absl.testing import flagsaver

from jaxcloseup.app.cli import evaluate as program
from jaxcloseup.app.score.folders import evaluate_folders
from jaxcloseup.app.score.scores import NO_PERCEPTUAL


@pytest.fixture(autouse=True)
def _flags():
    flags.FLAGS(["evaluate"])
    with flagsaver.flagsaver(compilation_cache=""):
        yield


def write_images(folder, images):
    folder.mkdir()
    for name, image in images.items():
        cv2.imwrite(str(folder / name), image)
    return str(folder)


@pytest.fixture
def pair(tmp_path):
    """Write two renders, of which one is off by 51 in its upper half, and the true images."""
    truth = np.random.default_rng(0).integers(0, 200, (16, 24, 3), np.uint8)
    off = truth.copy()
    off[:8] += 51
    renders = write_images(tmp_path / "renders", {"a.png": off, "b.png": truth})
    return renders, write_images(tmp_path / "truth", {"a.bmp": truth, "b.png": truth})


def test_metrics_of_known_images(pair, tmp_path):
    output = tmp_path / "metrics.json"
    with flagsaver.flagsaver(renders=pair[0], truth=pair[1], output=str(output), masks=None):
        program.main(["evaluate"])
    found = json.loads(output.read_text())
    # Half of the pixels are off by 0.2: the mean squared error is 0.02.
    assert found["views"]["a"]["psnr"] == pytest.approx(-10 * math.log10(0.02), abs=1e-4)
    assert found["psnr"] == found["views"]["a"]["psnr"]
    assert found["views"]["b"]["psnr"] is None
    assert found["views"]["b"]["psnr_reason"] == "equals the truth"
    assert found["views"]["b"]["ssim"] == pytest.approx(1)
    assert found["lpips_vgg"] is None
    assert found["lpips_vgg_reason"]


def test_masks_choose_the_pixels_that_count(pair, tmp_path):
    lower = np.zeros((16, 24), np.uint8)
    lower[8:] = 255
    upper = 255 - lower
    masks = write_images(tmp_path / "masks", {"a.png": upper, "b.png": lower})
    found = evaluate_folders(*pair, masks, NO_PERCEPTUAL)
    assert found["views"]["a"]["psnr"] == pytest.approx(-10 * math.log10(0.04), abs=1e-4)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"renders": None}, "--renders= is not a folder"),
        ({"truth": "nowhere"}, "--truth=nowhere is not a folder"),
        ({"only": "b"}, r"has no image named a, but --truth=.* has"),
        ({"more": "c.png"}, r"--truth=.* has no image named c, but --renders="),
        ({"more": "a.jpg"}, "two images with the same name, a.jpg and a.png"),
        ({"size": (8, 8)}, r"a\.png has 8 x 8 pixels but .*a\.bmp has 24 x 16"),
        ({"broken": True}, r"a\.png is not a readable image"),
        ({"output": True}, "already exists"),
    ],
)
def test_a_mismatch_exits_with_one_sentence(pair, tmp_path, change, sentence):
    folder, output = tmp_path / "renders", tmp_path / "metrics.json"
    if "only" in change:
        (folder / "a.png").unlink()
    if "more" in change:
        cv2.imwrite(str(folder / change["more"]), np.zeros((16, 24, 3), np.uint8))
    if "size" in change:
        cv2.imwrite(str(folder / "a.png"), np.zeros((*change["size"], 3), np.uint8))
    if "broken" in change:
        (folder / "a.png").write_bytes((folder / "a.png").read_bytes()[:40])
    if "output" in change:
        output.write_text("{}")
    given = dict(zip(("renders", "truth"), pair, strict=True))
    given |= {key: value for key, value in change.items() if key in given}
    with (
        flagsaver.flagsaver(output=str(output), masks=None, **given),
        pytest.raises(SystemExit, match=sentence),
    ):
        program.main(["evaluate"])
    assert output.exists() == ("output" in change)  # nothing half-written
