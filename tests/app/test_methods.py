"""Methods: what presets make of a scene, and that a new method needs its own module alone."""

import dataclasses
import json
import pathlib
import shutil
import subprocess
import sys

import chex
import constant_color
import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from absl import flags
from absl.testing import flagsaver
from tiny_runs import TINY, TINY_MIP, TINY_SURFELS

from jaxcloseup.app import methods
from jaxcloseup.app.cli import render, run, sweep
from jaxcloseup.app.methods import registry
from jaxcloseup.app.methods.method import WindowConfig
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import with_settings
from jaxcloseup.app.methods.shared import splat_training
from jaxcloseup.app.methods.shared.splat_training import extent, make_field
from jaxcloseup.app.run.keys import run_keys
from jaxcloseup.app.run.labels import start_labels
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.states import (
    FEWEST_POINTS,
    initial_points,
    initial_state,
    say_which_points_fit,
    state_shapes,
)
from jaxcloseup.artifacts.surfel_ply import read_surfels, write_surfels
from jaxcloseup.captures.load import load_scene
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.fields.splats.adaptive import with_image_offset
from jaxcloseup.fields.splats.filters import SMOOTHING_VARIANCE, sampling_intervals, smoothed
from jaxcloseup.fields.splats.spherical_harmonics import sh_to_rgb
from jaxcloseup.geometry.cameras import points_to_pixels
from jaxcloseup.photos.pyramids import scene_pyramid
from jaxcloseup.photos.views import camera_at
from jaxcloseup.training.state import TrainState


ROOT = pathlib.Path(__file__).parents[2]


@pytest.fixture
def scene(capture_folder):
    return load_scene(str(capture_folder))


def moved(scene, change):
    """The scene with other positions `[V, 3]` of its cameras."""
    cameras = scene.train.cameras
    poses = cameras.camtoworld.at[..., 3].set(change(cameras.position))
    return dataclasses.replace(
        scene, train=scene.train.replace(cameras=cameras.replace(camtoworld=poses))
    )


def test_means_learn_for_all_of_stage_1():
    """A preset that became longer once left three quarters of its steps at their last rate."""
    presets = [preset for method in METHODS.values() for preset in method.presets.values()]
    stages = [(preset.field, preset.baseline_steps) for preset in presets]
    stages += [(preset.coarse.field, preset.coarse.steps) for preset in presets if preset.coarse]
    shares = [
        field.means_lr_steps / steps for field, steps in stages if hasattr(field, "means_lr_steps")
    ]
    assert len(shares) > 10 and min(shares) > 0.9 and max(shares) == 1


def test_cameras_in_one_place_have_the_size_of_what_they_see(scene):
    for place in np.random.default_rng(0).uniform(-3, 3, (8, 3)):
        here = moved(scene, lambda old, place=place: jnp.broadcast_to(place, old.shape))
        assert extent(here) == pytest.approx(0.5 * scene.far)
    own = 1.1 * np.hypot(1, 0.1)
    assert extent(scene) == pytest.approx(own * scene.placement.scale, rel=1e-3)


def test_the_released_rule_perturbs_virtual_views_and_no_photographs(scene, monkeypatch):
    train = dataclasses.replace(TINY.train, label_rule="released")
    programs = Programs(dataclasses.replace(TINY, train=train), scene)
    state, keys = initial_state(programs, run_keys(0)), []
    render = programs.render

    def recorded(state, camera, key=None):
        keys.append(key)
        return render(state, camera, key)

    monkeypatch.setattr(programs, "render", recorded)
    depths = start_labels(programs, state).sources.depths
    assert keys == [None] * len(depths)


def test_the_near_plane_is_small_in_a_small_scene(scene, monkeypatch):
    seen = []
    monkeypatch.setattr(splat_training, "surfel_field", lambda config, **_: seen.append(config))
    small = moved(scene, lambda old: 0.01 * old)
    for one in (scene, small, dataclasses.replace(small, far=0.01 * scene.far)):
        make_field(TINY_SURFELS.field, one, 1)
    near = [config.raster.near for config in seen]
    assert near[0] == TINY_SURFELS.field.raster.near
    assert near[1] == near[2] == pytest.approx(0.01 * 0.01 * extent(scene))


def test_the_smoothing_filter_is_that_of_the_finest_photographs(capture_folder, monkeypatch):
    scene, seen = load_scene(str(capture_folder), downscale=2), []
    middle = np.mean(scene.train.cameras.position, axis=0)

    def keep(config, *, extent, center, photographs):
        np.testing.assert_allclose(center, middle, atol=1e-6)
        seen.append(photographs)

    monkeypatch.setattr(splat_training, "surfel_field", keep)
    train, own = scene.train.cameras, plane.WIDTH
    for divisor, width in ((1, own), (2, own / 2), (8, own / 2)):
        make_field(dataclasses.replace(TINY_MIP.field, smoothed_at=divisor), scene, 1)
        assert seen[-1].width == width
        expected = width / train.width * train.intrinsics
        np.testing.assert_allclose(seen[-1].intrinsics, expected, rtol=1e-6)
    make_field(TINY_SURFELS.field, scene, 1)
    assert seen[-1] is None


def test_the_smoothing_filter_is_no_finer_than_what_steps_read(capture_folder):
    """Flags reduce photographs after the preset is made, and a short training reads no large ones.

    A step reads 6 x 8 pixels, of 5 photographs of 24 x 32.
    """
    scene = load_scene(str(capture_folder), downscale=4)
    for windows, steps, divisor in (
        (None, 20, 4),
        (WindowConfig(), 20, 2),
        (WindowConfig(), 80, 1),
    ):
        preset = dataclasses.replace(TINY_MIP, windows=windows, baseline_steps=steps)
        assert preset.field.smoothed_at == 1
        assert Programs(preset, scene).preset.field.smoothed_at == divisor
    assert Programs(TINY_SURFELS, scene).preset == TINY_SURFELS


def test_refinement_and_exports_keep_the_shapes_that_the_filter_made(capture_folder, tmp_path):
    """Splats of a coarse model have its filter in their scales, and beside them the finer one."""
    scene = load_scene(str(capture_folder), downscale=2)
    config = dataclasses.replace(TINY_MIP.field, smoothed_at=1, capacity=420, sh_degree=2)
    config = dataclasses.replace(config, depth="expected")
    # The coarse model may have other harmonics, and another depth.
    degrees = {"sh_degree": 1, "depth": "median"}
    coarse = dataclasses.replace(config, smoothed_at=2, capacity=100, **degrees)
    points = np.random.default_rng(0).uniform([-1, -1, -0.1], [1, 1, 0.1], (100, 3))
    points = jnp.asarray(scene.placement.to_scene(points), jnp.float32)
    params, buffers = make_field(coarse, scene, 1).init(jax.random.key(0), points, points)
    depth = jnp.full((plane.HEIGHT, plane.WIDTH), 4.0 * scene.placement.scale)
    gray = Rendering(jnp.full((*depth.shape, 3), 0.5), depth, jnp.ones_like(depth))
    pyramid, _ = scene_pyramid(scene)

    def render(shown, shown_buffers, camera):
        assert shown.means.shape in ((420, 3), (9000, 3)) and shown_buffers.alive.sum() == 100
        return gray

    finer, kept = METHODS["mip_gaussians"].refine(
        jax.random.key(1), config, params, buffers, render, scene, pyramid
    )
    added = SMOOTHING_VARIANCE * np.asarray(buffers.interval)[:, None] ** 2
    variances = (np.exp(2 * np.asarray(one.log_scales, float)) for one in (params, finer))
    before, after = variances
    np.testing.assert_allclose(after[:100], before + added, rtol=1e-4)
    np.testing.assert_allclose(kept.interval[:100], buffers.interval / 2, rtol=1e-5)
    assert kept.alive.all() and finer.log_scales.shape == (420, 3) and kept.expected == 1
    np.testing.assert_array_equal(finer.sh[:100, :4], params.sh)
    assert finer.sh.shape == (420, 9, 3) and not finer.sh[:100, 4:].any()
    write_surfels(tmp_path / "finer.ply", *METHODS["mip_gaussians"].splats(finer, kept))
    found = read_surfels(tmp_path / "finer.ply", num_scales=3)
    expected = smoothed(finer, kept.interval)
    np.testing.assert_allclose(found.log_scales, expected.log_scales, rtol=1e-6)
    np.testing.assert_allclose(found.opacity_logits, expected.opacity_logits, rtol=1e-5)
    assert np.all(found.opacity_logits < finer.opacity_logits)
    # Photographs fill no more rows than they resolve: one for 12 pixels of each at its own size.
    roomy = dataclasses.replace(config, capacity=9000)
    _, kept = METHODS["mip_gaussians"].refine(
        jax.random.key(1), roomy, params, buffers, render, scene, pyramid
    )
    assert kept.alive.sum() == 100 + len(pyramid) * (plane.HEIGHT * plane.WIDTH // 12)


def test_target_views_get_splats_where_their_labels_show_more(scene):
    """They replace a fifth of all at most, and the optimizer knows nothing of them."""
    config = dataclasses.replace(TINY_MIP.field, capacity=100, surfels_per_target=30)
    points = np.random.default_rng(0).uniform([-1, -1, -0.1], [1, 1, 0.1], (100, 3))
    points = jnp.asarray(points, jnp.float32)
    params, buffers = make_field(config, scene, 1).init(jax.random.key(0), points, points)
    moments = jax.tree.map(jnp.ones_like, params)
    state = TrainState(jnp.int32(3), params, buffers, moments, jax.random.key(1))
    views = jax.tree.map(lambda leaf: leaf[:2], scene.train)
    shape = views.weight.shape
    depth = jnp.full(shape[1:], 4.0)
    gray = Rendering(jnp.full((*shape[1:], 3), 0.5), depth, jnp.ones_like(depth))
    red = jnp.full((*shape, 3), 0.5).at[:, 4:9, 6:12].set(jnp.array([0.9, 0.1, 0.2]))
    labels = views.replace(rgb=red, weight=jnp.ones(shape))
    data = labels, lambda camera: gray, scene
    after = METHODS["mip_gaussians"].add_for_targets(jax.random.key(2), config, state, *data)
    new = np.asarray(after.params.means != params.means).any(axis=1)
    assert new.sum() == 2 * 10  # a fifth of 100, for two views
    for view in range(2):
        pixels, _ = points_to_pixels(camera_at(views.cameras, view), after.params.means)
        pixels = np.asarray(pixels)
        inside = np.all((pixels > [6, 4]) & (pixels < [12, 9]), axis=1)
        assert (inside & new).sum() >= 10
    colors = np.asarray(sh_to_rgb(after.params.sh[:, :1], after.params.means))[new]
    np.testing.assert_allclose(colors, np.tile([0.9, 0.1, 0.2], (20, 1)), atol=1e-5)
    np.testing.assert_array_equal(after.opt_state.means, np.where(new[:, None], 0, moments.means))
    least = np.sum(np.asarray(params.log_scales), -1) + np.log(
        jax.nn.sigmoid(params.opacity_logits)
    )
    assert least[new].max() <= least[~new].min()
    near = config.raster.near
    found = sampling_intervals(after.params.means, scene.train.cameras, near=near)
    np.testing.assert_allclose(after.buffers.interval, found, rtol=1e-6)
    # A density control may have given the others a parameter of its own.
    more = state.replace(params=with_image_offset(params), opt_state=with_image_offset(moments))
    same = METHODS["mip_gaussians"].add_for_targets(jax.random.key(2), config, more, *data).params
    np.testing.assert_array_equal(same.means, after.params.means)
    assert same.image_offset.shape == (100, 2) and not same.image_offset.any()
    none = dataclasses.replace(config, surfels_per_target=0)
    assert METHODS["surfels"].add_for_targets(jax.random.key(2), none, state, *data) is state


def test_few_points_have_random_ones_beside_them(scene):
    key = jax.random.key(0)
    for count in (0, 3, FEWEST_POINTS):
        some = np.random.default_rng(0).uniform(-1, 1, (count, 3)).astype(np.float32)
        of_capture = dataclasses.replace(scene, points=some, rgb=some)
        points, rgb = initial_points(key, of_capture, count=200)
        assert len(points) == len(rgb) == count + (200 if count < FEWEST_POINTS else 0)
        np.testing.assert_array_equal(points[:count], some)
        np.testing.assert_array_equal(rgb[:count], some)
        np.testing.assert_array_equal(rgb[count:], 0.5)


def test_the_shapes_of_a_state_are_those_of_the_state(scene):
    points = np.random.default_rng(0).uniform(-1, 1, (FEWEST_POINTS, 3)).astype(np.float32)
    programs = Programs(TINY_SURFELS, dataclasses.replace(scene, points=points, rgb=points))
    shapes, state = state_shapes(programs), initial_state(programs, run_keys(0))
    chex.assert_trees_all_equal_shapes_and_dtypes(shapes, state)


def test_a_coarse_model_has_room_for_no_more_than_the_fine_one(scene, capsys):
    scene = dataclasses.replace(scene, points=np.zeros((12_000, 3)), rgb=np.zeros((12_000, 3)))
    quick = METHODS["surfels"].presets["quick"]
    for given, room, name in ([], 10_000, "coarse.capacity"), (["capacity=5000"], 5000, "capacity"):
        programs = Programs(with_settings(quick, given), scene)
        assert programs.coarse.preset.field.capacity == room
        say_which_points_fit(programs)
        said = f"training begins with {room} of 12000 points: --set {name}=N makes room for more"
        assert said in capsys.readouterr().out


@pytest.fixture
def trial(tmp_path, monkeypatch):
    """A folder beside the methods' own, with the file of a trial method."""
    folder = tmp_path / "methods"
    folder.mkdir()
    shutil.copy(constant_color.__file__, folder)
    monkeypatch.setattr(methods, "__path__", [*methods.__path__, str(folder)])
    found = registry.find_methods()
    assert list(found) == ["surfels", *sorted(set(found) - {"surfels"})]
    monkeypatch.setitem(METHODS, "constant_color", found["constant_color"])
    monkeypatch.setattr(flags.FLAGS["method"].parser, "enum_values", list(METHODS))
    return folder


def test_a_new_method_is_one_file(trial, capture_folder, tmp_path):
    """It is trained, swept, rendered and reported, and nothing else mentions it."""

    def call(program, folder, **given):
        flags.FLAGS(["program"])
        given |= {"output_dir": str(tmp_path / folder), "compilation_cache": ""}
        with jax.numpy_dtype_promotion("standard"), flagsaver.flagsaver(**given):
            program.main(["program"])
        return tmp_path / folder

    given = {"method": "constant_color", "set": ["lr=0.2"]}
    trained = call(run, "run", scene=str(capture_folder), stages=["closeup"], **given)
    results = json.loads((trained / "results.json").read_text())
    assert results["method"] == "constant_color" and results["config"]["field"] == {"lr": 0.2}
    assert set(results["stages"]) == {"baseline", "closeup"}
    assert "constant_color, preset quick" in (trained / "report.html").read_text()
    arms = ["control", "label_loss_weight=0.9"]
    swept = call(sweep, "sweep", scenes=[str(capture_folder)], seeds=1, arms=arms, **given)
    found = json.loads((swept / "sweep.json").read_text())["scenes"]
    assert list(found[capture_folder.name]) == arms
    rendered = call(render, "render", run=str(trained), views="test", support=False, detail=False)
    assert (rendered / "rgb" / "0.png").exists() and (rendered / "depth" / "0.png").exists()
    assert not (rendered / "normals").exists()


def test_help_lists_a_new_method_and_its_settings(trial):
    code = (
        "import sys, jaxcloseup.app.methods as methods\n"
        "methods.__path__.append(sys.argv.pop(1))\n"
        "from jaxcloseup.app.cli.main import main\n"
        "main()"
    )
    for words, wanted in (
        (["--help"], "constant_color, one color for everything (Nobody et al. 2026)"),
        (
            ["--method=constant_color", "--set=help"],
            "lr=0.1 how fast the color is learned; a number between 0 and 2",
        ),
    ):
        command = [sys.executable, "-c", code, trial, "run", *words]
        said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        assert wanted in " ".join(said.split())
