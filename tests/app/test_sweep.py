"""Sweeps: arms are runs of their own, together; neither a failing one nor a stop costs others."""

import csv
import dataclasses
import functools
import json
import os
import pathlib
import shutil
import socket
import subprocess
import sys

import color_sweep
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl.testing import flagsaver
from conftest import QUICKLY
from tiny_runs import TINY, TINY_SURFELS, programs_of
from tiny_training import assert_same_step

from jaxcloseup.app.cli import sweep
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import with_settings
from jaxcloseup.app.report.pictures import comparisons
from jaxcloseup.app.report.sweep_tables import write_sweep
from jaxcloseup.app.run.labels import start_labels
from jaxcloseup.app.run.states import initial_points
from jaxcloseup.app.run.step_data import CloseupData, TrainData
from jaxcloseup.app.sweep import arm_training
from jaxcloseup.app.sweep.arm_training import join_arms, run_sweep
from jaxcloseup.app.sweep.named_arms import make_arm
from jaxcloseup.captures.load import load_scene
from jaxcloseup.training.state import init_state


ARMS = ["control", "labels", "diverse", "rgb_tolerance=0.5+magnification=2:3"]
TINY_STEPS = dataclasses.replace(
    TINY, field=dataclasses.replace(TINY.field, target_steps=2), closeup_steps=2
)


@functools.cache
def begin(preset, capture_folder):
    """Programs, the start of labels after a few steps, and the settings of each arm."""
    programs = programs_of(preset, capture_folder)
    scene = programs.scene
    points = initial_points(jax.random.key(1), scene)
    state = init_state(
        jax.random.key(0), *points, field=programs.field, optimizer=programs.optimizer
    )
    state, _ = programs.run(state, TrainData(scene.train), count=3)
    start = start_labels(programs, state)
    return programs, start, [make_arm(name, preset).settings for name in ARMS]


# SSIM's derivative jumps where a window is flat, on whichever side of 0 rounding falls.
TINY_SMOOTH = dataclasses.replace(
    TINY_SURFELS, field=dataclasses.replace(TINY_SURFELS.field, ssim_weight=0.0)
)


@pytest.mark.parametrize("preset", [TINY_STEPS, TINY_SMOOTH], ids=lambda p: p.method)
def test_an_arm_is_the_run_alone(preset, capture_folder):
    with jax.numpy_dtype_promotion("standard"):
        programs, start, arms = begin(preset, capture_folder)
        state, sources = start
        starts, devices = [start] * len(arms), len(jax.devices())
        states, data = join_arms(arms, starts, sources.views, devices=devices)
        together, metrics = programs.run(states, data, count=1)
        for i, settings in enumerate(arms):
            if ARMS[i] == "control":
                alone, _ = programs.run(state, TrainData(sources.views), count=1)
            else:
                data = CloseupData(sources.views, sources, settings)
                alone, _ = programs.run(state, data, count=1)
            arm = jax.tree.map(lambda leaf, i=i: leaf[i], together.replace(step=alone.step[None]))
            assert_same_step(arm.replace(step=alone.step), alone, state)
            assert int(together.step) == int(alone.step)
    assert not any(metrics["skipped"])
    different = [float(jnp.abs(x[0] - x[2]).max()) for x in jax.tree.leaves(together.params)]
    assert max(different) > 1e-4  # control and diverse
    assert len(jax.devices()) == 8  # four arms, and four copies of the last
    for leaf in jax.tree.leaves(together.params):
        assert len({shard.device for shard in leaf.addressable_shards}) == len(jax.devices())


def test_an_arm_that_diverges_takes_no_other_down(capture_folder, capsys):
    with jax.numpy_dtype_promotion("standard"):
        programs, start, arms = begin(TINY_STEPS, capture_folder)
        broken = arms[1].replace(label_loss_weight=jnp.float32(jnp.nan))
        both = []
        for second in (arms[1], broken):
            settings = [arms[0], second, arms[2]]
            views, devices = start.sources.views, len(jax.devices())
            states, data = join_arms(settings, [start] * 3, views, devices=devices)
            both.append(programs.run(states, data, count=2))
    (healthy, _), (after, metrics) = both
    assert metrics["skipped"][:3] == [0, 2, 0]  # then copies of the last, one a device
    assert "skipped, not finite" in capsys.readouterr().out
    for i in (0, 2):
        pick = functools.partial(jax.tree.map, lambda leaf, i=i: leaf[i])
        jax.tree.map(np.testing.assert_array_equal, pick(after.params), pick(healthy.params))
    first = jax.tree.map(lambda leaf: leaf[1], after.params)
    jax.tree.map(np.testing.assert_array_equal, first, start.state.params)


def sweep_tiny(scene, folder, arms=("baseline", "control", "diverse", "test_time"), seeds=2, **kw):
    kw |= {"names": {"method": "nerf", "preset": "tiny"}, "max_parallel": 3}
    with jax.numpy_dtype_promotion("standard"):
        return run_sweep(scene, TINY_STEPS, arms, seeds, folder, **kw)


def test_a_sweep_cut_off_and_resumed_ends_the_same(capture_folder, tmp_path, monkeypatch, capsys):
    programs = programs_of(TINY_STEPS, capture_folder)  # compiled once for both
    scene = programs.scene
    monkeypatch.setattr(arm_training, "Programs", lambda preset, scene: programs)
    render, rendered_by = programs.render, set()

    def render_and_note(state, *camera):
        rendered_by.add(len(jax.tree.leaves(state.params)[0].devices()))
        return render(state, *camera)

    monkeypatch.setattr(programs, "render", render_and_note)
    whole = sweep_tiny(scene, tmp_path / "sweep").scores
    assert rendered_by == {1} and len(jax.devices()) == 8  # devices
    assert list(whole) == ["baseline", "control", "diverse", "test_time", "test_time_control"]
    assert all(list(of_arm) == ["0", "1"] for of_arm in whole.values())
    psnr = {arm: whole[arm]["0"]["splits"]["test"]["psnr"] for arm in whole}
    assert len({psnr["baseline"], psnr["control"], psnr["diverse"]}) == 3
    other = whole["control"]["1"]["splits"]["test"]["psnr"]
    assert psnr["control"] != other

    in_turn = [f"test_time{arm}_{seed}" for arm in ("", "_control") for seed in (0, 1)]
    for stage in ("arms_1", *in_turn):  # as if stopped after the first arms
        shutil.rmtree(tmp_path / "sweep" / stage)
    capsys.readouterr()
    compare = tmp_path / "compare"
    again = sweep_tiny(scene, tmp_path / "sweep")
    assert again.scores == whole
    pictures = comparisons(compare, again.shown, again.images)
    assert capsys.readouterr().out.count("resumed") == 3  # both baselines and the first arms

    # Truth, five arms and the error of the last, of the one close-up and the one ordinary view.
    assert [picture.section for picture in pictures] == ["Close-ups", "Ordinary views"]
    assert len(list(compare.iterdir())) == 2
    truth = np.asarray(scene.test.rgb[0]).repeat(8, axis=0).repeat(8, axis=1)  # at least 240 wide
    height, width = truth.shape[:2]
    starts = [(width + 8) * i for i in range(7)]
    panels = [pictures[0].image[-height:, x : x + width].astype(int) for x in starts]
    np.testing.assert_array_equal(panels[0], truth)
    assert np.abs(panels[1] - panels[3]).max() > 0  # baseline and diverse

    about = {"method": "nerf", "preset": "tiny"}
    write_sweep(tmp_path, {scene.name: whole}, about, pictures)
    table = list(csv.DictReader((tmp_path / "table.csv").read_text().splitlines()))
    assert [row["arm"] for row in table[:5]] == list(whole)
    expected = np.mean([psnr["control"], other])
    assert float(table[1]["psnr"]) == pytest.approx(expected)
    assert json.loads((tmp_path / "sweep.json").read_text())["scenes"][scene.name] == whole
    assert "test_time" in (tmp_path / "table.md").read_text()
    page = (tmp_path / "report.html").read_text()
    assert "95 %" in page and page.count("<img") == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arms": ["control", "control"]}, "--arms=control,control must name one or more"),
        ({"scenes": []}, "--scenes= must name one or more"),
        ({"arms": ["warm"]}, "--arms=warm: warm is neither an arm"),
        ({"method": "nerf", "arms": ["label_loss_weight=0.3"]}, "this preset pools the losses"),
        ({"method": "nerf", "arms": ["expected_depth=1"]}, "nerf has no setting expected_depth"),
        ({"arms": ["expected_depth=2"]}, "expected_depth must be true or false or none"),
        ({"arms": ["depth_error=-1"]}, "depth_error is a share"),
        ({"set": ["capacity=0"]}, "--set=capacity=0: capacity must be between 1 and 100000000"),
        ({"arms": ["label=warp+depth_error=0+expected_depth=1"]}, "do not go together"),
        ({"scenes": ["nowhere"]}, "nowhere"),
        ({"scenes": ["plane0"], "arms": ["oracle"]}, "plane0 can have none of them, for the true"),
    ],
)
def test_flags_that_make_no_sense_are_one_sentence(
    parsed_flags, capture_folder, tmp_path, monkeypatch, changes, message
):
    monkeypatch.chdir(capture_folder.parent)
    out = str(tmp_path / "out")
    with flagsaver.flagsaver(output_dir=out, **changes), pytest.raises(SystemExit, match=message):
        sweep.main(["sweep"])
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arm", "settings"),
    [
        ("test_time", ["label_loss_weight=0.3"]),
        ("test_time", ["targets.label_loss_weight=0.7"]),
        ("test_time+label_loss_weight=0.7", []),
        ("diverse+label=residual+label_loss_weight=0.2", []),
        ("depth_error=0+label_loss_weight=0.2", []),
        ("label_loss_weight=0.3", ["num_label_rays=none"]),
    ],
)
def test_losses_that_are_added_may_have_any_weight(parsed_flags, arm, settings):
    """The preset pools losses in steps that label single pixels of close-ups anew, and there alone.

    `test_flags_that_make_no_sense_are_one_sentence` has an arm of these.
    """
    preset = with_settings(METHODS["ngp"].presets["quick"], settings)
    with flagsaver.flagsaver(arms=["control", arm]):
        sweep._check_flags(preset)


def test_an_arm_may_have_labels_from_the_other_depth(capture_folder, tmp_path):
    scene = load_scene(str(capture_folder))
    arms = ["diverse", "expected_depth=0", "expected_depth=1"]
    names = {"method": "surfels", "preset": "tiny"}
    labels = dataclasses.replace(TINY_SMOOTH.labels, label_loss_weight=0.5)
    preset = dataclasses.replace(TINY_SMOOTH, labels=labels)
    with jax.numpy_dtype_promotion("standard"):
        found = run_sweep(scene, preset, arms, 1, tmp_path, names=names).scores
    as_ever, median, expected = (found[arm]["0"]["splits"]["test"]["psnr"] for arm in arms)
    assert as_ever == median
    assert as_ever != expected


def start_host(*arguments):
    """A Python of its own, on one device, that has what is compiled already."""
    tests = pathlib.Path(__file__).parents[1]
    environment = os.environ | {
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"{QUICKLY} --xla_force_host_platform_device_count=1",
        "PYTHONPATH": os.pathsep.join(map(str, (tests.parent, tests))),
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
    }
    command = [sys.executable, color_sweep.__file__, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def test_arms_are_spread_over_hosts(capture_folder, tmp_path):
    """Two processes that know each other end with what one ends with; the first one writes."""
    (tmp_path / "capture").symlink_to(capture_folder)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    scene = load_scene(str(capture_folder))
    whole = color_sweep.sweep_colors(scene, tmp_path / "alone")
    for process in [start_host(tmp_path, port, i) for i in range(2)]:
        _, error = process.communicate(timeout=600)
        assert process.returncode == 0, error[-2000:]
    hosts = [json.loads((tmp_path / f"host{i}.json").read_text()) for i in range(2)]
    assert hosts[0] == hosts[1]
    for arm, by_seed in whole.items():
        for seed, result in by_seed.items():
            for split, metrics in result["splits"].items():
                found = hosts[0][arm][seed]["splits"][split]["psnr"]
                assert found == pytest.approx(metrics["psnr"], abs=1e-2)
    # What the first host kept, one host alone can go on from, and the other way round.
    kept, alone = (
        {path.relative_to(folder) for path in folder.glob("*/*")}
        for folder in (tmp_path / "sweep", tmp_path / "alone")
    )
    assert kept == alone


@pytest.mark.parametrize(
    "hosts",
    [
        {"coordinator": "127.0.0.1:1"},
        {"num_processes": 2, "process_id": 0},
        {"coordinator": "127.0.0.1:1", "num_processes": 2, "process_id": 2},
    ],
)
def test_hosts_need_all_three_flags(parsed_flags, tmp_path, hosts):
    with (
        flagsaver.flagsaver(output_dir=str(tmp_path / "out"), **hosts),
        pytest.raises(SystemExit, match="several hosts need --coordinator, --num_processes and"),
    ):
        sweep.main(["sweep"])


def test_hosts_need_one_folder(parsed_flags):
    hosts = {"coordinator": "127.0.0.1:1", "num_processes": 2, "process_id": 1}
    with (
        flagsaver.flagsaver(output_dir=None, **hosts),
        pytest.raises(SystemExit, match="give --output_dir"),
    ):
        sweep.main(["sweep"])
