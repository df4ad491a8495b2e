import dataclasses
import io
import json
import re
import shutil

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import plane
import pytest
from tiny_runs import TINY, TINY_SURFELS, programs_of

from jaxcloseup.app.methods.method import CoarseConfig, TargetConfig, WindowConfig
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.report import reported_run
from jaxcloseup.app.report.comparison import say_which_is_best, write_comparison
from jaxcloseup.app.report.finished_runs import read_finished
from jaxcloseup.app.report.reported_run import run
from jaxcloseup.app.run import corrected_poses
from jaxcloseup.app.run.corrected_poses import read_poses, with_poses
from jaxcloseup.app.run.keys import run_keys
from jaxcloseup.app.run.loop import Training, TrainingError, train_stage
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.states import initial_points, initial_state
from jaxcloseup.app.run.step_data import TrainData
from jaxcloseup.app.score.folders import evaluate_folders
from jaxcloseup.app.score.scores import NO_PERCEPTUAL
from jaxcloseup.app.store.stored_run import choose_stage, load_run_scene, read_run, restore
from jaxcloseup.app.view.approach import FRAMES
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.artifacts.images import to_uint8
from jaxcloseup.artifacts.surfel_ply import read_surfels
from jaxcloseup.captures.load import load_scene
from jaxcloseup.photos.views import camera_at
from jaxcloseup.training.state import init_state


@pytest.fixture(scope="session")
def finished(capture_folder, tmp_path_factory):
    """The results and the folder of one tiny run."""
    output_dir = tmp_path_factory.mktemp("run")
    return run_tiny(capture_folder, output_dir), output_dir


def run_tiny(capture_folder, output_dir):
    # Libraries under a run (optax's schedules) mix integers and floats.
    with jax.numpy_dtype_promotion("standard"), pytest.MonkeyPatch.context() as patch:
        programs = programs_of(TINY, capture_folder)  # compiled once for all
        patch.setattr(reported_run, "Programs", lambda preset, scene, read: programs)
        names = {"method": "nerf", "preset": "tiny"}
        scene = load_scene(str(capture_folder))
        return run(scene, TINY, 0, output_dir, names=names, save_every=3)


def assert_log_is_history(output_dir, history):
    lines = list(map(json.loads, (output_dir / "stats" / "train.jsonl").read_text().splitlines()))
    assert [line["stage"] for line in lines] == [s for s in history for _ in history[s]]
    said = [
        {key: value for key, value in line.items() if key not in ("steps_per_second", "seconds")}
        for line in lines
    ]
    assert said == [{"stage": stage, **entry} for stage in history for entry in history[stage]]
    assert all(line["steps_per_second"] > 0 and line["seconds"] > 0 for line in lines)


def test_a_run_scores_every_stage_on_every_split(finished):
    results, output_dir = finished
    assert json.loads((output_dir / "results.json").read_text()) == results
    assert results["resolution"] == [plane.WIDTH, plane.HEIGHT]
    for stage in ("baseline", "control", "closeup", "test_time_control", "test_time", "detail"):
        for split in ("test", "test_far"):
            scores = results["stages"][stage][split]
            assert scores["psnr"] == pytest.approx(scores["views"]["0"]["psnr"])
            assert scores["ssim"] is not None
            assert scores["lpips_vgg"] is None
            assert scores["lpips_vgg_reason"]
        assert results["seconds"][stage] > 0
    assert results["stages"]["control"] != results["stages"]["closeup"]
    assert results["detail"]["stage"] == "closeup" and results["detail"]["divisor"] == 1
    assert (output_dir / "detail" / "closeup.npz").exists()
    assert_log_is_history(output_dir, results["history"])


def test_a_run_leaves_what_it_takes_to_render_it(finished, capture_folder):
    results, output_dir = finished
    manifest = json.loads((output_dir / "manifest.json").read_text())
    assert manifest["finished"] and manifest["seconds"]["closeup"] == results["seconds"]["closeup"]
    assert manifest["config"] == results["config"] and manifest["versions"]["device"]
    assert manifest["scene"] == str(capture_folder.resolve())
    record = read_run(output_dir)
    assert record.preset == TINY
    assert record.stages == ["baseline", "closeup", "control", "test_time", "test_time_control"]
    assert choose_stage(record, None) == "closeup"
    with jax.numpy_dtype_promotion("standard"):
        scene = load_run_scene(record)
        programs, state = restore(record, scene, "closeup")
        image = programs.render(state, camera_at(scene.test.cameras, 0)).rgb
    saved = cv2.imread(str(output_dir / "renders" / "closeup" / "test" / "rgb" / "0.png"))
    np.testing.assert_allclose(to_uint8(image), saved[..., ::-1], atol=1)


def test_surfels_run_through_all_stages_from_random_points(
    capture_folder, tmp_path, capsys, monkeypatch
):
    """A coarse model moves cameras, becomes finer, and learns from twice as large photographs."""

    def move(programs, coarse):
        assert coarse.params.means.shape == (500, 3)
        return with_poses(programs, programs.scene.train.cameras.camtoworld.at[1, 2, 3].add(0.01))

    monkeypatch.setattr(corrected_poses, "correct_poses", move)
    field = dataclasses.replace(TINY_SURFELS.field, capacity=500)
    coarse = CoarseConfig(field, steps=20, poses=True)
    steps = {"downscale": 2, "coarse": coarse, "windows": WindowConfig()}
    steps["targets"] = TargetConfig("residual", lr_scale=2.0)
    steps["labels"] = dataclasses.replace(TINY_SURFELS.labels, expected_depth=True)
    fine = dataclasses.replace(TINY_SURFELS.field, capacity=800, selective_adam=True)
    preset = dataclasses.replace(TINY_SURFELS, field=fine, **steps)
    stages = ["closeup", "test_time"]
    with jax.numpy_dtype_promotion("standard"):
        scene = load_scene(str(capture_folder), downscale=2)
        names = {"method": "surfels", "preset": "tiny"}
        results = run(scene, preset, 0, tmp_path, names=names, to_run=stages)
    said = capsys.readouterr().out
    assert "windows of photographs of 32 x 24 pixels, their own size" in said
    assert "growing to" not in said
    parts = [tuple(map(int, found)) for found in re.findall(r"^\[(\d+)/(\d+)\] ", said, re.M)]
    assert parts[0][0] == 1 and parts[-1][0] == parts[-1][1]  # the report is the last one
    assert parts == sorted(parts, key=lambda part: part[0]) and len(set(parts)) > 8
    assert "\n[1/" in said and "compiling the steps" in said and "writing the report" in said
    assert results["history"]["coarse_baseline"][-1]["step"] == 20
    poses = read_poses(tmp_path, scene.names["train"])
    given = scene.train.cameras.camtoworld
    np.testing.assert_array_equal(poses, given.at[1, 2, 3].add(0.01))
    after = load_run_scene(read_run(tmp_path)).train.cameras.camtoworld
    np.testing.assert_array_equal(after, poses)
    assert json.loads((tmp_path / "results.json").read_text()) == results
    stages = results["stages"]
    use_labels = results["gate"]["weight"] > 0
    # Without labels, control takes the place of closeup.
    assert ("control" in stages) == (not use_labels)
    assert {"baseline", "closeup", "test_time"} <= set(stages)
    assert stages["baseline"]["test"]["psnr"] > 10
    assert results["resolution"] == [16, 12] and results["scored_at"] == [32, 24]
    assert stages["baseline"]["test_reduced"]["psnr"] > 10
    assert stages["baseline"]["test_reduced"]["psnr"] != stages["baseline"]["test"]["psnr"]
    assert len(results["gate"]["left_out"]) == 6
    if not use_labels:
        assert stages["closeup"] == stages["control"]
    # Target views learn from renders with detail, which the gate of warps does not concern.
    latest = "closeup" if use_labels else "control"
    # All stages render the depth that labels are made from, so their errors can be compared.
    assert restore(read_run(tmp_path), scene, latest)[1].buffers.expected == 1
    assert (tmp_path / "detail" / f"{latest}.npz").exists()
    assert [entry["step"] for entry in results["history"]["test_time"]] == [1, 2]
    assert "test_time_control" not in stages
    assert "left-out photographs" in (tmp_path / "report.html").read_text()
    for stage in stages:
        splats = read_surfels(tmp_path / "splats" / f"{stage}.ply")
        assert len(splats.means) == 800  # new surfels took the rows that the coarse ones left


def test_windows_of_reduced_photographs_are_these(capture_folder):
    scene = load_scene(str(capture_folder), downscale=2)
    preset = dataclasses.replace(TINY_SURFELS, windows=WindowConfig(finest=2), downscale=2)
    assert Programs(preset, scene).photographs is scene.train


def test_a_nerf_may_learn_from_rays_of_larger_photographs(capture_folder, capsys):
    with jax.numpy_dtype_promotion("standard"):
        scene = load_scene(str(capture_folder), downscale=2)
        preset = dataclasses.replace(TINY, windows=WindowConfig(), downscale=2)
        programs = Programs(preset, scene)
        photographs = programs.photographs
        assert "learning from pixels of photographs of 32 x 24 pixels" in capsys.readouterr().out
        assert photographs.pyramid.sizes == ((24, 32), (12, 16))
        state = initial_state(programs, run_keys(0))
        state, metrics = programs.run(state, TrainData(photographs), count=2)
    assert state.step == 2 and metrics["skipped"] == 0 and np.isfinite(metrics["loss"])
    assert METHODS["nerf"].presets["quick"].windows.finest == 8  # reduced photographs alone


def test_no_step_is_taken_on_a_truncated_image(capture_folder, capsys):
    """The same steps of the loops with too little room and with plenty end alike."""
    states = []
    for capacity in (1800, 3600):
        raster = dataclasses.replace(
            TINY_SURFELS.field.raster, capacity=capacity, compositor="loops"
        )
        field = dataclasses.replace(TINY_SURFELS.field, raster=raster)
        with jax.numpy_dtype_promotion("standard"):
            scene = load_scene(str(capture_folder))
            programs = Programs(dataclasses.replace(TINY_SURFELS, field=field), scene)
            points = initial_points(jax.random.key(1), scene, count=500)
            bound = {"field": programs.field, "optimizer": programs.optimizer}
            state = init_state(jax.random.key(0), *points, **bound)
            after, metrics = programs.run(state, TrainData(scene.train), count=3)
        assert "overflow" not in metrics
        states.append(after)
    assert "growing to 2 times the preset's" in capsys.readouterr().out
    assert states[0].step == states[1].step == 3
    for small, large in zip(*(jax.tree.leaves(s.params) for s in states), strict=True):
        np.testing.assert_allclose(small, large, atol=1e-5)


def test_a_large_image_is_rendered_in_quarters(capture_folder):
    """An image of odd size, twice as wide as what has a program of its own, has no seams."""
    with jax.numpy_dtype_promotion("standard"):
        programs = programs_of(TINY, capture_folder)
        scene, state = programs.scene, initial_state(programs, run_keys(0))
        camera = camera_at(scene.train.cameras, 1)
        times = 4 + 3 / camera.width
        size = {"height": 4 * camera.height + 1, "width": 4 * camera.width + 3}
        camera = camera.replace(intrinsics=times * camera.intrinsics, **size)
        whole = programs.field.render(state.params, state.buffers, camera, None, None)
        seen = programs.render(state, camera)
    assert np.std(whole.rgb) > 0.01
    for name in ("rgb", "depth", "alpha"):
        np.testing.assert_allclose(getattr(seen, name), getattr(whole, name), atol=1e-4)


def test_a_saved_render_reproduces_its_score(finished, capture_folder):
    results, output_dir = finished
    image = cv2.imread(str(output_dir / "renders" / "closeup" / "test" / "rgb" / "0.png"))
    truth = cv2.imread(str(capture_folder / "test" / "0.png"))
    expected = results["stages"]["closeup"]["test"]["psnr"]
    np.testing.assert_allclose(cv2.PSNR(image, truth), expected, atol=1e-3)
    folders = (output_dir / "renders" / of / "test" / "rgb" for of in ("closeup", "truth"))
    again = evaluate_folders(*folders, None, NO_PERCEPTUAL)
    assert again["psnr"] == pytest.approx(expected, abs=1e-3)


def test_a_run_leaves_pictures_and_a_page_without_links(finished):
    _, output_dir = finished
    for picture in ("compare/0.png", "compare/test_far_0.png", "labels/virtual_0.png"):
        assert cv2.imread(str(output_dir / picture)) is not None
    depth = cv2.imread(str(output_dir / "renders" / "baseline" / "test" / "depth" / "0.png"))
    assert depth.shape == (plane.HEIGHT, plane.WIDTH, 3)
    page = (output_dir / "report.html").read_text()
    assert 'src="data:image/webp' in page
    assert page.index("Close-ups have a PSNR") < page.index('type="range"') < page.index("<table")
    assert len(page) < 4e6
    animation = (output_dir / "dolly.webp").read_bytes()
    assert 'class="moving"' in page
    with PIL.Image.open(io.BytesIO(animation)) as shown:
        assert shown.size == (plane.WIDTH, plane.HEIGHT)
        assert shown.n_frames == 2 * FRAMES - 2  # there and back
    # SVG names its namespaces by addresses, which nobody follows.
    links = re.findall(r"(?:src|href)=['\"]([^'\"]*)", page)
    assert links
    files = [link for link in links if not link.startswith(("data:", "#"))]
    assert "compare/0.png" in files  # a picture at its full size
    assert all((output_dir / file).is_file() for file in files)


def test_finished_runs_can_be_compared(finished, tmp_path):
    _, output_dir = finished
    other = shutil.copytree(output_dir, tmp_path / "other")
    runs = read_finished([output_dir, other])
    write_comparison(tmp_path / "both", runs)
    page = (tmp_path / "both" / "report.html").read_text()
    assert "as good as" in say_which_is_best(runs) and page.count('type="range"') == 2
    assert [run.stage for run in runs] == ["detail", "detail"]


def test_a_run_cut_off_and_resumed_ends_the_same(
    finished, capture_folder, tmp_path, monkeypatch, capsys
):
    """Cut off in the middle of a stage, and once more between two stages."""
    results, _ = finished
    save = Checkpoints.save
    for saves in (4, 8):
        left = iter(range(saves))

        def save_some(self, *args, left=left):
            if next(left, None) is None:
                raise KeyboardInterrupt
            save(self, *args)

        with monkeypatch.context() as patch:
            patch.setattr(Checkpoints, "save", save_some)
            with pytest.raises(KeyboardInterrupt):
                run_tiny(capture_folder, tmp_path)
    again = run_tiny(capture_folder, tmp_path)
    assert "resumed" in capsys.readouterr().out
    assert again["stages"] == results["stages"]
    assert again["history"] == results["history"]
    assert_log_is_history(tmp_path, results["history"])


def test_training_that_is_no_longer_finite_stops_with_what_was_good(
    capture_folder, tmp_path, monkeypatch
):
    with jax.numpy_dtype_promotion("standard"):
        programs = programs_of(TINY, capture_folder)
        scene, state = programs.scene, initial_state(programs, run_keys(0))
        broken = scene.train.replace(rgb=jnp.full(scene.train.rgb.shape, jnp.nan))
        training = Training(programs, Checkpoints(tmp_path, {"scene": "plane"}))
        good, calls, run = [], [], programs.run

        def breaks_in_the_second_and_after_four(state, data, *, count):
            calls.append(count)
            broke = len(calls) == 2 or len(calls) > 4
            now = run(state, TrainData(broken) if broke else data, count=count)
            if not broke:
                good.append(now[0])
            return now

        monkeypatch.setattr(programs, "run", breaks_in_the_second_and_after_four)
        message = r"stopped after 8 good .* kept in .* not finite in each of the next 10:"
        with pytest.raises(TrainingError, match=message):
            train_stage(training, "baseline", state, TrainData(scene.train), steps=20)
        step, kept, progress = Checkpoints(tmp_path, {"scene": "plane"}).load("baseline", state)
    assert [entry["skipped"] for entry in progress["history"]] == [0, 2, 0, 0]
    assert step == 8 and calls == [2] * 9
    jax.tree.map(np.testing.assert_array_equal, kept.params, good[-1].params)
