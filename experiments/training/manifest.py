"""manifest.json: what made a run, so that its numbers can be traced and its scene loaded again."""

import contextlib
import hashlib
import json
import pathlib
import platform
import subprocess
import warnings
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

import jaxcloseup
from jaxcloseup.files import write_json
from jaxcloseup.scenes import Scene


NAME = "manifest.json"
_HASHED = (
    "rgb, weight, camtoworld and intrinsics of the training views, points and their rgb, near and "
    "far, as they are after loading; each as its name, dtype, shape and bytes"
)


def write_manifest(
    folder: pathlib.Path, about: Mapping[str, Any], seconds: Mapping[str, Any] | None = None
) -> None:
    """Write `manifest.json`, whole or not at all; without `seconds` the run is not over yet.

    Args:
      folder: of the run.
      about: configuration, versions (the device among them), seeds and scenes.
      seconds: wall time of each stage since the run was begun or resumed; for a sweep by scene.
    """
    commit, changed = git_commit(pathlib.Path(jaxcloseup.__file__).parent)
    before = None
    with contextlib.suppress(OSError, ValueError):
        before = json.loads((folder / NAME).read_bytes())["git_commit"]
    if None not in (before, commit) and before != commit:
        warnings.warn(
            f"{folder} was begun with commit {before[:9]} and goes on with {commit[:9]}: start "
            "anew if what lies between them matters",
            stacklevel=2,
        )
    git = {"git_commit": commit, "git_changed": changed}
    write_json(folder / NAME, {**about, **git, "finished": seconds is not None, "seconds": seconds})


def about_scene(scene: Scene, load_options: Mapping[str, Any]) -> dict[str, Any]:
    """How to load a scene again, and the hash of what was loaded.

    Args:
      scene: as `load_scene` returned it.
      load_options: those that it was given, beside the name or path.
    """
    path = scene.metadata.get("path")
    return {
        "scene": scene.name if path is None else str(pathlib.Path(path).resolve()),
        "load_options": dict(load_options),
        "data_sha256": hash_data(scene),
        "data_sha256_of": _HASHED,
    }


def write_dataparser_transforms(folder: pathlib.Path, scene: Scene) -> None:
    """Write `dataparser_transforms.json`, nerfstudio's record of how a run changed coordinates.

    Exports are in the scene's world, in which training is too: `transform` and `scale` are the
    `applied_transform` and `applied_scale` of the capture's `transforms.json`, from its original
    world to this one.
    """
    applied = scene.metadata.get("applied_transform")
    transform = np.eye(3, 4) if applied is None else applied
    fields = {"transform": transform.tolist(), "scale": scene.metadata.get("applied_scale", 1.0)}
    write_json(folder / "dataparser_transforms.json", fields)


def hash_data(scene: Scene) -> str:
    """SHA-256, in hexadecimal, of what training reads of a scene, wanted views apart."""
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


def hash_wanted(scene: Scene) -> str | None:
    """SHA-256 of the cameras of the close-ups, which `test_time` labels; None without any."""
    if scene.test is None:
        return None
    cameras = scene.test.cameras
    return _hash({"camtoworld": cameras.camtoworld, "intrinsics": cameras.intrinsics})


def _hash(arrays):
    digest = hashlib.sha256()
    for name, array in arrays.items():
        array = np.ascontiguousarray(array)
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.data)
    return digest.hexdigest()


def git_commit(folder: pathlib.Path) -> tuple[str | None, bool | None]:
    """The commit that a folder is checked out at, and whether tracked files differ from it.

    Both are None where the folder is no part of a checkout, as in site-packages, or git is missing.
    """
    # A folder that git ignores, such as an environment inside of another project, is not tracked.
    tracked = _git(folder, "ls-files", "--", ".")
    commit = _git(folder, "rev-parse", "HEAD") if tracked else None
    if not commit:
        return None, None
    changes = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return commit, None if changes is None else bool(changes)


def _git(folder, *args):
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *args], capture_output=True, text=True, timeout=30
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def versions() -> dict[str, str]:
    """What made the numbers."""
    return {
        "jaxcloseup": jaxcloseup.__version__,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
        "device": jax.devices()[0].device_kind,
    }
