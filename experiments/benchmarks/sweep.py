"""Time one step of a sweep with eight arms against eight steps of a single run, by method."""

import jax

from experiments.benchmarks.timing import interleaved_medians
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.run.keys import run_keys
from jaxcloseup.app.run.labels import start_labels
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.states import initial_state
from jaxcloseup.app.run.step_data import CloseupData, TrainData
from jaxcloseup.app.sweep.arm_training import join_arms
from jaxcloseup.app.sweep.named_arms import make_arm
from jaxcloseup.captures.load import load_scene
from jaxcloseup.labels.config import pseudo_settings


ARMS = ("control", "labels", "mask", "diverse")
GRID = ("rgb_tolerance=0.02", "depth_tolerance=0.005", "label_loss_weight=0.5", "magnification=2:4")
WARMUP, STEPS = 100, 5  # steps before measuring, and in one measurement


def run() -> None:
    """Print milliseconds and the ratio for each method."""
    print("method   one step alone  one step of 8 arms  over 8 alone")
    for name, method in METHODS.items():
        alone, together = step_seconds(method.presets["quick"])
        print(
            f"{name:<8} {1e3 * alone:>11.0f} ms  {1e3 * together:>15.0f} ms"
            f"  {together / (len(ARMS + GRID) * alone):>12.2f}",
            flush=True,
        )


def step_seconds(
    preset: Preset, scene: str = "table", *, warmup: int = WARMUP
) -> tuple[float, float]:
    """Return the seconds of a step alone, and of a step of all arms together, on a scene."""
    scene = load_scene(scene, downscale=preset.downscale)
    programs = Programs(preset, scene)
    state = initial_state(programs, run_keys(0))
    views = jax.device_put(scene.train)
    state, _ = programs.run(state, TrainData(views), count=warmup)
    start = start_labels(programs, state)
    arms = [make_arm(arm, preset) for arm in ARMS + GRID]
    arms = [arm.settings for arm in sorted(arms, key=lambda arm: arm.outlook)]
    states, together = join_arms(arms, [start] * len(arms), views, devices=len(jax.devices()))
    alone = CloseupData(views, start.sources, pseudo_settings(preset.labels))
    programs.make_room(4)  # virtual cameras need more than photographs; both calls get the same
    calls = {
        "alone": lambda: programs.run(start.state, alone, count=STEPS)[0],
        "arms": lambda: programs.run(states, together, count=STEPS)[0],
    }
    seconds = interleaved_medians(calls, 5)
    return seconds["alone"] / STEPS, seconds["arms"] / STEPS
