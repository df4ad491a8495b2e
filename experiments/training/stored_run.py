"""A run that is finished or was cut off, loaded again: its scene, its preset, a stage's state."""

import dataclasses
import json
import math
import pathlib
import types
import typing
import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

from absl import flags

from experiments.methods.presets import Preset
from experiments.training import manifest
from experiments.training.loop import Programs
from experiments.training.stages import config, state_to_begin
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.scenes import Scene, load_scene
from jaxcloseup.train import TrainState


FLAGS = flags.FLAGS
flags.DEFINE_string("run", None, "folder of the run")
flags.DEFINE_string("stage", None, "which state to render; default: closeup, or the last there is")
flags.DEFINE_string("data", None, "where the run's capture lies now, if it was moved")

# What is rendered where nobody says: the first of these that a run has.
_BY_DEFAULT = ("closeup", "control", "baseline")


class RunError(Exception):
    """A run that cannot be rendered. The message is one sentence that says what to do."""


class Record(NamedTuple):
    """What a run's folder says of it.

    Attributes:
      folder: of the run.
      manifest: its `manifest.json`.
      identity: its `checkpoints/run.json`.
      preset: as it was trained.
      stages: those that have a state.
    """

    folder: pathlib.Path
    manifest: Mapping[str, Any]
    identity: Mapping[str, Any]
    preset: Preset
    stages: list[str]


def named_run() -> tuple[Record, str]:
    """The run that `--run` names, and its stage that `--stage` does.

    Raises:
      RunError: there is none.
    """
    if FLAGS.run is None:
        raise RunError("--run is missing: name the folder of a run of experiments.run")
    record = read_run(pathlib.Path(FLAGS.run))
    return record, choose_stage(record, FLAGS.stage)


def read_run(folder: pathlib.Path) -> Record:
    """Read what a run was, and which states it left.

    Raises:
      RunError: there is no run, or none that this version can render.
    """
    if not folder.is_dir():
        raise RunError(f"--run={folder} is not a folder: name that of a run of experiments.run")
    about, identity = (_read_json(folder, name) for name in (manifest.NAME, "checkpoints/run.json"))
    if "scene" not in about or "config" not in identity:
        raise RunError(f"--run={folder} is of a sweep or unknown: name a run of experiments.run")
    try:
        preset = preset_from_config(identity["config"])
    except ValueError as error:
        raise RunError(
            f"--run={folder} was trained by version {identity.get('version')}, of which this one "
            f"cannot read the configuration ({error}): render it with that version"
        ) from None
    checkpoints = folder / "checkpoints"
    stages = sorted(
        path.name
        for path in checkpoints.iterdir()
        if path.is_dir() and any(step.name.isdecimal() for step in path.iterdir())
    )
    if not stages:
        raise RunError(f"--run={folder} has no checkpoint yet: resume it with experiments.run")
    return Record(folder, about, identity, preset, stages)


def choose_stage(record: Record, stage: str | None) -> str:
    """The stage that is asked for, or else the closeup, or what there is of it."""
    if stage is None:
        return next(name for name in (*_BY_DEFAULT, *record.stages) if name in record.stages)
    if stage not in record.stages:
        raise RunError(
            f"--stage={stage}: {record.folder} has no state of it (closeup has none where no "
            "labels were let in): choose " + " or ".join(record.stages)
        )
    return stage


def load_run_scene(record: Record, moved_to: str | None = None) -> Scene:
    """The scene that a run was trained on, from where it was or `moved_to`.

    Raises:
      RunError: it is another one now.
      SceneError: it cannot be loaded.
    """
    about = record.manifest
    name = about["scene"] if moved_to is None else moved_to
    try:
        scene = load_scene(name, **about["load_options"])
    except TypeError as error:
        raise RunError(
            f"--run={record.folder} was loaded with options that this version lacks ({error}): "
            "render it with the version that trained it"
        ) from None
    size = [scene.train.cameras.width, scene.train.cameras.height]
    if size != record.identity["resolution"]:
        raise RunError(
            f"--run={record.folder} was trained with photographs of "
            f"{' x '.join(map(str, record.identity['resolution']))} pixels, and {name} has "
            f"{size[0]} x {size[1]}: name its own capture with --data"
        )
    if manifest.hash_data(scene) != about["data_sha256"]:
        warnings.warn(
            f"{name} does not hold the photographs or cameras that {record.folder} was trained on.",
            stacklevel=2,
        )
    return scene


def restore(record: Record, scene: Scene, stage: str) -> tuple[Programs, TrainState]:
    """The programs of a run, with the room that its images needed, and a stage's newest state.

    Raises:
      CheckpointError: the state is not of this form.
    """
    preset = record.preset
    programs = Programs(preset, scene)
    like = state_to_begin(programs, seed=0)
    found = Checkpoints(record.folder / "checkpoints", record.identity).load(stage, like)
    if found is None:
        raise RunError(f"--stage={stage}: {record.folder} has no state of it")
    step, state, progress = found
    programs.make_room(progress["growth"])
    print(f"{record.folder}: {scene.name}, {stage} after {step} steps")
    return programs, state


def preset_from_config(stored: Mapping[str, Any]) -> Preset:
    """The preset of which `pipeline.config` made this JSON.

    Raises:
      ValueError: it is of another form, with the fields that differ.
    """
    preset = _rebuild(Preset, stored, "config")
    if config(preset) != stored:
        raise ValueError("a value is of another type")
    return preset


def _rebuild(kind, value, name):
    if value == "inf":
        return math.inf
    if isinstance(value, list):
        return tuple(_rebuild(Any, inner, name) for inner in value)
    if not isinstance(value, Mapping):
        return value
    # Of a choice of classes, only one has these fields.
    choices = typing.get_args(kind) if isinstance(kind, types.UnionType) else (kind,)
    choices = [choice for choice in choices if dataclasses.is_dataclass(choice)]
    if not choices:
        raise ValueError(f"{name} holds fields")
    different = []
    for choice in choices:
        fields = {field.name for field in dataclasses.fields(choice)}
        if fields == set(value):
            kinds = typing.get_type_hints(choice)
            return choice(**{k: _rebuild(kinds[k], v, f"{name}.{k}") for k, v in value.items()})
        different.append(sorted(fields ^ set(value)))
    raise ValueError(f"{name} differs in {', '.join(min(different, key=len))}")


def _read_json(folder, name):
    try:
        found = json.loads((folder / name).read_bytes())
        if not isinstance(found, dict):
            raise ValueError("not an object")
    except FileNotFoundError:
        raise RunError(
            f"--run={folder} has no {name}: name the folder of a run of experiments.run"
        ) from None
    except (OSError, ValueError) as error:
        raise RunError(
            f"{folder / name} cannot be read ({error}): restore it from a copy of the run"
        ) from None
    return found
