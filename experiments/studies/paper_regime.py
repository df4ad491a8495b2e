"""Tables of the paper's regime: whole photographs of 960 x 540, the papers' own training lengths.

    python -m experiments.studies.paper_regime --capture=path/to/plush

makes a run of surfels for each scene in `outputs/studies`, continues its baseline in further arms,
makes runs of other baselines as long, and prints the tables. Whatever is there already is read, and
what was cut off is resumed, arm by arm. `--print_only` prints the scenes that are finished. With
`--given=photographs=30,choose=first` close-ups look from directions that no photograph has.
"""

import itertools
import math
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from absl import flags

from experiments.studies.tables import (
    CLOSEUPS,
    ORDINARY,
    Results,
    field_and_detail,
    finished_runs,
    format_gain,
    gains,
    pair,
    print_table,
)
from experiments.studies.trained_run import open_run
from jaxcloseup.app.cli.start import loading, set_up_compilation_cache, start
from jaxcloseup.app.methods.nerf import RELEASED
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.run.labels import LabelStart, start_labels
from jaxcloseup.app.run.loop import Training, train_stage
from jaxcloseup.app.run.scoring import hold_out
from jaxcloseup.app.run.step_data import CloseupData
from jaxcloseup.app.score.scores import find_perceptual
from jaxcloseup.app.sweep.arm_scoring import ArmScorer
from jaxcloseup.app.sweep.arm_training import train_in_turn
from jaxcloseup.app.sweep.named_arms import Arm, describe, make_arm
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.io.files import read_object, write_json


FLAGS = flags.FLAGS
_BASELINES = {"3DGS": "gaussians", "Mip-Splatting": "mip_gaussians"}
_SCRIPT = RELEASED.labels
# Arms beside a run's own stages, as `sweep --arms` names them, by what they are.
ARMS = {
    "labels by the script": (
        f"magnification={_SCRIPT.magnification[0]:g}:{_SCRIPT.magnification[1]:g}"
        f"+anchor_tolerance={_SCRIPT.anchor_tolerance:g}+rgb_tolerance={_SCRIPT.rgb_tolerance:g}"
        f"+depth_tolerance={_SCRIPT.depth_tolerance:g}+forward_label=true"
    ),
    "labels by detail": "label=residual",
    "test time, labels by detail": "test_time+label=residual",
}
# Rows of the table: a stage of a run or an arm, and the one that took as many steps without labels.
_ROWS = {
    "baseline": ("baseline", "baseline"),
    "control": ("control", "control"),
    "labels by the text": ("closeup", "control"),
    "labels by the script": ("labels by the script", "control"),
    "labels by detail": ("labels by detail", "control"),
    "test time, control": ("test_time_control", "test_time_control"),
    "test time, labels by the text": ("test_time", "test_time_control"),
    "test time, labels by detail": ("test time, labels by detail", "test_time_control"),
}
# Steps from the paper's baseline to ours: flags of runs, each with those before it since a preset.
LADDER = {
    "paper": ("--preset=paper",),
    "scales at most 0.1 extents": ("--set=max_scale=0.1",),
    "antialiasing": ("--set=raster.antialias=true",),
    "windows, a coarse model first, shorter": ("--preset=quick", "--set=stereo.pixels=0"),
    "depth by stereo (quick)": ("--preset=quick",),
}
# What `--shorter` divides: settings of presets that are counts of steps before the close-ups.
_LENGTHS = ("baseline_steps", "means_lr_steps", "sh_every", "regularize_from")
_DENSITY_LENGTHS = ("every", "start", "stop", "reset_every")
_ALONE = ("--stages=control,detail",)  # of runs of the ladder alone
_GROUPED = ("labels by the text", "labels by detail", "render with detail")
# What close-ups are grouped by, as `describe_proximity` names it, and the bounds of groups.
_GROUPS = {
    "ray_angle": ("degrees to the nearest photograph", (0, 10, 20, 30, 45, 181)),
    "depth_ratio": ("ratio of depths", (0, 1.5, 2.5, 4, 6, math.inf)),
}


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("scenes", ["table", "counter", "stairs"], "drawn scenes")
    flags.DEFINE_string("capture", None, "folder of a real capture")
    flags.DEFINE_string("preset", "paper", "preset of surfels: paper or paper_adaptive")
    flags.DEFINE_list("baselines", list(_BASELINES), "other methods to train as long")
    flags.DEFINE_list("given", [], "further flags of every run, such as split=zoom")
    flags.DEFINE_integer("shorter", 1, "divide all lengths of stage 1 by so much", lower_bound=1)
    flags.DEFINE_bool("ladder", False, "go from the paper's baseline to ours instead")
    flags.DEFINE_bool("print_only", False, "train nothing")
    flags.DEFINE_string("output_dir", "outputs/studies", "folder of the runs to make")


def main(_: list[str]) -> None:
    """Train what is missing, scene by scene, and print the tables."""
    with loading():
        set_up_compilation_cache(None)
    scenes = [*FLAGS.scenes, *filter(None, [FLAGS.capture])]
    for scene in scenes:
        if FLAGS.ladder:
            print_ladder(pathlib.Path(scene).name, ladder_results(scene))
            continue
        name, results, others = scene_results(scene)
        if results.get("stages"):
            print_scene(name, results, others)


def scene_results(scene: str) -> tuple[str, Results, dict[str, Results]]:
    """Return a scene's name, the results of its run with all arms, and those of other baselines."""
    name, folder = pathlib.Path(scene).name, _folder(FLAGS.preset)
    found = _run(folder, scene, *_of("surfels", FLAGS.preset))
    arms = {} if FLAGS.print_only else ARMS
    stages = {**found.get("stages", {}), **train_arms(folder / name, arms)}
    others = {}
    for title in FLAGS.baselines:
        method = _BASELINES[title]
        if other := _run(_folder(method), scene, *_of(method, "paper"), "--stages=baseline"):
            others[title] = other
    return name, {**found, "stages": stages}, others


def ladder_results(scene: str) -> dict[str, Results]:
    """Return the results of the runs that lead from the paper's baseline to ours, by step."""
    given: Sequence[str] = ()
    found = {}
    for index, (title, added) in enumerate(LADDER.items()):
        if added[0].startswith("--preset="):
            given, added = _of("surfels", added[0].removeprefix("--preset=")), added[1:]
        given = [*given, *added]
        folder = _folder(f"ladder_{index}")
        if not index and (_folder("paper") / pathlib.Path(scene).name / "results.json").exists():
            folder = _folder("paper")  # of the other tables
        if results := _run(folder, scene, *given, *_ALONE):
            found[title] = results
    return found


def _of(method: str, preset: str) -> list[str]:
    """Return the flags of a run: its preset, how much shorter that is, and what all are given."""
    shown = [f"--method={method}", f"--preset={preset}"]
    if FLAGS.shorter > 1 and preset.startswith("paper"):
        shown += [
            f"--set={text}" for text in shorter(METHODS[method].presets[preset], FLAGS.shorter)
        ]
    return shown + [f"--{text}" for text in FLAGS.given]


def shorter(preset: Any, factor: int) -> list[str]:
    """Return settings, `name=value`, that divide all lengths of stage 1 of a preset of splats."""
    parts = [("", preset, _LENGTHS), ("", preset.field, _LENGTHS)]
    parts += [("density.", preset.field.density, _DENSITY_LENGTHS)]
    return [
        f"{path}{name}={max(1, getattr(part, name) // factor)}"
        for path, part, names in parts
        for name in names
        if hasattr(part, name)
    ]


def _folder(kind: str) -> pathlib.Path:
    """Return the folder of the runs of a kind, with the flags that all runs are given."""
    words = [kind, *(text.replace("=", "_") for text in FLAGS.given)]
    words += [f"shorter_{FLAGS.shorter}"] * (FLAGS.shorter > 1)
    return pathlib.Path(FLAGS.output_dir) / "_".join(words)


def _run(folder: pathlib.Path, scene: str, *arguments: str) -> Results:
    """Return the results of a run in `folder/<scene>`; nothing of one that is not to be made."""
    if FLAGS.print_only and not (folder / pathlib.Path(scene).name / "results.json").exists():
        return {}
    return next(iter(finished_runs([], folder, [scene], *arguments).values()))


def train_arms(folder: pathlib.Path, names: Mapping[str, str]) -> dict[str, Any]:
    """Continue a run's baseline in arms; return their scores by title and split.

    `arms.json` keeps them. Arms that are there are not trained again; one that was cut off resumes.
    """
    kept = folder / "arms.json"
    scores = read_object(kept) if kept.exists() else {}
    missing = {title: name for title, name in names.items() if title not in scores}
    if not missing:
        return scores
    run = open_run(folder, "baseline")
    programs, labels = run.programs, run.programs.preset.labels
    seed = read_object(folder / "checkpoints" / "run.json")["seed"]
    start = start_labels(programs, run.state, expected_depth=labels.expected_depth)
    arms = {title: make_arm(name, programs.preset) for title, name in missing.items()}
    scorer = ArmScorer(programs, hold_out(programs, start), [*arms.values()], find_perceptual())
    for title, arm in arms.items():
        checkpoints = Checkpoints(folder / "arms" / title.replace(" ", "_"), describe([arm]))
        train_arm(Training(programs, checkpoints), arm, seed, start, scorer)
        if str(seed) in scorer.scores[arm.name]:
            scores[title] = scorer.scores[arm.name][str(seed)]["splits"]
            write_json(kept, scores)
    return scores


def train_arm(
    training: Training, arm: Arm, seed: int, start: LabelStart, scorer: ArmScorer
) -> None:
    """Train and score an arm, with labels made before its first step or in each step."""
    if arm.in_turn:
        train_in_turn(training, arm, seed, start, scorer)
        return
    data = CloseupData(training.programs.photographs, start.sources, arm.settings)
    steps = training.programs.preset.closeup_steps
    state = train_stage(training, f"{arm.kind}_{seed}", start.state, data, steps=steps)
    scorer.score(arm.name, seed, state, 0)


def print_scene(name: str, results: Results, others: Mapping[str, Results]) -> None:
    """Print the arms of a scene, and gains by where the nearest photographs look from."""
    rows = []
    for title, (stage, over) in _rows(results).items():
        if stage in results["stages"]:
            compared = stage != over and over in results["stages"]
            both = (CLOSEUPS, ORDINARY) if compared else ()
            gained = [format_gain(gains(results, split, stage, over)) for split in both]
            gained = gained or ["-", "-"]
            rows.append([title, *_scores(results, stage), *gained])
    rows += [[title, *_scores(other, "baseline"), "-", "-"] for title, other in others.items()]
    header = ["arm", "close-ups: PSNR", "SSIM", "color-corrected", "resolves (px)"]
    header += ["ordinary views: PSNR", "SSIM", "gain over control (95 %)", "on ordinary views"]
    print_table(f"{name}, the paper's regime", header, rows)
    print_groups(name, results)


def _rows(results: Results) -> dict[str, tuple[str, str]]:
    """Return the rows, with detail over the stage that it is added to."""
    return _ROWS | {"render with detail": field_and_detail(results)[::-1]}


def print_ladder(name: str, found: Mapping[str, Results]) -> None:
    """Print the control of each step from the paper's baseline to ours, and what it adds."""
    rows, before = [], None
    for title, results in found.items():
        row = [title, *_scores(results, "control")]
        for split in (CLOSEUPS, ORDINARY):
            alike = before and gains(results, split, "control", "control", of=before)
            row.append(format_gain(alike) if alike else "-")
        detailed = field_and_detail(results)[0] == "control"  # that of labels is another field's
        rows.append([*row, *(_scores(results, "detail")[:1] if detailed else ["-"])])
        before = results
    header = ["with", "close-ups: PSNR", "SSIM", "color-corrected", "resolves (px)"]
    header += ["ordinary views: PSNR", "SSIM", "adds on close-ups (95 %)", "on ordinary views"]
    print_table(f"{name}, from the paper's baseline to ours", [*header, "with detail: PSNR"], rows)


def _scores(results: Results, stage: str) -> list[str]:
    """Return the scores of a stage as texts."""
    metrics = {"psnr": 2, "ssim": 3, "cc_psnr": 2, "resolves": 1}
    close = [pair(results, [stage], CLOSEUPS, name, digits) for name, digits in metrics.items()]
    return close + [
        pair(results, [stage], ORDINARY, name, metrics[name]) for name in ("psnr", "ssim")
    ]


def print_groups(name: str, results: Results) -> None:
    """Print gains of the close-ups of which a photograph saw a quarter, by how that looks at it."""
    stages = results["stages"]
    views = stages.get("control", {}).get(CLOSEUPS, {}).get("views", {})
    for measure, (title, bounds) in _GROUPS.items():
        rows = []
        for low, high in itertools.pairwise(bounds):
            chosen = [view for view, at in views.items() if low <= at.get(measure, -1) < high]
            if chosen:
                others = [f"{np.mean([views[view][m] for view in chosen]):.1f}" for m in _GROUPS]
                control = f"{np.mean([views[view]['psnr'] for view in chosen]):.2f}"
                gained = [_gain(stages, chosen, *_rows(results)[arm]) for arm in _GROUPED]
                rows.append([f"{low} to {high}", str(len(chosen)), *others, control, *gained])
        if rows:
            header = [title, "close-ups", "mean angle", "mean ratio", "control: PSNR", *_GROUPED]
            print_table(f"{name}, gain by {title}", header, rows)


def _gain(stages: Mapping[str, Any], views: Sequence[str], stage: str, over: str) -> str:
    """Format the mean gain of some close-ups."""
    if not {stage, over} <= set(stages):
        return "-"
    scores, others = (stages[name][CLOSEUPS]["views"] for name in (stage, over))
    return format_gain([scores[view]["psnr"] - others[view]["psnr"] for view in views])


if __name__ == "__main__":
    define_flags()
    start(sys.modules[__name__])
