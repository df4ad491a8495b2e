"""Methods beside each other, scene by scene: scores, depth, the zoom ladder, time and memory."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxcloseup.app.run.manifest import NAME as MANIFEST
from jaxcloseup.app.score.ladder import PREFIX, rungs_of
from jaxcloseup.app.score.metrics_text import SPLIT_TITLES
from jaxcloseup.io.files import read_object, write_file, write_json


_DEPTHS = ("depth_error_median", "point_depth_error_median")  # exact, or at a capture's points
_SPLITS = ("test", "test_far")


def read_method(folder: pathlib.Path) -> dict[str, Any]:
    """What a finished sweep of one method on one scene left: its means over seeds, and its cost.

    Returns:
      `arms`, by arm and split, the PSNR, and the depth error where it is known; `core_seconds` and
      `peak_bytes`, or None where they were not measured.
    """
    ((_, scores),) = read_object(folder / "sweep.json")["scenes"].items()
    arms: dict[str, dict[str, Any]] = {}
    for arm, seeds in scores.items():
        splits = [result["splits"] for result in seeds.values()]
        arms[arm] = {
            split: {
                "psnr": _mean([one[split]["psnr"] for one in splits]),
                "depth": _mean([_depth(one[split]) for one in splits]),
            }
            for split in (splits[0] if splits else ())
        }
    manifest = read_object(folder / MANIFEST)
    cost = {name: manifest.get(name) for name in ("core_seconds", "peak_bytes")}
    return {"arms": arms, **cost}


def write_methods(folder: pathlib.Path, found: Mapping[str, Mapping[str, Any]]) -> None:
    """Write `methods.json`, and `methods.md` with tables for each scene and their mean.

    Args:
      folder: folder to write to.
      found: what `read_method` returned, by method and scene.
    """
    write_json(folder / "methods.json", found)
    scenes = list(dict.fromkeys(scene for by_scene in found.values() for scene in by_scene))
    parts = [
        (scene, {m: one[scene] for m, one in found.items() if scene in one}) for scene in scenes
    ]
    complete = {m: one for m, one in found.items() if set(one) == set(scenes)}
    if len(scenes) > 1 and complete:
        means = {m: _mean_of(list(one.values())) for m, one in complete.items()}
        parts.insert(0, (f"mean of {', '.join(scenes)}", means))
    lines = []
    for title, methods in parts:
        lines += [f"## {title}", "", *_scores(methods), "", *_ladder(methods), ""]
    write_file(folder / "methods.md", "\n".join(lines).encode())


def _scores(methods):
    """A table of PSNR by split and arm, of depth, and of what each method costs."""
    arms = list(dict.fromkeys(arm for one in methods.values() for arm in one["arms"]))
    columns = [(split, arm) for split in _SPLITS for arm in arms]
    header = ["method", *(f"{SPLIT_TITLES[split]}, {arm}" for split, arm in columns)]
    header += [f"depth off by, {SPLIT_TITLES[split].lower()}" for split in _SPLITS]
    body = []
    for name, one in methods.items():
        line = [_number(_get(one, arm, split, "psnr")) for split, arm in columns]
        depths = [_get(one, _last_trained(arms), split, "depth") for split in _SPLITS]
        line += [_number(depth, "{:.2%}") for depth in depths]
        minutes = None if one["core_seconds"] is None else one["core_seconds"] / 60
        memory = None if one["peak_bytes"] is None else one["peak_bytes"] / 2**30
        body.append([name, *line, _number(minutes, "{:.1f}"), _number(memory)])
    return _table([*header, "core-minutes", "GiB"], body)


def _ladder(methods):
    """A table of PSNR by magnification, of control or the arm that stands for it."""
    arms = list(dict.fromkeys(arm for one in methods.values() for arm in one["arms"]))
    arm = _last_trained(arms)
    rungs = rungs_of({split for one in methods.values() for split in one["arms"].get(arm, {})})
    if not rungs:
        return []
    body = [
        [name, *(_number(_get(one, arm, f"{PREFIX}{m:g}", "psnr")) for m in rungs)]
        for name, one in methods.items()
    ]
    return _table([f"{arm}, by magnification", *(f"{m:g}x" for m in rungs)], body)


def _last_trained(arms):
    """The arm whose depth and ladder are shown: control, which every method trains alike."""
    return "control" if "control" in arms else arms[-1]


def _get(one, arm, split, metric):
    return one["arms"].get(arm, {}).get(split, {}).get(metric)


def _depth(scores):
    return next((scores[name] for name in _DEPTHS if scores.get(name) is not None), None)


def _mean(values):
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _mean_of(scenes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The mean over scenes of what all of them have; the largest memory."""
    arms: dict[str, dict[str, Any]] = {}
    for arm in scenes[0]["arms"]:
        splits = [one["arms"].get(arm, {}) for one in scenes]
        shared = [split for split in splits[0] if all(split in one for one in splits)]
        arms[arm] = {
            split: {key: _mean([one[split][key] for one in splits]) for key in ("psnr", "depth")}
            for split in shared
        }
    peaks = [one["peak_bytes"] for one in scenes if one["peak_bytes"] is not None]
    seconds = _mean([one["core_seconds"] for one in scenes])
    return {"arms": arms, "core_seconds": seconds, "peak_bytes": max(peaks, default=None)}


def _number(value, pattern="{:.2f}"):
    return "-" if value is None else pattern.format(value)


def _table(header, body):
    lines = [header, ["---"] * len(header), *body]
    return ["| " + " | ".join(line) + " |" for line in lines]
