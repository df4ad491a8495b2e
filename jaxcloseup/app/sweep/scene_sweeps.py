"""A sweep on several scenes, with its tables and pictures."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.settings import plain_config
from jaxcloseup.app.report.page import Picture
from jaxcloseup.app.report.pictures import comparisons
from jaxcloseup.app.report.sweep_tables import write_sweep
from jaxcloseup.app.run.logs import TrainLog
from jaxcloseup.app.run.manifest import about_scene, versions, write_manifest
from jaxcloseup.app.score.scores import Perceptual
from jaxcloseup.app.sweep.arm_training import run_sweep
from jaxcloseup.photos.scene import Scene


def sweep_scenes(
    scenes: Sequence[Scene],
    preset: Preset,
    output_dir: pathlib.Path,
    *,
    arms: Sequence[str],
    seeds: int,
    names: Mapping[str, str],
    load_options: Mapping[str, Any],
    perceptual: Perceptual,
    max_parallel: int,
    tensorboard: bool,
    resume: bool,
    first: bool,
) -> dict[str, Any]:
    """Sweep scene by scene and return the scores of `run_sweep` by scene.

    The first host writes tables, pictures and the report after each scene. `names` has "method" and
    "preset"; `load_options` is what `load_scene` took; `max_parallel` arms and seeds train at once.
    """
    about = {**names, "config": plain_config(preset), "versions": versions()}
    manifest = about | {"seeds": list(range(seeds)), "arms": list(arms)}
    manifest["scenes"] = {scene.name: about_scene(scene, load_options) for scene in scenes}
    found: dict[str, Any] = {}
    pictures: list[Picture] = []
    seconds: dict[str, dict[str, float]] = {scene.name: {} for scene in scenes}
    # One that is resumed may yet turn out to be another sweep.
    if first and not resume:
        write_manifest(output_dir, manifest)
    for scene in scenes:
        log = TrainLog(output_dir, scene.name, tensorboard=tensorboard)
        outcome = run_sweep(
            scene,
            preset,
            arms,
            seeds,
            output_dir / "checkpoints" / scene.name,
            names=names,
            max_parallel=max_parallel,
            perceptual=perceptual,
            seconds=seconds[scene.name],
            log=log if first else None,
        )
        found[scene.name] = outcome.scores
        if first:
            folder = output_dir / "compare" / scene.name
            drawn = comparisons(folder, outcome.shown, outcome.images)
            pictures += [
                picture._replace(section=f"{scene.name}: {picture.section}") for picture in drawn
            ]
            write_sweep(output_dir, found, about, pictures)
    if first:
        write_manifest(output_dir, manifest, seconds, resumed=resume)
    return found
