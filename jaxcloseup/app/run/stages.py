"""The stages of a run on one scene: baseline, control, closeup, detail, test_time."""

import dataclasses
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.run.corrected_poses import corrects_poses, kept_or_corrected
from jaxcloseup.app.run.exposed import expose, render_exposed
from jaxcloseup.app.run.fine_tuning import prepare_target_views
from jaxcloseup.app.run.gate import gated, uses_labels, weigh
from jaxcloseup.app.run.kept_detail import GetDetail, detail_getter, detail_path, detailed
from jaxcloseup.app.run.keys import RunKeys, run_keys
from jaxcloseup.app.run.labels import LabelStart, label_closeups, start_labels
from jaxcloseup.app.run.loop import Training, train_stage
from jaxcloseup.app.run.measured_exposures import write_exposures
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.scoring import HeldOut, Scorer, hold_out
from jaxcloseup.app.run.stage_names import STAGES
from jaxcloseup.app.run.states import match, say_which_points_fit, train_baseline, train_coarse
from jaxcloseup.app.run.step_data import CloseupData, LabeledData, StepData, TrainData
from jaxcloseup.app.run.timers import forget_compiled, timed
from jaxcloseup.app.score.audit import audit_labels, left_out_curve
from jaxcloseup.app.score.expected_errors import compare_errors
from jaxcloseup.app.score.renders import write_truth
from jaxcloseup.app.score.scores import NO_PERCEPTUAL, Perceptual
from jaxcloseup.detail.add import Detailed
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.labels.make import PseudoSettings, label_sources
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.exposures import Taken
from jaxcloseup.training.state import TrainState


Render = Callable[[Camera], Rendering]


class Outcome(NamedTuple):
    """Everything that the report of a run needs from its stages."""

    start: LabelStart  # what fine-tuning began with
    settings: PseudoSettings  # how labels are made, after the gate
    held_out: HeldOut  # the views that were scored
    scores: Mapping[str, Mapping[str, Any]]  # by stage and split
    # Renders of held-out views, by stage and split, then by name.
    images: Mapping[tuple[str, str], Mapping[str, np.ndarray]]
    # For JSON. `labels`: labels against the truth, by the depth they are made from, empty on
    # captures. `left_out`: `error_curve` of labels of left-out photographs. `gate`: see `weigh`.
    # `detail`: see `add_detail_stage`; None without.
    evidence: Mapping[str, Any]
    render: Render  # `camera -> Rendering` as the last stage renders


@dataclasses.dataclass
class Run:
    """What the stages of a run share."""

    training: Training
    keys: RunKeys
    folder: pathlib.Path
    start: LabelStart  # what fine-tuning begins with
    scorer: Scorer
    # The evidence of the left-out photographs, or None without a gate.
    gate: Mapping[str, Any] | None
    settings: PseudoSettings  # how close-ups are labeled, after the gate
    stage: str  # name of the latest stage that trained
    state: TrainState

    @property
    def programs(self) -> Programs:
        """Return the compiled programs."""
        return self.training.programs

    def train(
        self,
        stage: str,
        state: TrainState,
        data: StepData,
        *,
        steps: int | None = None,
        begins_at: str = "",
    ) -> TrainState:
        """Train and score a stage; by default for as many steps as `closeup`."""
        steps = self.programs.preset.closeup_steps if steps is None else steps
        state = train_stage(self.training, stage, state, data, steps=steps, begins_at=begins_at)
        self.scorer.score(stage, state)
        return state

    def render(self, camera: Camera, taken: Taken | None = None) -> Rendering:
        """Render the latest state, see `render_exposed`."""
        return render_exposed(self.programs, self.state, camera, taken)

    def get_detail(self, stage: str, state: TrainState) -> GetDetail:
        """Return a function that finds the detail of a stage's state in the folder, or makes it."""
        return detail_getter(self.programs, state, detail_path(self.folder, stage))


def run_stages(
    training: Training,
    seed: int,
    output_dir: pathlib.Path,
    *,
    to_run: Sequence[str] = STAGES,
    perceptual: Perceptual = NO_PERCEPTUAL,
) -> Outcome:
    """Train and score the stages of one seed.

    `baseline` always runs; `output_dir` gets renders and exports.
    """
    run = train_baseline_stage(training, run_keys(seed), output_dir, perceptual)
    preset = run.programs.preset
    # Without labels `closeup` is its control: the same steps on the same photographs.
    labeled = uses_labels(preset.labels, run.gate)
    if "control" in to_run or ("closeup" in to_run and not labeled):
        scale = preset.labels.lr_scale
        data = TrainData(run.programs.photographs, None if scale == 1 else jnp.float32(scale))
        run.stage, run.state = "control", run.train("control", run.start.state, data)
    if "closeup" in to_run and labeled:
        closeups = closeup_data(run)
        run.stage, run.state = "closeup", run.train("closeup", run.start.state, closeups)
    elif "closeup" in to_run:
        run.scorer.repeat("closeup", of="control")
    get_detail = run.get_detail(run.stage, run.state)
    detail: dict[str, Any] | None = None
    render: Render = run.render
    if "detail" in to_run:
        forget_compiled()
        detail, render = add_detail_stage(run, get_detail)
    if "test_time" in to_run:
        forget_compiled()
        train_for_target_views(run, get_detail, controlled="control" in to_run)
    with timed(training.seconds, "audit"):
        audit = audit_all(run)
    return Outcome(
        start=run.start,
        settings=run.settings,
        held_out=run.scorer.held_out,
        scores=run.scorer.scores,
        images=run.scorer.images,
        evidence={**audit, "gate": run.gate, "detail": detail},
        render=render,
    )


def train_baseline_stage(
    training: Training, keys: RunKeys, output_dir: pathlib.Path, perceptual: Perceptual
) -> Run:
    """Train and score `baseline`, and prepare what the other stages share."""
    programs, labels, coarse = training.programs, training.programs.preset.labels, None
    say_which_points_fit(programs)
    if corrects_poses(programs.preset, programs.scene):
        coarse = train_coarse(training, "baseline", keys)
        with timed(training.seconds, "poses"):
            programs = training.programs = kept_or_corrected(programs, coarse, output_dir)
    match(training)
    # A run that is cut off is rendered with them, too.
    write_exposures(output_dir, programs.exposures, programs.scene.names["train"])
    state = train_baseline(training, "baseline", keys, coarse)
    with timed(training.seconds, "depths"):
        start = start_labels(programs, state, expected_depth=labels.expected_depth)
        held_out = hold_out(programs, start)
    write_truth(output_dir / "renders" / "truth", held_out.all)
    scorer = Scorer(training, held_out, output_dir, perceptual)
    scorer.score("baseline", start.state)  # the depth of all stages is the one that labels use
    with timed(training.seconds, "gate"):
        gate = weigh(programs, start)
    settings = gated(labels, gate)
    return Run(training, keys, output_dir, start, scorer, gate, settings, "baseline", start.state)


def closeup_data(run: Run) -> CloseupData | LabeledData:
    """Return what the steps of `closeup` learn from: labels, or what each step labels."""
    programs, labels = run.programs, run.programs.preset.labels
    if labels.label == "warp":
        return CloseupData(programs.photographs, run.start.sources, run.settings)
    get_detail = run.get_detail("baseline", run.start.state)
    with timed(run.training.seconds, "closeup_labels"):
        views = label_closeups(programs, run.start, labels, run.keys, get_detail)
    return LabeledData(programs.photographs, views, run.settings)


def add_detail_stage(run: Run, get_detail: GetDetail) -> tuple[dict[str, Any], Render]:
    """Score the renders of the latest stage again with the photographs' detail.

    Returns:
      A record for JSON: the `stage`, what `find_detail` says, and how the expected errors compare
      with the actual ones; and a function that renders with detail.
    """
    programs, state, scorer = run.programs, run.state, run.scorer
    with timed(run.training.seconds, "detail"):
        detail, about = get_detail()

    def render(camera: Camera, taken: Taken | None = None) -> Rendering:
        rendering = programs.render(state, camera)
        sharper = detailed(programs, detail, camera, rendering)
        return rendering._replace(rgb=expose(programs, sharper.rgb, rendering, taken))

    def detail_of(camera: Camera) -> Detailed:
        return detailed(programs, detail, camera, programs.render(state, camera))

    scorer.score("detail", state, render)
    with timed(run.training.seconds, "expected_errors"):
        splits = (name for name in programs.scene.names if name != "train")
        targets = [target for name in splits for target in scorer.held_out.reduced(name)]
        errors = compare_errors(detail_of, targets)
    return {"stage": run.stage, **about, **errors}, render


def train_for_target_views(run: Run, get_detail: GetDetail, *, controlled: bool) -> None:
    """Train and score `test_time`, and its control: as many steps on the same photographs alone."""
    programs, preset, scene = run.programs, run.programs.preset, run.programs.scene
    if scene.test is None:
        print(f"no test_time: {scene.name} holds out no close-ups (--split=closest does)")
        return
    labels, start, begins_at = preset.target_labels, run.start, "baseline"
    if labels.label == "residual":  # the detail of the latest state is there, or made anyway
        start, begins_at = start._replace(state=run.state), run.stage
    settings = gated(labels, run.gate)
    with timed(run.training.seconds, "test_time_labels"):
        prepared = prepare_target_views(
            programs, start, scene.test.cameras, labels, settings, get_detail
        )
    labeled = uses_labels(labels, run.gate)
    if controlled or not labeled:
        rate = settings.lr_scale
        if preset.targets is not None:
            rate = jnp.float32(preset.targets.control_lr_scale)
        data = TrainData(prepared.data.views, rate)
        control = run.train(
            "test_time_control", start.state, data, steps=prepared.steps, begins_at=begins_at
        )
    if labeled:
        run.train(
            "test_time", prepared.state, prepared.data, steps=prepared.steps, begins_at=begins_at
        )
    else:
        run.scorer.score("test_time", control)


def audit_all(run: Run) -> dict[str, Any]:
    """Compare labels with the truth, for each depth they can have, and with left-out photographs.

    Returns:
      `labels` and `left_out`, see `Outcome`.
    """
    programs, start, scene = run.programs, run.start, run.programs.scene
    exact, labels = run.scorer.held_out.exact, {}

    def render(camera: Camera) -> Rendering:
        return programs.render(start.state, camera)

    if exact is not None:
        assert scene.surface is not None
        exact_sources, surface = jax.jit(label_sources)(scene.train, exact), scene.surface
        ways = {
            "exact_depth": (exact_sources, lambda camera: surface(camera).depth),
            "trained_depth": (start.sources, lambda camera: label_depth(render(camera))),
        }
        labels = {
            name: audit_labels(
                run.keys.audit, exact, scene, sources, run.settings, render_depth=render_depth
            )
            for name, (sources, render_depth) in ways.items()
        }
    return {"labels": labels, "left_out": left_out_curve(start.sources, render, run.settings)}
