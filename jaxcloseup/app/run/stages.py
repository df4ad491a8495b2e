"""The stages of a run on one scene: baseline, control, closeup, test_time, detail."""

import functools
import itertools
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.run.fine_tuning import target_data
from jaxcloseup.app.run.gate import gated, lets_in, weigh
from jaxcloseup.app.run.kept_detail import FindDetail, detail_finder, detail_path, detailed
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.scoring import HeldOut, Scorer, hold_out
from jaxcloseup.app.run.setup import (
    LabelStart,
    Training,
    label_closeups,
    say_which_points_fit,
    start_labels,
    timed,
)
from jaxcloseup.app.run.stage_names import STAGES
from jaxcloseup.app.score.audit import audit_labels, left_out_curve
from jaxcloseup.app.score.expected_errors import compare_errors
from jaxcloseup.app.score.renders import write_truth
from jaxcloseup.app.score.scores import NO_PERCEPTUAL, Perceptual
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.labels.make import LabelSources, PseudoSettings, label_sources
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.views import Views
from jaxcloseup.training.steps import TrainState


class Outcome(NamedTuple):
    """Everything that the report of a run needs from its stages.

    Attributes:
      start: what fine-tuning began with.
      settings: how labels are made, after the gate.
      gate: the evidence of the left-out photographs, or None without a gate.
      held_out: the views that were scored.
      scores: by stage and split.
      images: renders of held-out views, by stage and split, then by name.
      audit: labels against the truth, by the depth they are made from; empty on captures.
      left_out: `error_curve` of labels of left-out photographs.
      detail: what `find_detail` says of the stage that got detail, with its `stage`; None without.
      render: `camera -> Rendering` as the last stage renders.
    """

    start: LabelStart
    settings: PseudoSettings
    gate: Mapping[str, Any] | None
    held_out: HeldOut
    scores: Mapping[str, Mapping[str, Any]]
    images: Mapping[tuple[str, str], Mapping[str, np.ndarray]]
    audit: Mapping[str, Any]
    left_out: Mapping[str, Any] | None
    detail: Mapping[str, Any] | None
    render: Callable[[Camera], Rendering]


def run_stages(
    training: Training,
    seed: int,
    output_dir: pathlib.Path,
    *,
    to_run: Sequence[str] = STAGES,
    perceptual: Perceptual = NO_PERCEPTUAL,
) -> Outcome:
    """Train and score the stages of one seed.

    Args:
      training: what trains.
      seed: random seed.
      output_dir: folder for renders and exports.
      to_run: names of stages; `baseline` always runs.
      perceptual: networks of LPIPS.
    """
    programs = training.programs
    preset, scene, photographs = programs.preset, programs.scene, programs.photographs
    say_which_points_fit(programs)
    baseline = training.train_baseline("baseline", seed)
    with timed(training.seconds, "depths"):
        expected = preset.labels.expected_depth
        start = start_labels(programs, baseline, seed, expected_depth=expected)
        held_out = hold_out(programs, start)
    write_truth(output_dir / "renders" / "truth", held_out.all)
    scorer = Scorer(training, held_out, output_dir, perceptual)
    scorer.score("baseline", baseline)
    with timed(training.seconds, "gate"):
        gate = weigh(programs, start)
    settings = gated(preset.labels, gate)
    latest = "baseline", baseline

    def find(stage, state):
        return detail_finder(programs, state, detail_path(output_dir, stage))

    def continue_from(state, stage, kind, *data):
        steps = preset.closeup_steps
        state = training.train(stage, kind, state, photographs, *data, steps=steps)
        scorer.score(stage, state)
        return stage, state

    # Without labels `closeup` is its control: the same steps on the same photographs.
    use_labels = lets_in(preset.labels, gate)
    if "control" in to_run or ("closeup" in to_run and not use_labels):
        latest = continue_from(baseline, "control", "photographs")
    if "closeup" in to_run and use_labels:
        kind, labels = closeup_labels(training, start, seed, find("baseline", start.state))
        latest = continue_from(start.state, "closeup", kind, labels, settings)
    elif "closeup" in to_run:
        scorer.score("closeup", latest[1])
    detail, render = None, functools.partial(programs.render, latest[1])
    find_latest = find(*latest)
    if "detail" in to_run:
        detail, render = add_detail_stage(training, scorer, held_out, *latest, find_latest)
    if "test_time" in to_run and scene.test is None:
        print(f"no test_time: {scene.name} holds out no close-ups (--split=closest does)")
    elif "test_time" in to_run:
        by_detail = preset.target_labels.label == "residual"
        # The detail of the latest state is there, or made anyway.
        begin = start._replace(state=latest[1]) if by_detail else start
        train_for_targets(
            *(training, scorer, begin, gate, find_latest), controlled="control" in to_run
        )
    with timed(training.seconds, "audit"):
        audit, left_out = audit_all(programs, start, held_out.exact, settings, seed)
    return Outcome(
        *(start, settings, gate, held_out, scorer.scores, scorer.images),
        *(audit, left_out, detail, render),
    )


def train_for_targets(
    training: Training,
    scorer: Scorer,
    start: LabelStart,
    gate: Mapping[str, Any] | None,
    find: FindDetail,
    *,
    controlled: bool,
) -> None:
    """Train and score `test_time`, and its control: as many steps on the same photographs alone."""
    programs, stage, control = training.programs, "test_time", "test_time_control"
    with timed(training.seconds, "test_time_labels"):
        how, cameras = programs.preset.target_labels, programs.scene.test.cameras
        data = target_data(programs, start, cameras, how, gated(how, gate), find)

    def train(name, kind, state, *labels):
        state = training.train(name, kind, state, data.photographs, *labels, steps=data.steps)
        scorer.score(name, state)
        return state

    labeled = lets_in(how, gate)
    if controlled or not labeled:
        targets = programs.preset.targets
        rate = data.settings.lr_scale if targets is None else jnp.float32(targets.control_lr_scale)
        without = train(control, "photographs", start.state, rate)
    if labeled:
        train(stage, "target_views", data.state, data.labels, data.settings)
    else:
        scorer.score(stage, without)


def add_detail_stage(
    training: Training,
    scorer: Scorer,
    held_out: HeldOut,
    stage: str,
    state: TrainState,
    find: FindDetail,
) -> tuple[dict[str, Any], Callable[[Camera], Rendering]]:
    """Score the renders of a stage again with the photographs' detail; its record, and them.

    The record has what `find_detail` says, and `errors`, expected and actual ones.
    """
    programs = training.programs
    with timed(training.seconds, "detail"):
        detail, about = find()

    def render(camera):
        rendering = programs.render(state, camera)
        return rendering._replace(rgb=detailed(programs, detail, camera, rendering).rgb)

    def detail_of(camera):
        return detailed(programs, detail, camera, programs.render(state, camera))

    scorer.score("detail", state, render)
    with timed(training.seconds, "expected_errors"):
        targets = (held_out.targets[name] for name in programs.scene.names if name != "train")
        errors = compare_errors(detail_of, list(itertools.chain(*targets)))
    return {"stage": stage, **about, "errors": errors}, render


def closeup_labels(
    training: Training, start: LabelStart, seed: int, find: FindDetail
) -> tuple[str, LabelSources | Views]:
    """The kind of steps of `closeup`, and its labels, or what each step makes them from."""
    programs = training.programs
    if programs.preset.labels.label == "warp":
        return "random_closeups", start.sources
    with timed(training.seconds, "closeup_labels"):
        labels = label_closeups(programs, start, programs.preset.labels, seed, find)
    return "target_views", labels


def audit_all(
    programs: Programs,
    start: LabelStart,
    exact: jax.Array | None,
    settings: PseudoSettings,
    seed: int,
) -> tuple[dict[str, Any], Mapping[str, Any] | None]:
    """Labels against the truth, for each depth they can have, and against left-out photographs."""
    _, key, _ = jax.random.split(jax.random.key(seed), 3)
    scene, render = programs.scene, functools.partial(programs.render, start.state)
    audit = {}
    if exact is not None:
        ways = {
            "exact_depth": (
                jax.jit(label_sources)(scene.train, exact),
                lambda camera: scene.surface(camera).depth,
            ),
            "trained_depth": (start.sources, lambda camera: label_depth(render(camera))),
        }
        audit = {
            name: audit_labels(key, exact, scene, sources, settings, render_depth=render_depth)
            for name, (sources, render_depth) in ways.items()
        }
    return audit, left_out_curve(start.sources, render, settings)
