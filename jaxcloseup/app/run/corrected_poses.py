"""Poses of a capture's photographs, moved to where a coarse model fits them."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.run.loop import TrainingError
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.io.files import read_object, write_json
from jaxcloseup.photos.alignment import estimate_motion, halves_agree, move_camera, shift_between
from jaxcloseup.photos.scene import Scene, move_photographs
from jaxcloseup.photos.views import camera_at, to_float
from jaxcloseup.training.state import TrainState


NAME = "poses.json"
_ROUNDS = 3  # renders from which a camera is moved
_ALIKE = 0.5  # see `halves_agree`
_OPAQUE = 0.9  # opacity from which a render has a depth


class _Step(NamedTuple):
    """A motion of a camera, and what tells whether to trust it."""

    camera: Camera  # after the motion
    shift: jax.Array  # `[]` how far it moves what the camera shows, in pixels
    alike: jax.Array  # `[]`, see `halves_agree`
    depth: jax.Array  # `[H, W]` of the pixels that count; 0 of others


@jax.jit
def _move(
    camera: Camera, photograph: jax.Array, weight: jax.Array, seen: tuple[jax.Array, ...]
) -> _Step:
    """Move a camera to where a render, its color, opacity and depth, fits its photograph."""
    rgb, alpha, depth = seen
    depth = jnp.where((alpha > _OPAQUE) & (weight > 0), depth, 0)
    evidence = to_float(photograph), rgb, depth, to_float(weight), camera
    moved = move_camera(camera, estimate_motion(*evidence))
    return _Step(moved, shift_between(camera, moved, depth), halves_agree(*evidence), depth)


def corrects_poses(preset: Preset, scene: Scene) -> bool:
    """Return whether a run moves its cameras: those of a drawn scene are exact."""
    return preset.coarse is not None and preset.coarse.poses and scene.surface is None


def kept_or_corrected(programs: Programs, coarse: TrainState, folder: pathlib.Path) -> Programs:
    """Return the programs with the poses that a run's folder keeps, or else correct and keep them.

    A resumed run goes on with the poses that it learned from.

    Raises:
      TrainingError: the kept poses are damaged.
    """
    names = programs.scene.names["train"]
    try:
        kept = read_poses(folder, names)
    except ValueError as error:
        raise TrainingError(str(error)) from None
    if kept is not None:
        return with_poses(programs, kept)
    moved = correct_poses(programs, coarse)
    if moved is not programs:
        write_poses(folder, moved.scene.train.cameras, names)
    return moved


def correct_poses(programs: Programs, coarse: TrainState) -> Programs:
    """Return the programs with cameras of training photographs where a coarse model fits these.

    A camera stays where two halves of its photograph do not agree on a motion, where further
    motions do not become small, and where they end more than a pixel of training away, which needs
    another remedy. If all stay, the programs are the same.
    """
    scene, views, render = programs.scene, programs.train, programs.coarse.render

    def align(index: int) -> tuple[jax.Array, float]:
        given = camera = camera_at(views.cameras, index)
        steps = list[_Step]()
        for _ in range(_ROUNDS):
            seen = render(coarse, camera)
            shown = jnp.clip(seen.rgb, 0, 1), seen.alpha, seen.depth
            steps.append(_move(camera, views.rgb[index], views.weight[index], shown))
            if steps[0].alike < _ALIKE:
                return given.camtoworld, 0.0
            camera = steps[-1].camera
        shift = shift_between(given, camera, steps[0].depth)
        if steps[-1].shift > steps[0].shift / 2 or shift > 1:
            return given.camtoworld, 0.0
        return camera.camtoworld, float(shift)

    aligned = list(progress.each(align, range(len(views)), "photographs aligned"))
    poses, shifts = zip(*aligned, strict=True)
    finer = scene.own_camera("train", 0).width / scene.camera("train", 0).width
    pixels = finer * np.array([shift for shift in shifts if shift])
    if not pixels.size:
        return programs
    print(
        f"{pixels.size} of {len(shifts)} cameras were moved to fit their photographs, by "
        f"{np.median(pixels):.2f} pixels of the photographs' own size (median), at most "
        f"{pixels.max():.2f}"
    )
    return with_poses(programs, jnp.stack(poses))


def with_poses(programs: Programs, camtoworld: jax.Array) -> Programs:
    """Return the programs with other poses `[V, 3, 4]` of the training photographs."""
    scene = move_photographs(programs.scene, camtoworld)
    moved = Programs(programs.preset, scene, read=programs.read.moved(scene))
    moved.make_room(programs.growth)
    return moved


def write_poses(folder: pathlib.Path, cameras: Camera, names: Sequence[str]) -> None:
    """Write `poses.json`, from which renders take the poses of the photographs."""
    poses = np.asarray(cameras.camtoworld).tolist()
    write_json(folder / NAME, {"camtoworld": dict(zip(names, poses, strict=True))})


def read_poses(folder: pathlib.Path, names: Sequence[str]) -> jax.Array | None:
    """Read the poses `[V, 3, 4]` of a run's photographs; None where it did not move them.

    Raises:
      ValueError: the file is damaged, or of other photographs.
    """
    path = folder / NAME
    if not path.exists():
        return None
    try:
        kept = read_object(path)["camtoworld"]
        poses = jnp.asarray([kept[name] for name in names], jnp.float32)
        chex.assert_shape(poses, (len(names), 3, 4))
    except (KeyError, TypeError, ValueError, AssertionError):
        raise ValueError(
            f"{path} does not hold the poses of these photographs: name the capture that the run "
            "was trained on, or restore the file from a copy of the run"
        ) from None
    return poses
