"""Depth by stereo in a run: what training begins with, on walls drawn by ray casting."""

import dataclasses
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest
import textured_corner
from PIL.ExifTags import IFD, Base
from textured_corner import SMALL_LENS, corner_views

from jaxcloseup.app.methods.method import StereoTraining
from jaxcloseup.app.run import measured_exposures
from jaxcloseup.app.run.measured_exposures import (
    NAME,
    held_out_gains,
    measure_exposures,
    read_exposures,
    stated_exposures,
    write_exposures,
)
from jaxcloseup.app.run.stereo_depths import draw_points, match_photographs, matched_divisor
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.native import library
from jaxcloseup.photos.exposures import at_middle_exposure
from jaxcloseup.photos.light import change_exposure, to_light
from jaxcloseup.photos.pyramids import photograph_pyramid
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.stated_exposures import fit_cameras
from jaxcloseup.photos.views import Views
from jaxcloseup.stereo import StereoConfig


MATCHING = StereoConfig(neighbors=4, best=2, levels=2, sweep=24, iterations=(3, 2))
pytestmark = pytest.mark.skipif(
    not library.available(), reason="there is no native library, and loops take minutes"
)


def scene_of(views, **metadata):
    none = np.zeros((0, 3), np.float32)
    names = {"train": [str(view) for view in range(len(views))]}
    return Scene("corner", views, None, None, none, none, 2.5, 6.0, names, metadata)


@pytest.fixture(scope="module")
def stereo():
    views, _ = corner_views()
    pyramid = photograph_pyramid(views)
    return match_photographs(scene_of(views), pyramid, StereoTraining(), MATCHING)


def test_training_begins_with_points_on_the_walls(stereo):
    points, colors = draw_points(stereo, 500)
    assert points.shape == colors.shape == (500, 3)
    away = np.abs(points @ textured_corner.WALLS.T - textured_corner.OFFSETS)
    away = (away / np.linalg.norm(textured_corner.WALLS, axis=1)).min(axis=1)
    assert np.median(away) < 0.005  # some 4 away
    assert np.mean(away < 0.04) > 0.9
    # A point has the color of the photographs that show it.
    for view, pose in enumerate(np.asarray(stereo.views.cameras.camtoworld)):
        x, y, z = ((points - pose[:, 3]) @ pose[:, :3]).T
        fx, fy, cx, cy = SMALL_LENS
        column, row = x / z * fx + cx, y / z * fy + cy
        inside = (column > 0) & (row > 0) & (column < 72) & (row < 54)
        seen = np.asarray(stereo.views.rgb[view])[
            row[inside].astype(int), column[inside].astype(int)
        ]
        assert np.median(np.abs(seen - 255 * colors[inside])) < 15


def test_depth_counts_where_it_is_confident(stereo):
    sources, confidence = stereo.sources, stereo.maps.confidence
    np.testing.assert_array_equal(sources.trust, confidence)
    np.testing.assert_array_equal(sources.inverse_depth > 0, confidence > 0)
    known = np.asarray(confidence) > 0
    depth = 1 / np.asarray(sources.inverse_depth)[known]
    np.testing.assert_allclose(depth, stereo.maps.depth[known], rtol=1e-6)
    assert jnp.mean(confidence > 0) > 0.5


@pytest.fixture(scope="module")
def log_gains(stereo):
    """Exposures up to two stops apart, and tints, 0 on average."""
    rng = np.random.default_rng(0)
    count = len(stereo.views)
    gains = rng.uniform(-0.7, 0.7, (count, 1)) + 0.05 * rng.standard_normal((count, 3))
    return gains - gains.mean(0)


@pytest.fixture(scope="module")
def taken(stereo, log_gains):
    """The same as taken with these exposures."""
    gains = jnp.exp(jnp.asarray(log_gains, jnp.float32))[:, None, None]
    light = change_exposure(0.5 * stereo.views.rgb.astype(jnp.float32) / 255, gains)
    rgb = jnp.round(255 * jnp.clip(light, 0, 1)).astype(jnp.uint8)
    return stereo._replace(views=stereo.views.replace(rgb=rgb))


@pytest.fixture(scope="module")
def exposures(taken):
    return measure_exposures(taken, scene_of(taken.views))


def test_known_exposures_are_recovered(exposures, log_gains):
    assert np.ptp(log_gains.mean(1)) > 0.9
    np.testing.assert_allclose(exposures.log_gains, log_gains, atol=0.02)


def test_masks_do_not_move_the_middle_that_a_camera_meters(taken, monkeypatch):
    """The first photograph is padded at its right and bottom, and all are masked there."""
    given = []

    def spy(log_gains, images):
        given.append(images)
        return fit(log_gains, images)

    fit = measured_exposures.fit_metering
    monkeypatch.setattr(measured_exposures, "fit_metering", spy)
    height, width = taken.views.weight.shape[1:]
    sizes = [(width - 8, height - 6), *[(width, height)] * (len(taken.views) - 1)]
    weight = taken.views.weight.at[:, :, 50:].set(0).at[:, 40:].set(0)
    masked = taken.views.replace(weight=weight)
    half = masked.replace(cameras=masked.cameras.replace(height=height // 2, width=width // 2))
    for scene in (
        scene_of(masked, sizes={"train": sizes}),
        # Training reads photographs of half the size.
        scene_of(half, sizes={"train": [(w // 2, h // 2) for w, h in sizes]}),
    ):
        assert measure_exposures(taken._replace(views=masked), scene)
        assert [weight.shape[::-1] for _, weight in given.pop()] == sizes


def test_photographs_of_one_exposure_stay_as_they_are(stereo):
    assert measure_exposures(stereo, scene_of(stereo.views)) is None


def test_a_camera_s_curve_is_recovered_with_its_exposures(stereo, log_gains):
    """Straightened photographs show the scene within 2 %, up to a power of its light."""
    light = to_light(stereo.views.rgb.astype(jnp.float32) / 255) * 0.5 + 0.01
    gained = light * jnp.exp(jnp.asarray(log_gains, jnp.float32))[:, None, None]
    colors = 0.55 + 0.25 * jnp.log10(gained)  # as cameras write video that is to be graded
    taken = jnp.round(255 * jnp.clip(colors, 0, 1)).astype(jnp.uint8)
    views = stereo.views.replace(rgb=taken)
    scene = scene_of(views)
    found = measure_exposures(stereo._replace(views=views), scene)
    curves = found.train_curves(scene.names["train"])
    middle = to_light(at_middle_exposure(views, found.log_gains, curves).rgb)
    counts = (stereo.maps.confidence > 0) & (taken > 12).all(-1) & (taken < 243).all(-1)
    x, y = (np.log(np.asarray(image)[np.asarray(counts)].ravel()) for image in (middle, light))
    design = np.stack([x, np.ones_like(x)], 1)
    error = np.abs(design @ np.linalg.lstsq(design, y, rcond=None)[0] - y)
    assert np.median(error) < 0.02
    straight = dataclasses.replace(found, curves={}, cameras={})
    assert straight.train_curves(scene.names["train"]) is None


def test_held_out_photographs_get_the_exposure_of_their_files(tmp_path):
    """Time and sensitivity explain the gains of the others, up to one factor of the camera."""

    def write(name, seconds):
        exif = PIL.Image.Exif()
        exif.get_ifd(IFD.Exif).update({Base.ExposureTime: seconds, Base.ISOSpeedRatings: 100})
        PIL.Image.new("RGB", (8, 8)).save(tmp_path / name, exif=exif)
        return tmp_path / name

    seconds = [0.01, 0.02, 0.04, 0.05]
    files = {"train": [write(f"{i}.jpg", time) for i, time in enumerate(seconds)]}
    PIL.Image.new("RGB", (8, 8)).save(tmp_path / "without.jpg")
    files["test"] = [write("far.jpg", 0.08), tmp_path / "without.jpg"]
    names = {split: [path.stem for path in paths] for split, paths in files.items()}
    scene = SimpleNamespace(metadata={"files": files}, names=names)
    gains = np.log(seconds)[:, None] + [0.1, 0.0, -0.1]
    gains -= gains.mean(0)
    stated = stated_exposures(scene)
    found = held_out_gains(scene, stated, fit_cameras(gains, stated["train"]))
    assert found.keys() == {"test"} and found["test"].keys() == {"far"}
    expected = gains[0] + np.log(8)
    np.testing.assert_allclose(found["test"]["far"], expected, atol=1e-3)


def test_exposures_are_kept(exposures, tmp_path):
    names = [str(view) for view in range(len(exposures.log_gains))]
    exposures = exposures.replace(
        stated={"test": {"near": jnp.array([0.1, 0.2, 0.3])}},
        curves={"film": jnp.linspace(0, 1, 256) ** 3},
        cameras={"train": dict.fromkeys(names, "film"), "test": {"near": ""}},
    )
    write_exposures(tmp_path, None, names)
    assert read_exposures(tmp_path, names) is None
    write_exposures(tmp_path, exposures, names)
    jax.tree.map(np.testing.assert_array_equal, read_exposures(tmp_path, names), exposures)
    kept = json.loads((tmp_path / NAME).read_text())
    short = {**kept, "curves": {"film": [0.0, 1.0]}}
    wrong = [
        json.dumps({**kept, "cameras": None}),
        json.dumps({**kept, "curves": {}}),
        json.dumps(short),
    ]
    for damage in ("{}", "[", '{"log_gains": {}, "metering": {}}', *wrong):
        (tmp_path / NAME).write_text(damage)
        with pytest.raises(ValueError, match="does not hold the exposures of these photographs"):
            read_exposures(tmp_path, names)


@pytest.mark.parametrize("times", [0.1, 1.2, 3.0, 5.0, 1e3])
def test_photographs_are_drawn_at_the_size_that_is_matched(times):
    """The witness makes the whole pyramid and asks it for its level."""

    def blank(width, height):
        camera = Camera(jnp.zeros((2, 3, 4)), jnp.ones((2, 4)), height, width)
        return Views(camera, np.zeros((2, height, width, 3), np.uint8), np.ones((2, height, width)))

    small, budget = blank(24, 18), StereoTraining(pixels=int(times * 2 * 24 * 18))
    wanted = 24 * max(1, times) ** 0.5
    for reduced in (1, 2, 3, 4, 5, 8):
        for finest in range(1, reduced):
            whole = blank(24 * reduced // finest, 18 * reduced // finest)
            pyramid = photograph_pyramid(whole, small)
            expected = pyramid.sizes[pyramid.level_near(wanted)][1]
            scene = SimpleNamespace(train=small, metadata={"downscale": reduced})
            divisor = matched_divisor(scene, budget, finest)
            assert expected == pytest.approx(24 * reduced / divisor, abs=1), (reduced, finest)
