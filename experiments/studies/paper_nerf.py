"""Train the paper's NeRF in pieces, each short enough for a GPU that is lent for minutes.

    python -m experiments.studies.paper_nerf --state=folder --minutes=9

takes as many steps as fit, keeps the state in the folder, and exits with 1 while more is left. The
same command goes on, also on another computer that has the folder, until all stages are trained and
scored: `baseline`; `control` and `closeup`, which continue it with as many steps; and
`test_time_control` and `test_time`. `scores.json` holds the scores of each view. The folder stays
below 64 MiB: of the stages after `baseline`, only the one in training has a state.
"""

import dataclasses
import pathlib
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
from absl import flags

from experiments.studies.tables import CLOSEUPS, ORDINARY, format_gain, gains, pair, print_table
from jaxcloseup.app import progress
from jaxcloseup.app.cli.start import in_one_sentence, loading, set_up_compilation_cache, start
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import with_settings
from jaxcloseup.app.run.fine_tuning import prepare_target_views
from jaxcloseup.app.run.keys import RunKeys, run_keys
from jaxcloseup.app.run.labels import LabelStart, start_labels
from jaxcloseup.app.run.loop import Paused, Training, TrainingError, train_stage
from jaxcloseup.app.run.manifest import identity_of, versions
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.scoring import hold_out
from jaxcloseup.app.run.states import initial_state
from jaxcloseup.app.run.step_data import CloseupData, StepData, TrainData
from jaxcloseup.app.score.scores import Perceptual, find_perceptual, score, summarize
from jaxcloseup.app.score.targets import Target
from jaxcloseup.artifacts.checkpoints import CheckpointError, Checkpoints
from jaxcloseup.captures.load import load_scene
from jaxcloseup.io.files import read_object, write_json
from jaxcloseup.labels.config import pseudo_settings
from jaxcloseup.training.state import TrainState


FLAGS = flags.FLAGS
_SCORES, _CHECKPOINTS = "scores.json", "checkpoints"
_MARGIN = 1.2  # a next part may take so much longer than the last one
# Stages, each with the one that takes as many steps without labels.
_STAGES = {"baseline": None, "control": None, "closeup": "control", "test_time_control": None}
_STAGES |= {"test_time": "test_time_control"}
_METRICS = {"psnr": 2, "ssim": 3, "lpips_vgg": 3}


class Clock:
    """Says when a piece has no time for another part as long as the last one."""

    def __init__(self, seconds: float, now: Callable[[], float] = time.monotonic) -> None:
        """Begin a piece of so many seconds."""
        self._now, self._last = now, now()
        self._end = self._last + seconds

    def restart(self) -> None:
        """Begin a part; what came before was none."""
        self._last = self._now()

    def is_over(self) -> bool:
        """Return True unless another part fits; called after every part."""
        now = self._now()
        took, self._last = now - self._last, now
        return now + _MARGIN * took > self._end


@dataclasses.dataclass
class Piece:
    """What the stages of a piece share."""

    training: Training
    clock: Clock
    kept: pathlib.Path  # file of the scores
    # `stages` has the summaries of finished stages by split, `views` the scores of single views of
    # the others.
    scores: dict[str, Any]
    perceptual: Perceptual

    def score(self, stage: str, state: TrainState, targets: Mapping[str, Sequence[Target]]) -> None:
        """Score a stage view by view, and keep each.

        Raises:
          Paused: the piece is over.
        """
        if stage in self.scores["stages"]:
            return
        views = self.scores["views"].setdefault(stage, {split: {} for split in targets})
        for split, target in [(name, view) for name in targets for view in targets[name]]:
            if target.name in views[split]:
                continue
            rendering = self.training.programs.render(state, target.camera)
            seen = jax.device_get(rendering._replace(aux=()))
            views[split][target.name] = score(seen, target, self.perceptual)
            write_json(self.kept, self.scores)
            if self.clock.is_over():
                raise Paused(f"views of {stage}")
        self.scores["stages"][stage] = {split: summarize(views[split]) for split in targets}
        del self.scores["views"][stage]
        write_json(self.kept, self.scores)


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_string("state", None, "folder of the state, new or of an earlier piece")
    flags.DEFINE_float("minutes", 9.0, "time of a piece, without loading and compiling")
    flags.DEFINE_string("scene", "table", "a built-in scene or a folder")
    flags.DEFINE_string("method", "nerf", "radiance field that renders rays")
    flags.DEFINE_string("preset", "paper", "paper, or released of nerf")
    flags.DEFINE_integer("seed", 0, "random seed")
    flags.DEFINE_multi_string("set", [], "name=value changes a setting of the preset")
    flags.mark_flag_as_required("state")


def main(_: list[str]) -> None:
    """Do one piece."""
    with loading():
        set_up_compilation_cache(None)
    preset = with_settings(METHODS[FLAGS.method].presets[FLAGS.preset], FLAGS.set)
    scene = load_scene(FLAGS.scene, downscale=preset.downscale or 1)
    names = {"method": FLAGS.method, "preset": FLAGS.preset}
    folder, begun = pathlib.Path(FLAGS.state), time.monotonic()
    programs = Programs(preset, scene)
    with in_one_sentence("paper_nerf", CheckpointError, TrainingError), progress.showing():
        left = do_piece(folder, programs, names, seed=FLAGS.seed, seconds=60 * FLAGS.minutes)
    held = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    print(f"piece: {time.monotonic() - begun:.0f} s, {held / 2**20:.0f} MiB in {folder}")
    if left:
        sys.exit(f"next: {left}; the same command goes on")
    print_scores(read_object(folder / _SCORES)["stages"])


def do_piece(
    folder: pathlib.Path, programs: Programs, names: Mapping[str, str], *, seed: int, seconds: float
) -> str | None:
    """Train and score as much as fits into a piece; return what comes next, None when all is done.

    Raises:
      CheckpointError: the folder belongs to another training.
    """
    clock = Clock(seconds)
    identity = identity_of(programs.scene, programs.preset, names) | {"seed": seed}
    training = Training(
        programs,
        Checkpoints(folder / _CHECKPOINTS, identity),
        save_every=2000,
        report_every=50,  # so that a piece ends in time also where a step takes seconds
        pause=clock.is_over,
    )
    kept = folder / _SCORES
    scores = read_object(kept) if kept.exists() else {"stages": {}, "views": {}}
    try:
        _work(
            Piece(training, clock, kept, scores | {"versions": versions()}, find_perceptual()),
            run_keys(seed),
        )
    except Paused as paused:
        return str(paused)
    return None


def _work(piece: Piece, keys: RunKeys) -> None:
    """Train and score the stages that are not finished.

    Raises:
      Paused: the piece is over.
    """
    programs, preset = piece.training.programs, piece.training.programs.preset
    baseline = train_stage(
        piece.training,
        "baseline",
        initial_state(programs, keys),
        TrainData(programs.photographs),
        steps=preset.baseline_steps,
    )
    if set(_STAGES) <= set(piece.scores["stages"]):
        return
    start = start_labels(programs, baseline, expected_depth=preset.labels.expected_depth)
    targets = hold_out(programs, start, ladder=False).targets
    piece.clock.restart()
    piece.score("baseline", baseline, targets)
    for name, data, steps in _fine_tunings(programs, start):
        if name not in piece.scores["stages"]:
            state = train_stage(piece.training, name, start.state, data, steps=steps)
            piece.score(name, state, targets)
        shutil.rmtree(piece.training.checkpoints.folder / name, ignore_errors=True)


def _fine_tunings(programs: Programs, start: LabelStart) -> Iterator[tuple[str, StepData, int]]:
    """Yield name, data and number of steps of the stages that continue the baseline."""
    preset, photographs = programs.preset, programs.photographs
    settings, scale = pseudo_settings(preset.labels), preset.labels.lr_scale
    control = TrainData(photographs, None if scale == 1 else jnp.float32(scale))
    yield "control", control, preset.closeup_steps
    yield "closeup", CloseupData(photographs, start.sources, settings), preset.closeup_steps
    if programs.scene.test is None:
        return
    labels = preset.target_labels
    prepared = prepare_target_views(
        programs, start, programs.scene.test.cameras, labels, pseudo_settings(labels), _no_detail
    )
    rate = preset.targets.control_lr_scale if preset.targets else labels.lr_scale
    control = TrainData(photographs, jnp.float32(rate))
    yield "test_time_control", control, prepared.steps
    yield "test_time", prepared.data, prepared.steps


def _no_detail() -> NoReturn:
    raise ValueError("pieces keep no detail: --set targets.label=warp")


def print_scores(stages: Mapping[str, Any]) -> None:
    """Print the scores of all stages, and their gains over as many steps without labels."""
    results, rows = {"stages": stages}, []
    for name, over in _STAGES.items():
        if name in stages:
            row = [name, *(pair(results, [name], CLOSEUPS, m, d) for m, d in _METRICS.items())]
            row.append(pair(results, [name], ORDINARY))
            rows.append([*row, format_gain(gains(results, CLOSEUPS, name, over)) if over else "-"])
    header = ["stage", "close-ups: PSNR", "SSIM", "LPIPS (VGG)", "ordinary views: PSNR"]
    print_table("The paper's NeRF", [*header, "gain over control (95 %)"], rows)


if __name__ == "__main__":
    define_flags()
    start(sys.modules[__name__])
