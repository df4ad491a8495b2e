"""Load a stored run, finished or interrupted: its scene, its preset, and the state of a stage."""

import dataclasses
import pathlib
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.settings import with_settings
from jaxcloseup.app.run import manifest
from jaxcloseup.app.run.corrected_poses import read_poses
from jaxcloseup.app.run.loop import TrainingError
from jaxcloseup.app.run.measured_exposures import read_exposures
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.states import COARSE, state_shapes
from jaxcloseup.app.store.stored_config import preset_from_config
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.captures.load import DRAWN_SCENES, load_scene
from jaxcloseup.io.files import read_object
from jaxcloseup.io.messages import printable
from jaxcloseup.photos.scene import Scene, move_photographs
from jaxcloseup.training.state import TrainState


# The stage to render by default is the first of these that a run has.
_BY_DEFAULT = ("closeup", "control", "baseline")
# Fields that rendering needs, by file of a run.
_FIELDS: dict[str, dict[str, type]] = {
    manifest.NAME: {"scene": str, "load_options": dict, "data_sha256": str},
    "checkpoints/run.json": {"config": dict, "resolution": list, "seed": int},
}
_WORDS = {str: "a text", dict: "an object", list: "a list", int: "a whole number from 0 on"}


class RunError(Exception):
    """A run that cannot be rendered. The message is one sentence that says what to do."""

    def __init__(self, message: str) -> None:
        """Escape control characters, which may come from files."""
        super().__init__(printable(message))


@dataclasses.dataclass(frozen=True)
class StoredRun:
    """Content of a run's folder."""

    folder: pathlib.Path  # the run's folder
    manifest: Mapping[str, Any]  # its `manifest.json`
    identity: Mapping[str, Any]  # its `checkpoints/run.json`
    trained: Preset  # preset of its training
    preset: Preset  # the same preset with the settings that the user changes
    stages: list[str]  # stages that have a state of the preset itself


def read_run(folder: pathlib.Path) -> StoredRun:
    """Read the preset of a run, and list the stages that have a state.

    Prints the settings that the run's version lacked, with the values that reproduce its renders.

    Raises:
      RunError: the folder holds no run that this version can render.
    """
    if not folder.is_dir():
        raise RunError(f"--run={folder} is not a folder: name the folder of a run")
    about, identity = (_read_json(folder, name) for name in _FIELDS)
    if "scene" not in about or "config" not in identity:
        raise RunError(f"{folder} is of a sweep or unknown: name the folder of a run")
    for fields, (name, kinds) in zip((about, identity), _FIELDS.items(), strict=True):
        _check_fields(folder / name, fields, kinds)
    if len(identity["resolution"]) != 2:
        raise RunError(
            f"{folder / 'checkpoints/run.json'}: resolution must be a width and a height: restore "
            "the file from a copy of the run"
        )
    version = identity.get("version")
    try:
        preset, absent = preset_from_config(identity["config"])
    except ValueError as error:
        raise RunError(
            f"{folder} was trained by version {version}, whose configuration this version "
            f"cannot read ({error}): render it with version {version}, or restore "
            "checkpoints/run.json from a copy of the run"
        ) from None
    if absent:
        values = ", ".join(f"{name}={value}" for name, value in absent.items())
        print(f"{folder}: version {version} had no such settings; it renders with {values}")
    checkpoints = folder / "checkpoints"
    # A coarse model's state has other shapes: only training goes on with it.
    trained = (path for path in checkpoints.iterdir() if not path.name.startswith(COARSE))
    stages = sorted(
        path.name
        for path in trained
        if path.is_dir() and any(step.name.isdecimal() for step in path.iterdir())
    )
    if not stages:
        raise RunError(f"{folder} has no checkpoint yet: resume its training with --resume")
    return StoredRun(folder, about, identity, preset, preset, stages)


def change_settings(run: StoredRun, given: Sequence[str]) -> StoredRun:
    """Return the run with other settings, for fine-tuning from its states.

    Raises:
      RunError: a setting is unknown or its value is invalid.
    """
    try:
        return dataclasses.replace(run, preset=with_settings(run.preset, given))
    except ValueError as error:
        raise RunError(str(error)) from None


def choose_stage(run: StoredRun, stage: str | None) -> str:
    """Return the stage that the user names; by default the closeup, or the last trained stage."""
    if stage is None:
        return next(name for name in (*_BY_DEFAULT, *run.stages) if name in run.stages)
    if stage not in run.stages:
        raise RunError(
            f"--stage={stage}: {run.folder} has no state of it (closeup has none where the gate "
            "let no labels in): choose " + " or ".join(run.stages)
        )
    return stage


def load_run_scene(run: StoredRun, moved_to: str | None = None) -> Scene:
    """Load the scene that a run was trained on, from its old place or from `moved_to`.

    Raises:
      RunError: the capture does not fit the run.
      SceneError: the capture cannot be loaded.
    """
    about = run.manifest
    name = about["scene"] if moved_to is None else moved_to
    if "placement" not in about and name not in DRAWN_SCENES:
        raise RunError(
            f"{run.folder} was trained in the coordinates of its capture's files, which this "
            "version moves and scales: render it with the version that trained it, or train again"
        )
    try:
        scene = load_scene(name, **about["load_options"])
    except TypeError as error:
        raise RunError(
            f"{run.folder} was loaded with options that this version lacks ({error}): "
            "render it with the version that trained it"
        ) from None
    size = [scene.train.cameras.width, scene.train.cameras.height]
    if size != run.identity["resolution"]:
        raise RunError(
            f"{run.folder} was trained with photographs of "
            f"{' x '.join(map(str, run.identity['resolution']))} pixels, and {name} has "
            f"{size[0]} x {size[1]}: name its own capture with --data"
        )
    if manifest.hash_data(scene) != about["data_sha256"]:
        warnings.warn(
            f"{name} does not hold the photographs or cameras that {run.folder} was trained on.",
            stacklevel=2,
        )
    try:
        poses = read_poses(run.folder, scene.names["train"])
    except (OSError, ValueError) as error:
        raise RunError(f"{run.folder}: {error}") from None
    return scene if poses is None else move_photographs(scene, poses)


def restore(run: StoredRun, scene: Scene, stage: str) -> tuple[Programs, TrainState]:
    """Return the programs of a run, with room for its images, and the newest state of a stage.

    Raises:
      RunError: the state is missing or too large for memory, or a changed setting does not fit it.
      CheckpointError: the state does not fit the preset.
    """
    programs = Programs(run.preset, scene)
    try:
        programs.read.keep_exposures(read_exposures(run.folder, scene.names["train"]))
    except (OSError, ValueError) as error:
        raise RunError(f"{run.folder}: {error}") from None
    try:
        shapes = state_shapes(programs)
    except TrainingError as error:
        raise RunError(f"{run.folder}: {error}") from None
    if run.preset != run.trained and shapes != state_shapes(Programs(run.trained, scene)):
        raise RunError(
            f"--set changes the shape of what was trained: {run.folder} was trained with "
            "other shapes, so train anew with these settings, or leave them out"
        )
    like = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    checkpoints = Checkpoints(run.folder / "checkpoints", run.identity)
    loaded = checkpoints.load(stage, like)
    if loaded is None:
        raise RunError(f"--stage={stage}: {run.folder} has no state of it")
    step, state, progress = loaded
    programs.make_room(progress["growth"])
    print(f"{run.folder}: {scene.name}, {stage} after {step} steps")
    return programs, state


def read_fields(path: pathlib.Path, kinds: Mapping[str, type]) -> dict[str, Any]:
    """Read a JSON object that has these fields, of these types.

    Raises:
      RunError: the file cannot be read, or a field is missing or of another type.
    """
    try:
        fields = read_object(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RunError(
            f"{path} cannot be read ({reason}): restore it from a copy of the run"
        ) from None
    _check_fields(path, fields, kinds)
    return fields


def _check_fields(path: pathlib.Path, fields: Mapping[str, Any], kinds: Mapping[str, type]) -> None:
    for name, kind in kinds.items():
        value: Any = fields.get(name)
        fits = isinstance(value, kind) and not isinstance(value, bool)
        if not fits or (kind is int and not 0 <= value < 2**63):
            raise RunError(
                f"{path}: {name} must be {_WORDS[kind]}: restore the file from a copy of the run"
            )


def _read_json(folder: pathlib.Path, name: str) -> dict[str, Any]:
    if not (folder / name).exists():
        raise RunError(f"{folder} has no {name}: name the folder of a run")
    return read_fields(folder / name, {})
