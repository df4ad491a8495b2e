"""All arms of a sweep on one scene, from one baseline a seed."""

import dataclasses
import functools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.run.fine_tuning import prepare_target_views
from jaxcloseup.app.run.kept_detail import GetDetail, detail_getter
from jaxcloseup.app.run.keys import RunKeys, run_keys
from jaxcloseup.app.run.labels import LabelStart, label_closeups, rendered_depths, start_labels
from jaxcloseup.app.run.logs import TrainLog
from jaxcloseup.app.run.loop import Training, TrainingError, train_stage
from jaxcloseup.app.run.manifest import identity_of
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.scoring import hold_out
from jaxcloseup.app.run.stage_names import OWN_CONTROL
from jaxcloseup.app.run.states import say_which_points_fit, train_baseline
from jaxcloseup.app.run.step_data import ArmsData, LabeledData, StepData, TrainData
from jaxcloseup.app.score.scores import NO_PERCEPTUAL, Perceptual
from jaxcloseup.app.sweep.arm_scoring import ArmScorer, SweepOutcome
from jaxcloseup.app.sweep.ceilings import labels_with_better_depth, true_close_ups
from jaxcloseup.app.sweep.named_arms import Arm, describe, make_arm, why_not
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.labels.make import LabelSources, PseudoSettings
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views
from jaxcloseup.photos.windows import Windows
from jaxcloseup.training.arms import arm_state, stack_arms, stack_states
from jaxcloseup.training.state import TrainState


def run_sweep(
    scene: Scene,
    preset: Preset,
    arms: Sequence[str],
    seeds: int,
    folder: pathlib.Path,
    *,
    names: Mapping[str, str],
    max_parallel: int = 8,
    perceptual: Perceptual = NO_PERCEPTUAL,
    seconds: dict[str, float] | None = None,
    log: TrainLog | None = None,
) -> SweepOutcome:
    """Train and score all arms on one scene.

    `folder` keeps checkpoints, from which the same sweep resumes; `names` has "method" and
    "preset".
    `max_parallel` arms and seeds train at once. `seconds` gets the wall time of each stage.
    """
    scene = dataclasses.replace(scene, train=jax.device_put(scene.train))
    chosen = choose_arms(arms, preset, scene)
    together, in_turn = order_arms(chosen, seeds)
    identity = identity_of(scene, preset, names) | {"seeds": seeds, "arms": describe(chosen)}
    identity |= {"max_parallel": max_parallel, "devices": len(jax.devices())}
    # Checkpoints tell the arms that train together apart by their place alone.
    identity["together"] = [[arm.name, seed] for arm, seed in together]
    programs = Programs(preset, scene)
    training = Training(programs, Checkpoints(folder, identity), log)
    training.seconds = {} if seconds is None else seconds
    say_which_points_fit(programs)
    starts = Starts(training, seeds)
    expected = preset.labels.expected_depth  # of all rows, so that their depth can be compared
    held_out = hold_out(programs, starts.of(0, expected))
    scorer = ArmScorer(programs, held_out, chosen, perceptual)
    for seed in range(seeds):
        if "baseline" in scorer.scores:
            state = starts.of(seed, expected).state
            scorer.score("baseline", seed, state, starts.skipped[seed])
    for first in range(0, len(together), max_parallel):
        group = together[first : first + max_parallel]
        train_together(training, f"arms_{first // max_parallel}", group, starts, scorer)
    for arm, seed in in_turn:
        train_in_turn(training, arm, seed, starts.of(seed, arm.labels.expected_depth), scorer)
    return scorer.outcome()


def choose_arms(names: Sequence[str], preset: Preset, scene: Scene) -> list[Arm]:
    """Return the arms that a scene can have, and print why it cannot have others."""
    arms = [make_arm(name, preset) for name in names]
    for arm in arms:
        if why_not(arm, scene):
            print(f"no {arm.name} on {scene.name}: {why_not(arm, scene)}")
    return [arm for arm in arms if not why_not(arm, scene)]


def order_arms(
    arms: Sequence[Arm], seeds: int
) -> tuple[list[tuple[Arm, int]], list[tuple[Arm, int]]]:
    """Return pairs of arm and seed: first those that train together, then those in turn."""
    pairs = [(arm, seed) for arm in arms for seed in range(seeds)]
    together = [pair for pair in pairs if not pair[0].in_turn and pair[0].kind != "baseline"]
    # Side by side, arms that look from the same places share their forward warps.
    together.sort(key=lambda pair: (pair[1], pair[0].outlook))
    return together, [pair for pair in pairs if pair[0].in_turn]


class Starts:
    """Baselines of all seeds, and what fine-tuning on labels begins with.

    Attributes:
      skipped: steps of each seed's baseline that were skipped.
    """

    def __init__(self, training: Training, seeds: int) -> None:
        """Train a baseline for each seed."""
        self._programs = training.programs
        self._baselines = [
            train_baseline(training, f"baseline_{seed}", run_keys(seed)) for seed in range(seeds)
        ]
        histories = (training.history[f"baseline_{seed}"] for seed in range(seeds))
        self.skipped = [count_skipped(history) for history in histories]
        self._starts: dict[tuple[int, bool | None], LabelStart] = {}

    def of(self, seed: int, expected_depth: bool | None = None) -> LabelStart:
        """Return the start of a seed; `expected_depth` as in `LabelConfig`."""
        if (seed, expected_depth) not in self._starts:
            self._starts[seed, expected_depth] = start_labels(
                self._programs, self._baselines[seed], expected_depth=expected_depth
            )
        return self._starts[seed, expected_depth]


def train_together(
    training: Training,
    name: str,
    group: Sequence[tuple[Arm, int]],
    starts: Starts,
    scorer: ArmScorer,
) -> None:
    """Train and score arms as one program."""
    print(f"{name}: " + ", ".join(f"{arm.name} {seed}" for arm, seed in group))
    states, data = join_arms(
        [arm.settings for arm, _ in group],
        [starts.of(seed, arm.labels.expected_depth) for arm, seed in group],
        training.programs.photographs,
        devices=len(jax.devices()),
    )
    steps = training.programs.preset.closeup_steps
    states = train_stage(training, name, states, data, steps=steps)
    # A slice of what lies on all devices would too: each would render it, in step with the others,
    # while threads render several views at once.
    states = jax.device_put(states, jax.local_devices()[0])
    for i, (arm, seed) in enumerate(group):
        skipped = sum(chunk["skipped"][i] for chunk in training.history[name])
        scorer.score(arm.name, seed, arm_state(states, i), skipped)


def join_arms(
    settings: Sequence[PseudoSettings],
    starts: Sequence[LabelStart],
    photographs: Views | Windows,
    *,
    devices: int,
) -> tuple[TrainState, ArmsData]:
    """Return the states of arms and what they learn from, as `Programs.run` takes them.

    The last arm is repeated until each device has as many.
    """
    fill = -len(starts) % devices
    starts, settings = [*starts, *[starts[-1]] * fill], [*settings, *[settings[-1]] * fill]
    sources = LabelSources(
        views=starts[0].sources.views,
        depths=jnp.stack([start.sources.depths for start in starts]),
        blocks=stack_arms([start.sources.blocks for start in starts]),
    )
    states = stack_states([start.state for start in starts])
    return states, ArmsData(photographs, sources, stack_arms(settings))


def train_in_turn(
    training: Training, arm: Arm, seed: int, start: LabelStart, scorer: ArmScorer
) -> None:
    """Train and score one arm on views that are labeled before its first step.

    `test_time`, which takes other steps than `control`, has a control of its own.
    """
    programs, preset = training.programs, training.programs.preset
    state, steps, control = start.state, preset.closeup_steps, None
    get_detail = detail_getter(programs, state)
    if arm.kind == "test_time":
        assert programs.scene.test is not None  # `choose_arms` leaves out arms that need it
        cameras = programs.scene.test.cameras
        state, data, steps, _ = prepare_target_views(
            programs, start, cameras, arm.labels, arm.settings, get_detail
        )
        rate = arm.settings.lr_scale
        if preset.targets is not None:
            rate = jnp.float32(preset.targets.control_lr_scale)
        control = TrainData(data.views, rate)
    else:
        exact = scorer.held_out.exact
        labels = label_arm(programs, arm, run_keys(seed), start, get_detail, exact)
        data = LabeledData(programs.photographs, labels, arm.settings)
    _train_and_score(training, (arm.name, seed), state, data, steps, scorer)
    if control is not None:
        own = f"{arm.name}{OWN_CONTROL}", seed
        _train_and_score(training, own, start.state, control, steps, scorer)


def _train_and_score(
    training: Training,
    arm: tuple[str, int],
    state: TrainState,
    data: StepData,
    steps: int,
    scorer: ArmScorer,
) -> None:
    """Train and score an arm, a name and a seed; leave out one that is no longer finite."""
    stage = f"{arm[0]}_{arm[1]}"
    try:
        state = train_stage(training, stage, state, data, steps=steps)
    except TrainingError as error:
        print(f"{stage} is left out: {error}")
        return
    scorer.score(*arm, state, count_skipped(training.history[stage]))


def label_arm(
    programs: Programs,
    arm: Arm,
    keys: RunKeys,
    start: LabelStart,
    get_detail: GetDetail,
    exact: jax.Array | None,
) -> Views:
    """Return the labeled views of an arm that trains in turn, other than `test_time`."""
    scene, sources = programs.scene, start.sources
    if arm.depth_error is None and arm.labels.label == "residual":
        return label_closeups(programs, start, arm.labels, keys, get_detail)
    assert exact is not None  # `choose_arms` leaves out arms that need it
    if arm.depth_error is None:
        blurred = arm.kind == "resolved"
        return true_close_ups(keys.ceilings, scene, sources, exact, arm.settings, blurred=blurred)
    render = functools.partial(programs.render, start.state)
    return labels_with_better_depth(
        keys.ceilings,
        scene,
        sources,
        exact,
        functools.partial(rendered_depths, render, scene=scene),
        arm.settings,
        share=arm.depth_error,
    )


def count_skipped(history: Sequence[Mapping[str, Any]]) -> int:
    """Count the steps of a stage that were skipped because they were not finite."""
    return sum(chunk["skipped"] for chunk in history)
