"""Detect the format of a capture folder."""

import os
import pathlib
import shlex
from typing import NamedTuple

from jaxcloseup.captures.colmap_files import MODELS, find_models
from jaxcloseup.captures.photo_masks import list_pictures
from jaxcloseup.captures.photo_search import photograph_folders
from jaxcloseup.photos.scene import SceneError


SEPARATE, SINGLE, _LLFF = "transforms_train.json", "transforms.json", "poses_bounds.npy"


class Detected(NamedTuple):
    """What of a folder is read."""

    format: str  # one of `FORMATS`
    folder: pathlib.Path  # folder of the capture
    path: pathlib.Path  # main file, or folder of the model
    note: str  # says so, and what else there is


def detect(path: pathlib.Path, format: str | None) -> Detected:
    """Find what is read of a folder, of one of `FORMATS`, or of the first found if None.

    Raises:
      SceneError: there is no such folder, or it holds no capture of this format.
    """
    if not path.is_dir():
        raise SceneError(f"{path} is not a folder: give the folder that holds the capture.")
    files = [("transforms", SEPARATE), ("transforms", SINGLE)]
    found = [(kind, name, name) for kind, name in files if (path / name).is_file()]
    models = find_models(path)
    for name, count in models:
        about = f"the COLMAP model in {path.resolve().name if name == '.' else name}"
        found.append(("colmap", name, about + f" ({count} photographs)" * (len(models) > 1)))
    found += [("llff", _LLFF, _LLFF)] * (path / _LLFF).is_file()
    found = [one for one in found if format in (None, one[0])]
    if not found:
        raise _no_capture(path, format)
    (kind, name, about), *others = found
    folder = _folder_of_model(path) if name == "." else path
    rejected = " or ".join(other for _, _, other in others)
    note = f"reading {about}" + (f" and not {rejected}" if rejected else "")
    return Detected(kind, folder, path / name, note)


def _no_capture(path: pathlib.Path, format: str | None) -> SceneError:
    """Return the error for a folder that holds no capture of this format."""
    kind = f" in the format {format}" if format else ""
    files = (
        f"add {SEPARATE}, {SINGLE}, {_LLFF}, or a COLMAP model in {', '.join(MODELS)} or in "
        "the folder itself."
    )
    holding = (folder for folder in photograph_folders(path) if list_pictures(folder))
    if pictures := None if format else next(holding, None):
        target = shlex.quote(f"{path.resolve().name}_capture")
        return SceneError(
            f"{path} holds no capture but photographs: find their poses with jaxcloseup "
            f"process --images={shlex.quote(str(pictures))} --output_dir={target}, let jaxcloseup "
            f"closeup {shlex.quote(str(pictures))} do all up to a page of close-ups, or {files}"
        )
    return SceneError(f"{path} holds no capture{kind}: {files}")


def _folder_of_model(model: pathlib.Path) -> pathlib.Path:
    """Find the capture that a model belongs to: its folder, if it holds photographs, or a parent.

    That is the nearest one with a folder of photographs.
    """
    around = model.resolve()
    candidates = [at for at in (around, *around.parents)[:4] if os.access(at, os.R_OK)]
    with_images = (folder for folder in candidates if photograph_folders(folder)[0] != folder)
    return model if list_pictures(model) else next(with_images, model)
