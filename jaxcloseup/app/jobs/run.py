"""The stages of one run, and its report: what `experiments.run` does."""

import dataclasses
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from absl import flags

from jaxcloseup.app import progress
from jaxcloseup.app.cli import chosen as training_flags
from jaxcloseup.app.cli.start import lock_output_dir, prepare_to_stop, set_up
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.settings import plain_config
from jaxcloseup.app.report.headline import print_results
from jaxcloseup.app.report.run_report import report_run
from jaxcloseup.app.run.logs import TrainLog, check_tensorboard
from jaxcloseup.app.run.loop import Training, TrainingError
from jaxcloseup.app.run.manifest import (
    about_scene,
    identity_of,
    versions,
    write_dataparser_transforms,
    write_manifest,
)
from jaxcloseup.app.run.plan import in_words, plan_run
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.stage_names import STAGES
from jaxcloseup.app.run.stages import Outcome, run_stages
from jaxcloseup.app.run.timers import timed, timed_compiling
from jaxcloseup.app.score.metrics_text import FINER
from jaxcloseup.app.score.scores import NO_PERCEPTUAL, Perceptual, find_perceptual
from jaxcloseup.app.view.approach import approach
from jaxcloseup.artifacts.checkpoints import CheckpointError, Checkpoints
from jaxcloseup.photos.scene import Scene, SceneError


FLAGS = flags.FLAGS


def run(
    scene: Scene,
    preset: Preset,
    seed: int,
    output_dir: pathlib.Path,
    *,
    names: Mapping[str, str],
    to_run: Sequence[str] = STAGES,
    save_every: int = 1000,
    perceptual: Perceptual = NO_PERCEPTUAL,
    load_options: Mapping[str, Any] | None = None,
    tensorboard: bool = False,
) -> dict[str, Any]:
    """Run the stages on one scene; writes everything under `output_dir` and returns the results.

    Args:
      scene: what was photographed.
      preset: how it is trained.
      seed: random seed.
      output_dir: an empty folder, or that of the same run, cut off.
      names: "method" and "preset" by name, for the report.
      to_run: stages; `baseline` always runs.
      save_every: steps between checkpoints. Resumes from checkpoints already in `output_dir`.
      perceptual: networks of LPIPS.
      load_options: what `load_scene` took, to load the scene again; for the manifest.
      tensorboard: whether to write event files, beside `stats/train.jsonl`.
    """
    scene = dataclasses.replace(scene, train=jax.device_put(scene.train))
    size = scene.train.cameras
    print(
        f"{scene.name}: {len(scene.train)} training photographs of {size.width} x {size.height}, "
        f"depth {scene.near:.3g} to {scene.far:.3g}"
    )
    training = Training(
        Programs(preset, scene),
        Checkpoints(output_dir / "checkpoints", identity_of(scene, preset, names) | {"seed": seed}),
        TrainLog(output_dir, tensorboard=tensorboard),
        save_every,
    )
    load_options = {"downscale": preset.downscale} if load_options is None else load_options
    about = {**names, "seed": seed, "config": plain_config(preset), "versions": versions()}
    manifest = about | about_scene(scene, load_options)
    write_manifest(output_dir, manifest)
    write_dataparser_transforms(output_dir, scene)
    shown = {"words": in_words, "compiled": lambda: training.seconds.get("compile", 0.0)}
    with progress.showing(plan_run(preset, scene, to_run), **shown):
        with timed_compiling(training.seconds):
            outcome = run_stages(training, seed, output_dir, to_run=to_run, perceptual=perceptual)
        dolly = _dolly(training, outcome)
        results = report_run(output_dir, training, outcome, about, dolly=dolly)
    print(f"compiling took {training.seconds['compile']:.0f} s of the run")
    write_manifest(output_dir, manifest, training.seconds)
    return results


def _dolly(training: Training, outcome: Outcome) -> list[np.ndarray]:
    """Frames of a camera that comes near, for the report; none without close-ups."""
    targets = outcome.held_out.targets
    views = targets.get(f"test{FINER}") or targets.get("test")
    if not views:
        return []
    with timed(training.seconds, "dolly"):
        far = training.programs.scene.far
        return approach(views, outcome.start.sources, outcome.render, far=far)


def main() -> None:
    """Run all stages with the settings of the flags."""
    set_up()
    try:
        if FLAGS.tensorboard:
            check_tensorboard()
        preset = training_flags.preset_from_flags()
        output_dir = training_flags.choose_output_dir(
            FLAGS.output_dir, FLAGS.scene, FLAGS.method, resume=FLAGS.resume
        )
        prepare_to_stop(output_dir, "experiments.run")
        load_options = training_flags.load_options_from_flags(preset)
        with progress.showing(), progress.saying(f"loading {FLAGS.scene}"):
            scene = training_flags.load(FLAGS.scene, load_options)
        perceptual = find_perceptual(FLAGS.lpips_weights)
        lock = lock_output_dir(output_dir)
    except (SceneError, OSError, ValueError) as error:
        sys.exit(f"experiments.run: {error}")
    try:
        with lock, progress.showing():
            results = run(
                scene,
                preset,
                FLAGS.seed,
                output_dir,
                names=training_flags.names_from_flags(),
                to_run=FLAGS.stages,
                save_every=FLAGS.save_every,
                perceptual=perceptual,
                load_options=load_options,
                tensorboard=FLAGS.tensorboard,
            )
    except (TrainingError, CheckpointError, SceneError, OSError) as error:
        sys.exit(f"experiments.run: {error}")
    print_results(results)
    print(f"report: {output_dir / 'report.html'}")
