"""One step of a sweep of eight arms against eight steps of a run alone, for both fields."""

import functools

import jax

from experiments.benchmarks.timing import interleaved_medians
from experiments.methods.presets import PRESETS, initial_points, pseudo_settings
from experiments.training.arms import make_arm
from experiments.training.loop import Programs
from experiments.training.stages import rendered_depths
from experiments.training.sweep import stack_arms
from jaxcloseup.geometry.union_warp import block_sources
from jaxcloseup.scenes import load_scene
from jaxcloseup.train import init_state


ARMS = ("control", "labels", "mask", "diverse")
GRID = ("rgb_tolerance=0.02", "depth_tolerance=0.005", "label_loss_weight=0.5", "magnification=2:4")
BEGUN, STEPS = 100, 5  # steps before measuring, and in one measurement


def run() -> None:
    """Print milliseconds and the ratio."""
    print("method   one step alone  one step of 8 arms  over 8 alone")
    for method, presets in PRESETS.items():
        preset = presets["quick"]
        scene = load_scene("table", downscale=preset.downscale)
        views, programs = jax.device_put(scene.train), Programs(preset, scene)
        key = jax.random.key(0)
        points = initial_points(key, scene)
        state = init_state(key, *points, field=programs.field, optimizer=programs.optimizer)
        state, _ = programs.run("photographs", state, views, count=BEGUN)
        render = functools.partial(programs.render, state)
        depths = rendered_depths(render, views.cameras, scene)
        sources = jax.jit(block_sources)(views.cameras, depths, views.weight)
        arms = [make_arm(name, pseudo_settings(preset)) for name in ARMS + GRID]
        arms = [arm.settings for arm in sorted(arms, key=lambda arm: arm.outlook)]
        common = make_arm("diverse", pseudo_settings(preset)).settings
        states, *data = stack_arms([(s, state, depths, sources) for s in arms], len(jax.devices()))
        alone = state, views, depths, common, sources
        programs.make_room(4)  # virtual views need more than photographs; both have the same
        calls = {
            "alone": lambda p=programs, a=alone: p.run("virtual", *a, count=STEPS)[0],
            "arms": lambda p=programs, a=(states, views, *data): p.run("arms", *a, count=STEPS)[0],
        }
        seconds = {k: v / STEPS for k, v in interleaved_medians(calls, 5).items()}
        ratio = seconds["arms"] / (len(arms) * seconds["alone"])
        print(
            f"{method:<8} {1e3 * seconds['alone']:>11.0f} ms  {1e3 * seconds['arms']:>15.0f} ms"
            f"  {ratio:>12.2f}",
            flush=True,
        )
