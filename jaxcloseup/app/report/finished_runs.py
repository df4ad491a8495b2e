"""Read finished runs that are compared, and check that they can be."""

import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.app.score.metrics_text import REDUCED, SPLIT_TITLES
from jaxcloseup.app.score.scores import CURVE
from jaxcloseup.app.store.stored_run import RunError, read_fields
from jaxcloseup.captures.photo_files import read_image
from jaxcloseup.photos.scene import SceneError


_STAGES = ("detail", "closeup", "control", "baseline")  # the first that a run has is compared
_RESULTS: dict[str, type] = {
    "scene": str,
    "method": str,
    "preset": str,
    "seed": int,
    "resolution": list,
    "stages": dict,
    "config": dict,
    "seconds": dict,
}


class Finished(NamedTuple):
    """A finished run."""

    name: str  # the part of its path that differs from the other runs'
    folder: pathlib.Path  # its folder
    results: Mapping[str, Any]  # its `results.json`
    photographs: str  # hash of its training data
    resumed: bool  # whether several processes trained it, the last of which knows its own time
    stage: str  # the stage that is compared
    scores: Mapping[str, Any]  # scores of that stage by split

    def psnr(self, split: str) -> dict[str, float]:
        """Return PSNR by view, where it is known."""
        views = self.scores.get(split, {"views": {}})["views"]
        return {name: view["psnr"] for name, view in views.items() if view.get("psnr") is not None}

    def picture(self, stage: str, split: str, view: str) -> np.ndarray:
        """Read the render of a stage, or the true image of the stage "truth"."""
        path = self.folder / "renders" / stage / split / "rgb" / f"{view}.png"
        try:
            return read_image(path)
        except (SceneError, OSError) as error:
            raise RunError(f"--runs: {error}") from None


def read_finished(folders: Sequence[str]) -> list[Finished]:
    """Read runs, and check that they can be compared.

    Raises:
      RunError: fewer than two runs are named, a run is not finished or damaged, or runs differ in
        scene, split or resolution.
    """
    paths = [pathlib.Path(folder) for folder in folders]
    if len({path.resolve() for path in paths}) < max(2, len(paths)):
        raise RunError("--runs must name at least two folders of runs, each once, between commas")
    common = os.path.commonpath([path.resolve() for path in paths])
    runs = [_read(path, str(path.resolve().relative_to(common))) for path in paths]
    for run in runs[1:]:
        _check_alike(runs[0], run)
    return runs


def _read(folder: pathlib.Path, name: str) -> Finished:
    path = folder / "results.json"
    if not path.exists():
        raise RunError(f"--runs: {folder} has no results.json: name folders of finished runs")
    results = read_fields(path, _RESULTS)
    about = read_fields(folder / "manifest.json", {"data_sha256": str})
    resumed = about.get("resumed") is True
    stages = results["stages"]
    stage = next((stage for stage in (*_STAGES, *stages) if stage in stages), None)
    if stage is None or not _is_scored(stages[stage]):
        raise RunError(
            f"{path}: stages must hold scores by stage and split: restore the file from a copy of "
            "the run"
        )
    photographs, scores = about["data_sha256"], stages[stage]
    return Finished(name, folder, results, photographs, resumed, stage, scores)


def _is_scored(splits: Any) -> bool:
    """Return True if these are scores by split, as runs write them."""
    return isinstance(splits, dict) and all(map(_is_split, splits.values()))


def _is_split(scores: Any) -> bool:
    return (
        isinstance(scores, dict)
        and isinstance(scores.get("views"), dict)
        and all(
            _is_number(value)
            for key, value in scores.items()
            if not key.endswith("reason") and key not in ("views", CURVE)
        )
        and all(
            isinstance(view, dict) and _is_number(view.get("psnr"))
            for view in scores["views"].values()
        )
    )


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and bool(np.isfinite(value)))


def _check_alike(first: Finished, run: Finished) -> None:
    """Raise a RunError if two runs cannot be compared."""
    size, other = (
        each.results.get("scored_at") or each.results["resolution"] for each in (first, run)
    )
    if first.results["scene"] != run.results["scene"]:
        why = f"shows {first.results['scene']} and {run.name} shows {run.results['scene']}"
        advice = "name runs of one scene"
    elif size != other:
        why = f"has views of {_pixels(size)} and {run.name} of {_pixels(other)}"
        advice = "name runs with one --score_width"
    elif _views(first) != _views(run) or not _same_photographs(first, run):
        why = f"and {run.name} have other photographs, or another split of them"
        advice = "name runs with one --split of the same photographs"
    else:
        return
    raise RunError(f"--runs cannot be compared: {first.name} {why}: {advice}")


def _same_photographs(first: Finished, run: Finished) -> bool:
    """Return False if runs learned from other photographs, as far as their hashes can tell."""
    # Hashes of photographs that were reduced to other sizes differ anyway.
    alike = first.results["resolution"] == run.results["resolution"]
    return not alike or first.photographs == run.photographs


def _views(run: Finished) -> dict[str, list[str]]:
    """Return the names of the held-out views by split."""
    return {
        split: sorted(run.scores.get(split, {"views": ()})["views"])
        for split in SPLIT_TITLES
        if not split.endswith(REDUCED)
    }


def _pixels(size: Sequence[int]) -> str:
    return f"{' x '.join(map(str, size))} pixels"
