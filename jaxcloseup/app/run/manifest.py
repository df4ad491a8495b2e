"""manifest.json: the code, configuration and data of a run, so that others can reproduce it."""

import contextlib
import hashlib
import pathlib
import platform
import subprocess
import time
import warnings
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

import jaxcloseup
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.settings import plain_config
from jaxcloseup.io.files import read_object, write_json
from jaxcloseup.io.memory import peak_memory
from jaxcloseup.photos.scene import Scene


NAME = "manifest.json"
_HASHED = (
    "rgb, weight, camtoworld and intrinsics of the training views, points and their rgb, near and "
    "far, after loading; each as its name, dtype, shape and bytes"
)


def write_manifest(
    folder: pathlib.Path,
    about: Mapping[str, Any],
    seconds: Mapping[str, Any] | None = None,
    *,
    resumed: bool = False,
) -> None:
    """Write `manifest.json` atomically; at the end, also the core-seconds and the peak of memory.

    A run that another commit continues prints a warning.

    `seconds` has the wall time of each stage since the run started or resumed, by scene for a
    sweep; None while the run is not finished. With `resumed`, core-seconds and memory are None,
    because those of earlier processes are not known.
    """
    commit, changed = git_commit(pathlib.Path(jaxcloseup.__file__).parent)
    before = None
    with contextlib.suppress(OSError, ValueError):
        before = read_object(folder / NAME).get("git_commit")
    if isinstance(before, str) and commit not in (None, before):
        warnings.warn(
            f"{folder} was started by commit {before[:9]} and continues with {commit[:9]}: start a "
            "new run if the changes between them matter",
            stacklevel=2,
        )
    git = {"git_commit": commit, "git_changed": changed}
    used = {} if seconds is None else _resources_used(resumed)
    ended = {"finished": seconds is not None, "resumed": resumed, "seconds": seconds, **used}
    write_json(folder / NAME, {**about, **git, **ended})


def about_scene(scene: Scene, load_options: Mapping[str, Any]) -> dict[str, Any]:
    """Return how to load a scene again, and a hash of the loaded data."""
    path = scene.metadata.get("path")
    return {
        "scene": scene.name if path is None else str(pathlib.Path(path).resolve()),
        "load_options": _with_divisor(load_options, scene),
        "check": scene.metadata.get("check"),
        "placement": {
            "center": scene.placement.center.tolist(),
            "scale": scene.placement.scale,
            "offset": scene.placement.offset.tolist(),
        },
        "data_sha256": hash_data(scene),
        "data_sha256_of": _HASHED,
    }


def _with_divisor(load_options: Mapping[str, Any], scene: Scene) -> dict[str, Any]:
    """Return options that load the scene again: with the chosen divisor, and corrections."""
    options = {name: value for name, value in load_options.items() if name != "pixels"}
    if corrections := scene.metadata.get("corrections"):
        options["corrections"] = list(corrections)
    return options | {"downscale": scene.metadata.get("downscale", 1)}


def identity_of(scene: Scene, preset: Preset, names: Mapping[str, str]) -> dict[str, Any]:
    """Return what tells one training from another, as JSON; programs add entries of their own.

    `names` has "method" and "preset".
    """
    size = scene.train.cameras
    return {
        "scene": scene.name,
        "config": plain_config(preset),
        **names,
        "resolution": [size.width, size.height],
        "version": jaxcloseup.__version__,
        "data_sha256": hash_data(scene),
        "target_views_sha256": hash_targets(scene),
    }


def write_dataparser_transforms(folder: pathlib.Path, scene: Scene) -> None:
    """Write `dataparser_transforms.json`, nerfstudio's record of a run's change of coordinates.

    Exports use the world of the capture's files. `transform` and `scale` lead to it from the
    capture's original world: they are the `applied_transform` and `applied_scale` of the capture's
    `transforms.json`, less the offset that exports leave out. As in nerfstudio's own records, this
    shift is in the unit of the files, which `applied_scale` has led to already.
    """
    applied = scene.metadata.get("applied_transform")
    transform = np.eye(3, 4) if applied is None else applied
    transform = transform - np.pad(scene.placement.offset[:, None], ((0, 0), (3, 0)))
    fields = {"transform": transform.tolist(), "scale": scene.metadata.get("applied_scale", 1.0)}
    write_json(folder / "dataparser_transforms.json", fields)


def hash_data(scene: Scene) -> str:
    """Return the SHA-256, in hexadecimal, of all scene data that training reads, except targets."""
    views = scene.train
    arrays = {
        "rgb": views.rgb,
        "weight": views.weight,
        "camtoworld": views.cameras.camtoworld,
        "intrinsics": views.cameras.intrinsics,
        "points": scene.points,
        "points_rgb": scene.rgb,
        "near_far": np.array([scene.near, scene.far], np.float64),
    }
    return _hash(arrays)


def hash_targets(scene: Scene) -> str | None:
    """Return the SHA-256 of the target cameras that `test_time` labels; None without close-ups."""
    if scene.test is None:
        return None
    cameras = scene.test.cameras
    return _hash({"camtoworld": cameras.camtoworld, "intrinsics": cameras.intrinsics})


def _hash(arrays: Mapping[str, Any]) -> str:
    digest = hashlib.sha256()
    for name, array in arrays.items():
        array = np.ascontiguousarray(array)
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.data)
    return digest.hexdigest()


def _resources_used(resumed: bool) -> dict[str, float | None]:
    """Return the core-seconds and the largest resident memory in bytes of this process so far."""
    if resumed:
        return {"core_seconds": None, "peak_bytes": None}
    return {"core_seconds": time.process_time(), "peak_bytes": peak_memory()}


def git_commit(folder: pathlib.Path) -> tuple[str | None, bool | None]:
    """Return the commit of a folder's checkout, and whether tracked files differ from the commit.

    Both are None if the folder is not part of a checkout, as in site-packages, or git is missing.
    """
    # An ignored folder, such as an environment inside another project, is not part of the checkout.
    tracked = _git(folder, "ls-files", "--", ".")
    commit = _git(folder, "rev-parse", "HEAD") if tracked else None
    if not commit:
        return None, None
    changes = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return commit, None if changes is None else bool(changes)


def _git(folder: pathlib.Path, *args: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *args], capture_output=True, text=True, timeout=30
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def versions() -> dict[str, str]:
    """Return the versions of the software that made the numbers, and the device."""
    return {
        "jaxcloseup": jaxcloseup.__version__,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
        "device": jax.devices()[0].device_kind,
    }
