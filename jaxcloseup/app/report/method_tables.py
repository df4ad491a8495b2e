"""Methods beside each other, scene by scene: scores, depth, the zoom ladder, time and memory."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxcloseup.app.report.record_table import Table, format_number, markdown
from jaxcloseup.app.run.manifest import NAME as MANIFEST
from jaxcloseup.app.score.ladder import PREFIX, rungs_of
from jaxcloseup.app.score.metrics_text import DEPTH_ERRORS, SPLIT_TITLES
from jaxcloseup.io.files import read_object, write_file, write_json


Record = Mapping[str, Any]  # of a method on a scene, as `read_method` returns it

_SPLITS = ("test", "test_far")


def read_method(folder: pathlib.Path) -> dict[str, Any]:
    """Read a finished sweep of one method on one scene: means over seeds, and cost.

    Returns:
      `arms`, by arm and split, the PSNR, and the depth error where it is known; `core_seconds` and
      `peak_bytes`, or None where they were not measured.
    """
    ((_, scores),) = read_object(folder / "sweep.json")["scenes"].items()
    arms: dict[str, dict[str, Any]] = {}
    for arm, seeds in scores.items():
        arms[arm] = _mean_scores(
            [
                {
                    split: {"psnr": scored["psnr"], "depth": _depth(scored)}
                    for split, scored in result["splits"].items()
                }
                for result in seeds.values()
            ]
        )
    manifest = read_object(folder / MANIFEST)
    cost = {name: manifest.get(name) for name in ("core_seconds", "peak_bytes")}
    return {"arms": arms, **cost}


def write_methods(folder: pathlib.Path, methods: Mapping[str, Mapping[str, Record]]) -> None:
    """Write `methods.json`, and `methods.md` with tables for each scene and their mean.

    Args:
      folder: folder to write to.
      methods: the records of `read_method` by method and scene.
    """
    write_json(folder / "methods.json", methods)
    scenes = list(dict.fromkeys(scene for by_scene in methods.values() for scene in by_scene))
    parts = [
        (scene, {name: records[scene] for name, records in methods.items() if scene in records})
        for scene in scenes
    ]
    complete = {name: records for name, records in methods.items() if set(records) == set(scenes)}
    if len(scenes) > 1 and complete:
        means: dict[str, Record] = {
            name: _mean_of(list(records.values())) for name, records in complete.items()
        }
        parts.insert(0, (f"mean of {', '.join(scenes)}", means))
    text = "\n".join(
        f"## {title}\n\n{markdown(_scores(shown))}\n{_ladder(shown)}" for title, shown in parts
    )
    write_file(folder / "methods.md", text.encode())


def _scores(methods: Mapping[str, Record]) -> Table:
    """Return PSNR by split and arm, depth errors, and the cost of each method."""
    arms = _arms(methods)
    columns = [(split, arm) for split in _SPLITS for arm in arms]
    header = ["method", *(f"{SPLIT_TITLES[split]}, {arm}" for split, arm in columns)]
    header += [f"depth off by, {SPLIT_TITLES[split].lower()}" for split in _SPLITS]
    body = []
    for name, record in methods.items():
        line = [format_number(_get(record, arm, split, "psnr")) for split, arm in columns]
        depths = [_get(record, _last_trained(arms), split, "depth") for split in _SPLITS]
        line += [format_number(depth, "{:.2%}") for depth in depths]
        seconds, peak = record["core_seconds"], record["peak_bytes"]
        minutes = None if seconds is None else seconds / 60
        memory = None if peak is None else peak / 2**30
        body.append([name, *line, format_number(minutes, "{:.1f}"), format_number(memory)])
    return Table("Scores", [*header, "core-minutes", "GiB"], body)


def _ladder(methods: Mapping[str, Record]) -> str:
    """Return a table of PSNR by magnification, in Markdown; empty without a zoom ladder."""
    arm = _last_trained(_arms(methods))
    rungs = rungs_of(
        {split for record in methods.values() for split in record["arms"].get(arm, {})}
    )
    if not rungs:
        return ""
    body = [
        [name, *(format_number(_get(record, arm, f"{PREFIX}{m:g}", "psnr")) for m in rungs)]
        for name, record in methods.items()
    ]
    header = [f"{arm}, by magnification", *(f"{m:g}x" for m in rungs)]
    return markdown(Table("Zoom ladder", header, body)) + "\n"


def _arms(methods: Mapping[str, Record]) -> list[str]:
    return list(dict.fromkeys(arm for record in methods.values() for arm in record["arms"]))


def _last_trained(arms: Sequence[str]) -> str:
    """Return the arm whose depth and ladder are shown: control, which every method trains alike."""
    return "control" if "control" in arms else arms[-1]


def _get(record: Record, arm: str, split: str, metric: str) -> float | None:
    return record["arms"].get(arm, {}).get(split, {}).get(metric)


def _depth(scores: Mapping[str, float | None]) -> float | None:
    return next((scores[name] for name in DEPTH_ERRORS if scores.get(name) is not None), None)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _mean_scores(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the mean PSNR and depth error of every split that all runs have."""
    shared = [split for split in (runs[0] if runs else ()) if all(split in run for run in runs)]
    return {
        split: {key: _mean([run[split][key] for run in runs]) for key in ("psnr", "depth")}
        for split in shared
    }


def _mean_of(records: Sequence[Record]) -> dict[str, Any]:
    """Return means over scenes of everything that all scenes have, and the largest memory."""
    arms = {
        arm: _mean_scores([record["arms"].get(arm, {}) for record in records])
        for arm in records[0]["arms"]
    }
    peaks = [record["peak_bytes"] for record in records if record["peak_bytes"] is not None]
    seconds = _mean([record["core_seconds"] for record in records])
    return {"arms": arms, "core_seconds": seconds, "peak_bytes": max(peaks, default=None)}
