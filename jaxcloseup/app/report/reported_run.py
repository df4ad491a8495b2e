"""A run from its first step to its report."""

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.settings import plain_config
from jaxcloseup.app.report.run_report import report_run
from jaxcloseup.app.run.logs import TrainLog
from jaxcloseup.app.run.loop import Training
from jaxcloseup.app.run.manifest import NAME as MANIFEST
from jaxcloseup.app.run.manifest import (
    about_scene,
    identity_of,
    versions,
    write_dataparser_transforms,
    write_manifest,
)
from jaxcloseup.app.run.photograph_sizes import describe_training
from jaxcloseup.app.run.plan import in_words, plan_run
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.read_photographs import ReadPhotographs
from jaxcloseup.app.run.stage_names import STAGES
from jaxcloseup.app.run.stages import Outcome, run_stages
from jaxcloseup.app.run.timers import timed, timed_compiling
from jaxcloseup.app.score.scores import NO_PERCEPTUAL, Perceptual
from jaxcloseup.app.view.approach import approach
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.photos.scene import Scene


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
    read: ReadPhotographs | None = None,
) -> dict[str, Any]:
    """Run the stages on one scene, write everything under `output_dir`, and return the results.

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
      read: what other programs made of the scene's photographs; default: it is made.
    """
    scene = dataclasses.replace(scene, train=jax.device_put(scene.train))
    print(describe_training(preset, scene))
    training = Training(
        Programs(preset, scene, read=read),
        Checkpoints(output_dir / "checkpoints", identity_of(scene, preset, names) | {"seed": seed}),
        TrainLog(output_dir, tensorboard=tensorboard),
        save_every,
    )
    about = {**names, "seed": seed, "config": plain_config(preset), "versions": versions()}
    manifest = about | about_scene(scene, load_options or {})
    resumed = (output_dir / MANIFEST).exists()
    write_manifest(output_dir, manifest, resumed=resumed)
    write_dataparser_transforms(output_dir, scene)
    with progress.showing(
        plan_run(preset, scene, to_run),
        words=in_words,
        compiled=lambda: training.seconds.get("compile", 0.0),
    ):
        with timed_compiling(training.seconds):
            outcome = run_stages(training, seed, output_dir, to_run=to_run, perceptual=perceptual)
        dolly = _dolly(training, outcome)
        results = report_run(output_dir, training, outcome, about, dolly=dolly)
    print(f"compiling took {training.seconds['compile']:.0f} s of the run")
    write_manifest(output_dir, manifest, training.seconds, resumed=resumed)
    return results


def _dolly(training: Training, outcome: Outcome) -> list[np.ndarray]:
    """Return frames of a camera that comes near, for the report; none without close-ups."""
    targets = outcome.held_out.targets
    views = targets.get("test")
    if not views:
        return []
    with timed(training.seconds, "dolly"):
        far = training.programs.scene.far
        return approach(views, outcome.start.sources, outcome.render, far=far)
