"""All arms of a sweep on one scene, from one baseline a seed."""

import dataclasses
import functools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.run.fine_tuning import target_data
from jaxcloseup.app.run.kept_detail import FindDetail, detail_finder
from jaxcloseup.app.run.logs import TrainLog
from jaxcloseup.app.run.loop import TrainingError
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.scoring import HeldOut, hold_out
from jaxcloseup.app.run.setup import (
    LabelStart,
    Training,
    identity_of,
    label_closeups,
    rendered_depths,
    say_which_points_fit,
    start_labels,
)
from jaxcloseup.app.score.metrics_text import SPLIT_TITLES
from jaxcloseup.app.score.scores import NO_PERCEPTUAL, Perceptual, evaluate
from jaxcloseup.app.score.targets import Target
from jaxcloseup.app.sweep.arms import Arm, describe, make_arm, why_not
from jaxcloseup.app.sweep.ceilings import labels_with_better_depth, true_close_ups
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.labels.make import LabelSources, PseudoSettings
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views
from jaxcloseup.training.steps import TrainState


SHOWN = 2  # views of a split


class SweepOutcome(NamedTuple):
    """What a sweep found on one scene.

    Attributes:
      scores: for each arm, then seed, `skipped` steps and the metrics of each split in `splits`.
      shown: the first held-out views of each split.
      images: the first seed's renders of these, by arm and split, then by name.
    """

    scores: dict[str, dict[str, Any]]
    shown: dict[str, Sequence[Target]]
    images: dict[tuple[str, str], dict[str, np.ndarray]]


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

    Args:
      scene: what was photographed.
      preset: how stage 1 trains, and all that an arm does not change.
      arms: their names.
      seeds: how many.
      folder: for checkpoints; the same sweep resumes from those it holds.
      names: "method" and "preset" by name.
      max_parallel: arms and seeds trained at once.
      perceptual: networks of LPIPS.
      seconds: filled with the wall time of each stage.
      log: gets every report.
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
    scorer = ArmScorer(programs, hold_out(programs, starts.of(0)), chosen, perceptual)
    for seed in range(seeds):
        if "baseline" in scorer.scores:
            scorer.score("baseline", seed, starts.of(seed).state, starts.skipped[seed])
    for first in range(0, len(together), max_parallel):
        group = together[first : first + max_parallel]
        train_together(training, f"arms_{first // max_parallel}", group, starts, scorer)
    for arm, seed in in_turn:
        train_in_turn(training, arm, seed, starts.of(seed, arm.labels.expected_depth), scorer)
    return scorer.outcome()


def choose_arms(names: Sequence[str], preset: Preset, scene: Scene) -> list[Arm]:
    """The arms that a scene can have; prints why it cannot have others."""
    arms = [make_arm(name, preset) for name in names]
    for arm in arms:
        if why_not(arm, scene):
            print(f"no {arm.name} on {scene.name}: {why_not(arm, scene)}")
    return [arm for arm in arms if not why_not(arm, scene)]


def order_arms(
    arms: Sequence[Arm], seeds: int
) -> tuple[list[tuple[Arm, int]], list[tuple[Arm, int]]]:
    """Pairs of arm and seed that train together, and those that train in turn."""
    pairs = [(arm, seed) for arm in arms for seed in range(seeds)]
    together = [pair for pair in pairs if not pair[0].in_turn and pair[0].kind != "baseline"]
    # Side by side, arms that look from the same places share their forward warps.
    together.sort(key=lambda pair: (pair[1], pair[0].outlook))
    return together, [pair for pair in pairs if pair[0].in_turn]


class Starts:
    """Baselines of all seeds, and what fine-tuning on labels begins with."""

    def __init__(self, training: Training, seeds: int) -> None:
        """Train a baseline for each seed."""
        self._programs = training.programs
        self._baselines: list[TrainState] = []
        self.skipped: list[int] = []
        for seed in range(seeds):
            self._baselines.append(training.train_baseline(f"baseline_{seed}", seed))
            self.skipped.append(count_skipped(training.history[f"baseline_{seed}"]))
        self._starts: dict[tuple[int, bool | None], LabelStart] = {}

    def of(self, seed: int, expected_depth: bool | None = None) -> LabelStart:
        """The start of a seed; `expected_depth` as in `LabelConfig`."""
        if (seed, expected_depth) not in self._starts:
            self._starts[seed, expected_depth] = start_labels(
                self._programs, self._baselines[seed], seed, expected_depth=expected_depth
            )
        return self._starts[seed, expected_depth]


class ArmScorer:
    """Scores arms on the held-out views.

    Attributes:
      scores: see `SweepOutcome`.
    """

    def __init__(
        self, programs: Programs, held_out: HeldOut, arms: Sequence[Arm], perceptual: Perceptual
    ) -> None:
        """Score nothing yet."""
        self.programs, self.held_out, self._perceptual = programs, held_out, perceptual
        targets = held_out.targets
        self._shown = {split: targets[split][:SHOWN] for split in SPLIT_TITLES if split in targets}
        self.scores: dict[str, dict[str, Any]] = {arm.name: {} for arm in arms}
        self._images: dict[tuple[str, str], dict[str, np.ndarray]] = {}

    def score(self, arm: str, seed: int, state: TrainState, skipped: int) -> None:
        """Render and score one arm of one seed."""
        with progress.part(f"{arm}_{seed}_evaluation"):
            self._score(arm, seed, state, skipped)

    def _score(self, arm, seed, state, skipped):
        splits = {}
        for split, targets in self.held_out.all.items():
            render = functools.partial(self.programs.render, state)
            splits[split], seen = evaluate(render, targets, self._perceptual)
            if seed == 0 and split in self._shown:
                shown = self._shown[split]
                self._images[arm, split] = {view.name: seen[view.name].rgb for view in shown}
        self.scores[arm][str(seed)] = {"skipped": skipped, "splits": splits}

    def outcome(self) -> SweepOutcome:
        """Everything that was scored, with arms in the order in which the user named them."""
        order = {arm: i for i, arm in enumerate(self.scores)}
        pairs = sorted(self._images.items(), key=lambda pair: order[pair[0][0]])
        return SweepOutcome(self.scores, self._shown, dict(pairs))


def train_together(
    training: Training,
    name: str,
    group: Sequence[tuple[Arm, int]],
    starts: Starts,
    scorer: ArmScorer,
) -> None:
    """Train and score arms as one program."""
    print(f"{name}: " + ", ".join(f"{arm.name} {seed}" for arm, seed in group))
    begun = [starts.of(seed, arm.labels.expected_depth) for arm, seed in group]
    state, sources, settings = stack_arms(
        [arm.settings for arm, _ in group], begun, len(jax.devices())
    )
    steps = training.programs.preset.closeup_steps
    views = training.programs.photographs
    states = training.train(name, "arms", state, views, sources, settings, steps=steps)
    # A slice of what lies on all devices would too: each would render it, in step with the others,
    # while threads render several views at once.
    states = jax.device_put(states, jax.local_devices()[0])
    for i, (arm, seed) in enumerate(group):
        alone = jax.tree.map(lambda leaf, i=i: leaf[i], states.replace(step=None))
        skipped = sum(chunk["skipped"][i] for chunk in training.history[name])
        scorer.score(arm.name, seed, alone.replace(step=states.step), skipped)


def stack_arms(
    settings: Sequence[PseudoSettings], starts: Sequence[LabelStart], devices: int
) -> tuple[TrainState, LabelSources, PseudoSettings]:
    """States, sources and settings with a leading axis of arms, as `Programs.run` takes them.

    Arms share the count of steps and the photographs. The last arm is repeated until each device
    has as many.
    """
    fill = -len(starts) % devices
    starts, settings = [*starts, *[starts[-1]] * fill], [*settings, *[settings[-1]] * fill]

    def stack(records):
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *records)

    states = stack([start.state for start in starts])
    first = starts[0].sources
    sources = LabelSources(
        first.views,
        jnp.stack([start.sources.depths for start in starts]),
        stack([start.sources.blocks for start in starts]),
    )
    return states.replace(step=states.step[0]), sources, stack(settings)


def train_in_turn(
    training: Training, arm: Arm, seed: int, start: LabelStart, scorer: ArmScorer
) -> None:
    """Train and score one arm on views that are labeled before its first step."""
    name, programs = f"{arm.name}_{seed}", training.programs
    preset, scene = programs.preset, programs.scene
    find = detail_finder(programs, start.state)
    if arm.kind == "test_time":
        data = target_data(programs, start, scene.test.cameras, arm.labels, arm.settings, find)
        *learned, steps, _ = data
    else:
        labels = label_arm(programs, arm, seed, start, find, scorer.held_out.exact)
        learned = [start.state, programs.photographs, labels, arm.settings]
        steps = preset.closeup_steps
    try:
        state = training.train(name, "target_views", *learned, steps=steps)
    except TrainingError as error:
        print(f"{name} is left out: {error}")
        return
    scorer.score(arm.name, seed, state, count_skipped(training.history[name]))


def label_arm(
    programs: Programs,
    arm: Arm,
    seed: int,
    start: LabelStart,
    find: FindDetail,
    exact: jax.Array | None,
) -> Views:
    """The labeled views of an arm that trains in turn, other than `test_time`."""
    scene, key = programs.scene, jax.random.key(seed)
    if arm.depth_error is not None:
        render = functools.partial(programs.render, start.state)
        return labels_with_better_depth(
            key,
            scene,
            start.sources,
            exact,
            functools.partial(rendered_depths, render, scene=scene),
            arm.settings,
            share=arm.depth_error,
        )
    if arm.labels.label == "residual":
        return label_closeups(programs, start, arm.labels, seed, find)
    blurred = arm.kind == "resolved"
    return true_close_ups(key, scene, start.sources, exact, arm.settings, blurred=blurred)


def count_skipped(history: Sequence[Mapping[str, Any]]) -> int:
    """Steps of a stage that were skipped because they were not finite."""
    return sum(chunk["skipped"] for chunk in history)
