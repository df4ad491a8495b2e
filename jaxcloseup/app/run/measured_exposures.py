"""Exposures of a run's photographs, from the depth that stereo matched."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.stereo_depths import StereoDepths, draw_points
from jaxcloseup.captures.photo_exif import read_exposure
from jaxcloseup.io.files import read_object, write_json
from jaxcloseup.photos.exposures import (
    Exposures,
    Metering,
    at_middle_exposure,
    fit_metering,
    look_at_points,
    solve_gains,
    stack_curves,
)
from jaxcloseup.photos.responses import LEVELS, fit_response, straighten
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.stated_exposures import StatedExposure, fit_cameras, gains_of_files
from jaxcloseup.photos.views import Views, camera_at, to_float, unpadded


Stated = Mapping[str, Sequence[StatedExposure | None]]  # of each photograph, by split

NAME = "exposures.json"
_POINTS = 5000  # at which photographs are compared
_MATCHED = 50  # of them that a photograph must show for its gain to be evidence
_AGREE = 0.02  # standard deviation of log gains up to which photographs have one exposure


def measure_exposures(stereo: StereoDepths, scene: Scene) -> Exposures | None:
    """Return how exposures of a scene's photographs differ; None where they agree."""
    views = stereo.views
    stated = stated_exposures(scene)
    points = jnp.asarray(draw_points(stereo, _POINTS)[0])
    depth = jnp.where(stereo.maps.confidence > 0, stereo.maps.depth, 0)
    look = jax.jit(look_at_points)

    def photograph(view: int) -> tuple[jax.Array, jax.Array]:
        return to_float(views.rgb[view]), views.weight[view]

    def seen(view: int) -> np.ndarray:
        camera = camera_at(views.cameras, view)
        return np.asarray(look(camera, depth[view], *photograph(view), points))

    cameras = {
        split: {
            name: found.camera if found else ""
            for name, found in zip(scene.names[split], stated[split], strict=True)
        }
        for split in stated
    }
    with progress.saying("comparing exposures"):
        logs = np.stack(list(map(seen, range(len(views)))))
        if float(solve_gains(logs).std()) < _AGREE:
            return None
        took = list(cameras["train"].values())
        curves, logs = _straighten(logs, took)
        if curves:
            same = jnp.zeros((len(views), 3), jnp.float32)
            views = at_middle_exposure(views, same, stack_curves(curves, took))
        log_gains, offsets = _solve(logs, stated["train"])
        # A camera meters around the middle of what it takes, which padding would move.
        whole = unpadded(views, _sizes(views, scene))
        metering = fit_metering(log_gains, [(to_float(each.rgb), each.weight) for each in whole])
        held_out = held_out_gains(scene, stated, offsets)
    print(_describe(log_gains, metering.slopes, held_out, curves))
    gains = jnp.asarray(log_gains, jnp.float32)
    return Exposures(gains, metering, held_out, curves, cameras if curves else {})


def _solve(
    logs: np.ndarray, stated: Sequence[StatedExposure | None]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return log gains, and the offsets of cameras whose files explain them.

    A photograph that shows few of the points stays near what its file states, if that is believed,
    and is no evidence for it.
    """
    counts = np.isfinite(logs[..., 0]).sum(axis=1)
    matched = [view for view, count in enumerate(counts) if count >= _MATCHED]

    def believed(log_gains: np.ndarray) -> dict[str, np.ndarray]:
        return fit_cameras(log_gains[matched], [stated[view] for view in matched])

    log_gains = solve_gains(logs)
    if offsets := believed(log_gains):
        log_gains = solve_gains(logs, gains_of_files(stated, offsets))
        offsets = believed(log_gains)
    return log_gains, offsets


def _straighten(
    logs: np.ndarray, cameras: Sequence[str]
) -> tuple[dict[str, jax.Array], np.ndarray]:
    """Return curves of cameras that have one, and log light `[V, P, 3]` by them."""
    curves, logs = {}, logs.copy()
    for camera in sorted(set(cameras)):
        rows = [view for view, other in enumerate(cameras) if other == camera]
        if (curve := fit_response(logs[rows])) is not None:
            curves[camera] = jnp.asarray(curve, jnp.float32)
            logs[rows] = straighten(logs[rows], curve)
    return curves, logs


def stated_exposures(scene: Scene) -> Stated:
    """Return what the files of each split's photographs say of their exposure."""
    files = scene.metadata.get("files", {})
    return {
        split: [*map(read_exposure, files[split])] if split in files else [None] * len(names)
        for split, names in scene.names.items()
    }


def held_out_gains(
    scene: Scene, stated: Stated, cameras: Mapping[str, np.ndarray]
) -> dict[str, dict[str, jax.Array]]:
    """Return the log gains of held-out photographs that follow from their files.

    Args:
      scene: the scene.
      stated: what the files say.
      cameras: by how much log gains `[3]` of each camera exceed the log exposures of its files.
    """
    return {
        split: {
            name: jnp.asarray(found.log_exposure + cameras[found.camera], jnp.float32)
            for name, found in zip(scene.names[split], stated[split], strict=True)
            if found and found.camera in cameras
        }
        for split in scene.names
        if split != "train"
    }


def _sizes(views: Views, scene: Scene) -> list[tuple[int, int]]:
    """Return width and height of each training photograph in `views`, without its padding."""
    matched, read = views.cameras, scene.train.cameras
    x, y = matched.width / read.width, matched.height / read.height
    return [(round(x * width), round(y * height)) for width, height in scene.sizes("train")]


def write_exposures(
    folder: pathlib.Path, exposures: Exposures | None, names: Sequence[str]
) -> None:
    """Write `exposures.json`, from which renders take them; nothing where exposures agree."""
    if exposures is None:
        return
    plain = jax.tree.map(lambda leaf: np.asarray(leaf).tolist(), exposures)
    gains = dict(zip(names, plain.log_gains, strict=True))
    kept = {"log_gains": gains, "metering": vars(plain.metering), "stated": plain.stated}
    kept |= {"curves": plain.curves, "cameras": exposures.cameras}
    write_json(folder / NAME, kept)


def read_exposures(folder: pathlib.Path, names: Sequence[str]) -> Exposures | None:
    """Read the exposures of a run's photographs; None where the run has none.

    Raises:
      ValueError: the file is damaged, or of other photographs.
    """
    path = folder / NAME
    if not path.exists():
        return None
    try:
        kept = read_object(path)
        gains = jnp.asarray([kept["log_gains"][name] for name in names], jnp.float32)
        metering = Metering(**_arrays(kept["metering"]))
        stated = {split: _arrays(named) for split, named in kept.get("stated", {}).items()}
        curves, cameras = _arrays(kept.get("curves", {})), kept.get("cameras", {})
        if curves or cameras:
            chex.assert_shape(list(curves.values()), (LEVELS,))
            stack_curves(curves, [cameras["train"][name] for name in names])
        chex.assert_shape((gains, metering.content, metering.slopes), ((len(names), 3), (3,), (2,)))
        chex.assert_shape(metering.width, ())
        chex.assert_shape(jax.tree.leaves(stated), (3,))
    except (KeyError, TypeError, ValueError, AttributeError, AssertionError, StopIteration):
        raise ValueError(
            f"{path} does not hold the exposures of these photographs: restore it from a copy of "
            "the run"
        ) from None
    return Exposures(gains, metering, stated, curves, cameras)


def _arrays(values: Mapping[str, Any]) -> dict[str, jax.Array]:
    return {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}


def _describe(
    log_gains: np.ndarray,
    slopes: jax.Array,
    held_out: Mapping[str, Mapping[str, jax.Array]],
    curves: Mapping[str, jax.Array],
) -> str:
    """Say by how much exposures differ, and whether those of new views are predicted."""
    ratio = np.exp(np.ptp(log_gains.mean(axis=1)))
    count = sum(map(len, held_out.values()))
    predicted = "predicted" if np.any(np.asarray(slopes)) else "the middle one"
    return (
        f"photographs differ {ratio:.2g} times in exposure: they are brought to the "
        f"middle; the exposure of new views is {predicted}"
    ) + (
        f", that of {count} held-out photographs follows from their files" * (count > 0)
        + "; their colors have a curve of their own" * bool(curves)
    )
