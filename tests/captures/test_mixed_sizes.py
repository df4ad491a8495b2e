"""A capture of photographs along and across: pictures have their own size, without padding."""

from types import SimpleNamespace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_capture import frame, write_image, write_json

from jaxcloseup.app.report.pictures import comparisons
from jaxcloseup.app.score.folders import evaluate_folders
from jaxcloseup.app.score.renders import write_renders, write_truth
from jaxcloseup.app.score.scores import NO_PERCEPTUAL, evaluate
from jaxcloseup.app.score.targets import targets_by_split
from jaxcloseup.app.view import frames
from jaxcloseup.app.view.camera_paths import orbit, resized_shots, view_shots
from jaxcloseup.captures.load import load_scene
from jaxcloseup.detail.residuals import make_detail, render_residuals
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.labels.target_views import render_depths
from jaxcloseup.photos.pyramids import scene_pyramid
from jaxcloseup.photos.views import unpadded
from jaxcloseup.photos.windows import photograph_windows, sample_window, sample_window_pixels


ALONG, ACROSS = (32, 24), (24, 32)  # width, height
SIZES = {"a": ALONG, "b": ACROSS}


def write_capture(folder, sizes):
    """Write photographs of random pixels, twice as large as the sizes of each split."""
    rng = np.random.default_rng(0)
    for split, named in sizes.items():
        for name, (width, height) in named.items():
            pixels = rng.integers(0, 256, (2 * height, 2 * width, 3), np.uint8)
            write_image(folder / split / f"{name}.png", pixels)
        lens = {name: {"w": 2 * w, "h": 2 * h, "cx": w, "cy": h} for name, (w, h) in named.items()}
        listed = [frame(f"{split}/{name}.png", **lens[name]) for name in named]
        write_json(folder / f"transforms_{split}.json", listed)
    return load_scene(folder, downscale=2)


@pytest.fixture
def scene(tmp_path):
    """Two photographs of a split, along and across."""
    return write_capture(tmp_path, {"train": SIZES, "test": SIZES})


def render(camera, taken=None):
    """White where a photograph is, and black in the padding."""
    side = camera.height, camera.width
    width, height = (round(2 * float(center)) for center in camera.intrinsics[2:])
    rgb = jnp.zeros((*side, 3)).at[:height, :width].set(1)
    return Rendering(rgb, 2 * jnp.ones(side), jnp.ones(side), aux=(jnp.ones(7),))


def picture(path):
    image = cv2.imread(str(path))
    return image, image.shape[1::-1]


def test_larger_held_out_photographs_pad_no_training_photograph(tmp_path):
    """Where a capture's only photograph across is held out, detail has the size of the others."""
    scene = write_capture(tmp_path, {"train": {"a": ALONG, "b": ALONG}, "test": {"c": ACROSS}})
    assert scene.train.weight.shape[1:] == (24, 32) and scene.test.weight.shape[1:] == (32, 24)
    found = make_detail(render, scene.train, scene_pyramid(scene)[0], None)
    assert found.sources.trust.shape == (2, 48, 64)


def test_padding_is_neither_scored_nor_written(scene, tmp_path):
    assert scene.train.rgb.shape[1:3] == (32, 32)
    assert scene.camera("test", 1).width == 24 and scene.sizes("train") == [ALONG, ACROSS]
    targets = targets_by_split(scene, jnp.ones((2, 32, 32)), None, render, divisor=1)
    scores, seen = evaluate(render, targets["test_reduced"])
    write_truth(tmp_path / "truth", targets)
    write_renders(tmp_path / "renders", seen, scene)
    for name, size in SIZES.items():
        for folder in ("renders/rgb", "renders/depth", "truth/test_reduced/rgb"):
            assert picture(tmp_path / folder / f"{name}.png")[1] == size
        assert picture(tmp_path / "truth" / "test" / "rgb" / f"{name}.png")[1] == (
            2 * size[0],
            2 * size[1],
        )
        assert picture(tmp_path / "renders/rgb" / f"{name}.png")[0].all()
    folders = str(tmp_path / "renders" / "rgb"), str(tmp_path / "truth" / "test_reduced" / "rgb")
    again = evaluate_folders(*folders, None, NO_PERCEPTUAL)
    assert again["psnr"] == pytest.approx(scores["psnr"], abs=1e-4)

    images = {("baseline", "test"): {name: one.rgb for name, one in seen.items()}}
    (along, across) = comparisons(tmp_path / "compare", {"test": targets["test_reduced"]}, images)
    assert along.image.shape[0] < across.image.shape[0]


def test_views_are_rendered_at_the_size_of_their_files(scene, tmp_path):
    programs = SimpleNamespace(
        exposures=None, scene=scene, render=lambda state, camera: render(camera)
    )
    frames.render_shots(tmp_path, programs, None, view_shots(scene, "test"), sources=None)
    for name, size in SIZES.items():
        for kind in ("rgb", "depth"):
            image, found = picture(tmp_path / kind / f"{name}.png")
            assert found == tuple(2 * side for side in size) and image.all(axis=-1).all()
    halves = resized_shots(view_shots(scene, "test"), None, None, 0.5)
    assert halves.sizes == [ALONG, ACROSS]
    np.testing.assert_allclose(halves.cameras.intrinsics, scene.test.cameras.intrinsics, rtol=1e-6)


def test_an_orbit_has_the_size_of_the_first_photograph(scene):
    cameras = orbit(scene, 2).cameras
    assert (cameras.width, cameras.height) == (64, 48)


def test_nothing_is_computed_on_padding(scene, key):
    """Depths, residuals and windows of the training photographs cost the sum of their pixels.

    So does what is kept of them, but for the small depth maps.
    """
    counted = []

    def count(camera, *_):
        counted.append(camera.height * camera.width)
        return render(camera)

    own = ALONG[0] * ALONG[1] + ACROSS[0] * ACROSS[1]
    depths = render_depths(count, scene.train.cameras, far=9, sizes=scene.sizes("train"))
    assert sum(counted) == own
    np.testing.assert_array_equal(np.asarray(depths) > 0, np.asarray(scene.train.weight) > 0)

    counted.clear()
    pyramid, divisor = scene_pyramid(scene)
    assert divisor == 1 and pyramid.sizes == ((64, 64), (32, 32))
    found = render_residuals(count, scene.train.cameras, pyramid, near=0.0, far=9.0)
    assert sum(counted) == 5 * own
    assert pyramid.values.nbytes == 4 * 5 * own and found.shown.values.nbytes == 6 * 5 * own
    kept = scene.photographs_at(1), unpadded(scene.train, scene.sizes("train"))
    for level, view in np.ndindex(2, 2):
        photograph = kept[level][view].rgb
        np.testing.assert_array_equal(pyramid.image(view, level)[..., :3], photograph)
        assert found.shown.image(view, level).shape == (*photograph.shape[:2], 6)

    windows = photograph_windows(scene.train.cameras, pyramid, whole_share=0.5)
    assert windows.size == (24, 24)  # what both have in common
    drawn = jax.jit(jax.vmap(lambda key: sample_window(key, windows)))(jax.random.split(key, 500))
    assert np.asarray(drawn.weight).min() == 1
    center = np.asarray(drawn.cameras.intrinsics)[:, 2:]
    assert np.ptp(center, axis=0).min() > 24  # windows lie in several places
    pixels = sample_window_pixels(key, windows, 500)
    assert np.asarray(pixels.weight).min() == 1
