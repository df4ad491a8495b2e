"""Poses of a capture's photographs, moved to where a coarse model fits them."""

import pathlib
from collections.abc import Sequence

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.io.files import read_object, write_json
from jaxcloseup.photos.alignment import estimate_motion, halves_agree, move_camera, shift_between
from jaxcloseup.photos.scene import move_photographs
from jaxcloseup.photos.views import camera_at, to_float
from jaxcloseup.training.state import TrainState


NAME = "poses.json"
_ROUNDS = 3  # renders from which a camera is moved
_ALIKE = 0.5  # see `halves_agree`
_OPAQUE = 0.9  # opacity from which a render has a depth


@jax.jit
def _move(
    camera: Camera, photograph: jax.Array, weight: jax.Array, shown: tuple[jax.Array, ...]
) -> tuple[Camera, jax.Array, jax.Array]:
    """Return a camera after a motion, how far that went in pixels, and if halves agree on it."""
    rgb, alpha, depth = shown
    weight = jnp.where((alpha > _OPAQUE) & (depth > 0), to_float(weight), 0)
    evidence = to_float(photograph), rgb, depth, weight, camera
    moved = move_camera(camera, estimate_motion(*evidence))
    return moved, shift_between(camera, moved, depth), halves_agree(*evidence)


def corrects_poses(programs: Programs) -> bool:
    """Return whether a run moves its cameras: those of a drawn scene are exact."""
    coarse = programs.preset.coarse
    return coarse is not None and coarse.poses and programs.scene.surface is None


def correct_poses(programs: Programs, coarse: TrainState) -> Programs:
    """Return the programs with cameras of training photographs where a coarse model fits these.

    A camera stays where two halves of its photograph do not agree on a motion, where further
    motions do not become small, and where they end more than a pixel away, which needs another
    remedy.
    """
    scene, views, render = programs.scene, programs.train, programs.coarse.render

    def align(index: int) -> tuple[jax.Array, float]:
        given = camera = camera_at(views.cameras, index)
        steps = []
        for _ in range(_ROUNDS):
            seen = render(coarse, camera)
            shown = jnp.clip(seen.rgb, 0, 1), seen.alpha, seen.depth
            camera, step, alike = _move(camera, views.rgb[index], views.weight[index], shown)
            steps.append((float(step), float(alike)))
        (first, alike), (last, _) = steps[0], steps[-1]
        shift = float(shift_between(given, camera, seen.depth))
        if alike < _ALIKE or last > first / 2 or shift > 1:
            return given.camtoworld, 0.0
        return camera.camtoworld, shift

    aligned = list(progress.each(align, range(len(views)), "photographs aligned"))
    poses, shifts = zip(*aligned, strict=True)
    finer = scene.own_camera("train", 0).width / scene.camera("train", 0).width
    pixels = finer * np.array([shift for shift in shifts if shift])
    if pixels.size:
        print(
            f"{pixels.size} of {len(shifts)} cameras were moved to fit their photographs, by "
            f"{np.median(pixels):.2f} pixels of these (median), at most {pixels.max():.2f}"
        )
    moved_scene = move_photographs(scene, jnp.stack(poses))
    moved = Programs(programs.preset, moved_scene, read=programs.read.moved(moved_scene))
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
            f"{path} does not hold the poses of these photographs: restore it from a copy of the "
            "run"
        ) from None
    return poses
