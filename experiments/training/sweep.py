"""All arms of a sweep on one scene, from one baseline a seed."""

import functools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import jaxcloseup
from experiments.evaluation.ladder import ladder_targets
from experiments.evaluation.scores import (
    NO_PERCEPTUAL,
    Perceptual,
    evaluate,
    exact_depths,
    targets_by_split,
)
from experiments.methods.presets import Preset, pseudo_settings, test_time_steps
from experiments.reporting.pictures import comparisons
from experiments.reporting.report import SPLIT_TITLES, Picture
from experiments.training.arms import make_arm, why_not
from experiments.training.ceilings import labels_of_less_error, true_close_ups
from experiments.training.logs import TrainLog
from experiments.training.loop import Programs, TrainingError, run_stage
from experiments.training.manifest import hash_data, hash_wanted
from experiments.training.stages import (
    config,
    rendered_depths,
    say_what_is_left_out,
    state_to_begin,
    timed,
    training_depths,
)
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.geometry.union_warp import SourceBlocks, block_sources
from jaxcloseup.pseudo import PseudoSettings, label_views
from jaxcloseup.scenes import Scene
from jaxcloseup.train import TrainState


SHOWN = 2  # views of a split


class _Start(NamedTuple):
    """Where the arms of a seed begin."""

    state: TrainState
    depths: jax.Array
    sources: SourceBlocks
    skipped: int


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
    compare: pathlib.Path | None = None,
) -> tuple[dict[str, Any], list[Picture]]:
    """All arms of one scene.

    Args:
      scene: what is photographed.
      preset: of stage 1, and of all that an arm does not change.
      arms: their names.
      seeds: how many.
      folder: for checkpoints; those of the same sweep are gone on from.
      names: of "method" and "preset".
      max_parallel: arms and seeds trained at once.
      perceptual: networks of LPIPS.
      seconds: is filled with the wall time of each stage.
      log: is told of what is printed.
      compare: folder for pictures.

    Returns:
      For each arm the metrics of each seed and split, and of the first views of each split a
      picture of the truth and of all arms of the first seed; none without `compare`.
    """
    chosen = [make_arm(name, pseudo_settings(preset)) for name in arms]
    for arm in chosen:
        if why_not(arm, scene):
            print(f"no {arm.name} of {scene.name}: {why_not(arm, scene)}")
    chosen = [arm for arm in chosen if not why_not(arm, scene)]
    programs = Programs(preset, scene)
    views = jax.device_put(scene.train)
    identity = {"scene": scene.name, "config": config(preset), "seeds": seeds, **names}
    identity |= {"arms": {arm.name: str(jax.device_get(arm.settings)) for arm in chosen}}
    identity |= {"resolution": [views.cameras.width, views.cameras.height]}
    identity |= {"max_parallel": max_parallel, "devices": len(jax.devices())}
    identity |= {"version": jaxcloseup.__version__, "data_sha256": hash_data(scene)}
    identity["wanted_sha256"] = hash_wanted(scene)
    together = [(arm, seed) for arm in chosen for seed in range(seeds)]
    in_turn = [(arm, seed) for arm, seed in together if arm.in_turn]
    together = [pair for pair in together if not pair[0].in_turn and pair[0].kind != "baseline"]
    # Side by side, arms that look from the same places share their forward warps.
    together.sort(key=lambda pair: (pair[1], pair[0].outlook))
    # Rows of what is kept are told apart by their place.
    identity["together"] = [[arm.name, seed] for arm, seed in together]
    checkpoints = Checkpoints(folder, identity)
    seconds = {} if seconds is None else seconds

    def stage(name, *data, steps):
        with timed(seconds, name):
            kept = {"checkpoints": checkpoints, "save_every": 1000, "log": log}
            return run_stage(name, *data, steps=steps, **kept)

    starts = []

    def start_from(state, seed, skipped):
        depths = training_depths(programs, state, seed)
        sources = jax.jit(block_sources)(views.cameras, depths, views.weight)
        return _Start(state, depths, sources, skipped)

    say_what_is_left_out(programs)
    for seed in range(seeds):
        data = programs, "photographs", state_to_begin(programs, seed), views
        state, history = stage(f"baseline_{seed}", *data, steps=preset.baseline_steps)
        starts.append(start_from(state, seed, _skipped(history)))
    exact = exact_depths(scene, views.cameras) if scene.surface else None
    render = functools.partial(programs.render, starts[0].state)
    targets = targets_by_split(scene, starts[0].depths, exact, render)
    if exact is not None:
        targets |= ladder_targets(scene, exact)

    results: dict[str, Any] = {arm.name: {} for arm in chosen}

    shown = {split: targets[split][:SHOWN] for split in SPLIT_TITLES if split in targets}
    renderings: dict[str, dict[str, Any]] = {arm.name: {} for arm in chosen}

    def score(arm, seed, state, skipped):
        splits = {}
        for split, of_split in targets.items():
            render = functools.partial(programs.render, state)
            splits[split], seen = evaluate(render, of_split, perceptual)
            if seed == 0 and split in shown:
                renderings[arm][split] = {view.name: seen[view.name] for view in shown[split]}
        results[arm][str(seed)] = {"skipped": skipped, "splits": splits}

    @functools.cache
    def with_depth(expected, seed):
        start = starts[seed]
        flag = jnp.full_like(start.state.buffers.expected, expected)
        buffers = start.state.buffers.replace(expected=flag)
        return start_from(start.state.replace(buffers=buffers), seed, start.skipped)

    def begin(arm, seed):
        if arm.expected_depth is None:
            return starts[seed]
        return with_depth(arm.expected_depth, seed)

    for seed, start in enumerate(starts):
        if "baseline" in results:
            score("baseline", seed, start.state, start.skipped)
    for first in range(0, len(together), max_parallel):
        group = together[first : first + max_parallel]
        name = f"arms_{first // max_parallel}"
        begun = [begin(arm, seed) for arm, seed in group]
        states, history = _train_together(stage, name, programs, views, group, begun)
        for i, (arm, seed) in enumerate(group):
            alone = jax.tree.map(lambda leaf, i=i: leaf[i], states.replace(step=None))
            skipped = sum(chunk["skipped"][i] for chunk in history)
            score(arm.name, seed, alone.replace(step=states.step), skipped)
    for arm, seed in in_turn:
        start = starts[seed]
        steps = preset.closeup_steps
        render = functools.partial(programs.render, start.state)
        depths_of = functools.partial(rendered_depths, render, scene=scene, near=0.0)
        data = scene, start.depths, exact
        if arm.depth_error is not None:
            data = *data, depths_of, arm.settings
            labels = labels_of_less_error(jax.random.key(seed), *data, share=arm.depth_error)
        elif arm.kind != "test_time":
            blurred = arm.kind == "resolved"
            data = *data, arm.settings
            labels = true_close_ups(jax.random.key(seed), *data, blurred=blurred)
        else:
            cameras = scene.test.cameras
            data = cameras, depths_of(cameras), scene.train, start.depths, arm.settings
            labels = jax.jit(label_views)(*data, sources=start.sources)
            steps = test_time_steps(preset, len(scene.test))
        name = f"{arm.name}_{seed}"
        data = views, labels, arm.settings
        try:
            state, history = stage(name, programs, "targets", start.state, *data, steps=steps)
        except TrainingError as error:
            print(f"{name} is left out: {error}")
            continue
        score(arm.name, seed, state, _skipped(history))
    if compare is None:
        return results, []
    # Arms in the order in which they were named, whatever was trained first.
    by_arm = {(arm, split): seen for arm, of in renderings.items() for split, seen in of.items()}
    return results, comparisons(compare, shown, by_arm)


def _skipped(history: Sequence[Mapping[str, Any]]) -> int:
    return sum(chunk["skipped"] for chunk in history)


def stack_arms(
    group: Sequence[tuple[PseudoSettings, TrainState, jax.Array, SourceBlocks]], devices: int
) -> tuple[TrainState, jax.Array, PseudoSettings, SourceBlocks]:
    """States, depths, settings and sources with a leading axis of arms, as `Programs.run` takes.

    The last arm is repeated until each device has as many.
    """
    group = [*group, *[group[-1]] * (-len(group) % devices)]
    settings, states, depths, sources = (
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *column)
        for column in zip(*group, strict=True)
    )
    return states.replace(step=states.step[0]), depths, settings, sources


def _train_together(stage, name, programs, views, group, begun):
    arms = [
        (arm.settings, start.state, start.depths, start.sources)
        for (arm, _), start in zip(group, begun, strict=True)
    ]
    states, *data = stack_arms(arms, len(jax.devices()))
    print(f"{name}: " + ", ".join(f"{arm.name} {seed}" for arm, seed in group))
    steps = programs.preset.closeup_steps
    return stage(name, programs, "arms", states, views, *data, steps=steps)
