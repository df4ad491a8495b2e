"""The arms of a sweep on every scene, and its tables: what `experiments.sweep` does."""

import contextlib
import os
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import jax
from absl import flags

from jaxcloseup.app import progress
from jaxcloseup.app.cli import chosen as training_flags
from jaxcloseup.app.cli.start import lock_output_dir, prepare_to_stop, set_up
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.settings import plain_config
from jaxcloseup.app.report.page import Picture
from jaxcloseup.app.report.pictures import comparisons
from jaxcloseup.app.report.sweep_tables import print_sweep, write_sweep
from jaxcloseup.app.run.devices import HOSTS_WAIT
from jaxcloseup.app.run.logs import TrainLog, check_tensorboard
from jaxcloseup.app.run.loop import TrainingError
from jaxcloseup.app.run.manifest import NAME as MANIFEST
from jaxcloseup.app.run.manifest import about_scene, versions, write_manifest
from jaxcloseup.app.run.plan import in_words
from jaxcloseup.app.score.scores import Perceptual, find_perceptual
from jaxcloseup.app.store.stored_run import RunError, read_fields
from jaxcloseup.app.sweep.arm_training import run_sweep
from jaxcloseup.app.sweep.arms import make_arm
from jaxcloseup.artifacts.checkpoints import CheckpointError
from jaxcloseup.labels.rules import LABEL_RULES, pool_label_loss
from jaxcloseup.photos.scene import Scene, SceneError


FLAGS = flags.FLAGS


def _hosts() -> tuple[str, int, int] | None:
    """Address of the first host, how many there are and which this is, or None for one alone."""
    hosts = FLAGS.coordinator, FLAGS.num_processes, FLAGS.process_id
    if hosts == (None, None, None):
        return None
    if None in hosts or FLAGS.process_id >= FLAGS.num_processes:
        raise ValueError(
            "several hosts need --coordinator, --num_processes and, below it, --process_id: give "
            "all three"
        )
    if FLAGS.output_dir is None:
        raise ValueError("several hosts need one folder that all of them see: give --output_dir")
    return hosts


def check_flags(preset: Preset) -> None:
    """Check the scenes and arms that the flags name.

    Raises:
      ValueError: one sentence that names the flag.
    """
    for flag in ("scenes", "arms"):
        values = getattr(FLAGS, flag)
        if not values or len(set(values)) < len(values):
            raise ValueError(f"--{flag}={','.join(values)} must name one or more, each once")
    pooled = LABEL_RULES[preset.train.label_rule].loss is pool_label_loss
    for name in FLAGS.arms:
        labels = make_arm(name, preset).labels
        if pooled and 0 < labels.label_loss_weight != preset.labels.label_loss_weight:
            raise ValueError(
                f"--arms={name}: this preset pools the losses of photographs and labels, so that "
                "only label_loss_weight=0 makes a difference"
            )
    if "control" not in FLAGS.arms:
        print("warning: without the arm control there are no gains in the tables")


def _check_scenes(captures: Sequence[Scene], output_dir: pathlib.Path) -> None:
    given, names = ",".join(FLAGS.scenes), {scene.name for scene in captures}
    if len(names) < len(captures):
        raise ValueError(f"--scenes={given} has two of one name: sweep them one at a time")
    kept = output_dir / MANIFEST
    if FLAGS.resume and kept.exists():
        before = read_fields(kept, {"scenes": dict})["scenes"]
        if set(before) != names:
            raise ValueError(
                f"--scenes={given} are not those of {output_dir}, {','.join(before)}: resume it as "
                "it was begun"
            )


def main() -> None:
    """Run the sweep of the flags on every scene."""
    set_up()
    try:
        hosts = _hosts()
        first = hosts is None or hosts[-1] == 0
        if FLAGS.tensorboard:
            check_tensorboard()
        preset = training_flags.preset_from_flags()
        check_flags(preset)
        output_dir = pathlib.Path(FLAGS.output_dir or "")
        if first:
            output_dir = training_flags.choose_output_dir(
                FLAGS.output_dir, "sweep", FLAGS.method, resume=FLAGS.resume
            )
        prepare_to_stop(output_dir, "experiments.sweep")
        perceptual = find_perceptual(FLAGS.lpips_weights)
        load_options = training_flags.load_options_from_flags(preset)
        scenes = [training_flags.load(name, load_options) for name in FLAGS.scenes]
        _check_scenes(scenes, output_dir)
        lock = lock_output_dir(output_dir) if first else contextlib.nullcontext()
    except (RunError, SceneError, OSError, ValueError) as error:
        sys.exit(f"experiments.sweep: {error}")
    if hosts is not None:
        # Hosts that are done wait for the first one, which writes the tables.
        jax.distributed.initialize(*hosts, shutdown_timeout_seconds=HOSTS_WAIT)
    try:
        with lock, progress.showing(words=in_words):
            found = sweep_scenes(scenes, preset, output_dir, load_options, perceptual, first=first)
    except (TrainingError, CheckpointError, SceneError, OSError) as error:
        if hosts is None:
            sys.exit(f"experiments.sweep: {error}")
        # The others would wait for this one at the end: without it they are told to stop.
        print(f"experiments.sweep: {error}", file=sys.stderr, flush=True)
        os._exit(1)
    if first:
        print_sweep(found)
        print(f"report: {output_dir / 'report.html'}")


def sweep_scenes(
    scenes: Sequence[Scene],
    preset: Preset,
    output_dir: pathlib.Path,
    load_options: Mapping[str, Any],
    perceptual: Perceptual,
    *,
    first: bool,
) -> dict[str, Any]:
    """Sweep scene by scene; the first host writes tables, pictures and the report after each.

    Returns:
      The scores of `run_sweep` by scene.
    """
    names = training_flags.names_from_flags()
    about = {**names, "config": plain_config(preset), "versions": versions()}
    manifest = about | {"seeds": list(range(FLAGS.seeds)), "arms": FLAGS.arms}
    manifest["scenes"] = {scene.name: about_scene(scene, load_options) for scene in scenes}
    found: dict[str, Any] = {}
    pictures: list[Picture] = []
    seconds: dict[str, dict[str, float]] = {scene.name: {} for scene in scenes}
    # One that is resumed may yet turn out to be another sweep.
    if first and not FLAGS.resume:
        write_manifest(output_dir, manifest)
    for scene in scenes:
        log = TrainLog(output_dir, scene.name, tensorboard=FLAGS.tensorboard)
        outcome = run_sweep(
            scene,
            preset,
            FLAGS.arms,
            FLAGS.seeds,
            output_dir / "checkpoints" / scene.name,
            names=names,
            max_parallel=FLAGS.max_parallel,
            perceptual=perceptual,
            seconds=seconds[scene.name],
            log=log if first else None,
        )
        found[scene.name] = outcome.scores
        if first:
            folder = output_dir / "compare" / scene.name
            drawn = comparisons(folder, outcome.shown, outcome.images)
            pictures += [one._replace(section=f"{scene.name}: {one.section}") for one in drawn]
            write_sweep(output_dir, found, about, pictures)
    if first:
        write_manifest(output_dir, manifest, seconds)
    return found
