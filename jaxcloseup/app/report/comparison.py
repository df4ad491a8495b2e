"""Compare finished runs on one scene: a verdict, tables, close-ups and one page."""

import itertools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.app.methods.settings import GROUPS
from jaxcloseup.app.report.audits import zoom_plots
from jaxcloseup.app.report.finished_runs import Finished
from jaxcloseup.app.report.headline import all_scores, compare_psnr, score_tables
from jaxcloseup.app.report.page import QUALITIES, fill_page
from jaxcloseup.app.report.record_table import Table
from jaxcloseup.app.report.showcase import best_middle_worst
from jaxcloseup.app.score.metrics_text import SPLIT_TITLES
from jaxcloseup.app.store.stored_run import RunError
from jaxcloseup.io.files import write_file, write_json


MOST_BYTES = 3_000_000  # of the page


class Render(NamedTuple):
    """A run's render of a view, uint8 `[H, W, 3]`, and its PSNR in dB."""

    run: str
    psnr: float
    image: np.ndarray


class View(NamedTuple):
    """A held-out view: its true image, uint8 `[H, W, 3]`, and the render of each run."""

    name: str
    truth: np.ndarray
    renders: list[Render]


def comparison_tables(runs: Sequence[Finished]) -> list[Table]:
    """Return a table for each kind of view, with a row for each run."""
    first, *others = (run.results["resolution"] for run in runs)
    alike = all(size == first for size in others)
    return score_tables(_scores(runs), reduced_size=first if alike else None, row="run")


def _scores(runs: Sequence[Finished]) -> dict[str, Mapping[str, Any]]:
    return {run.name: run.scores for run in runs}


def say_which_is_best(runs: Sequence[Finished]) -> str:
    """Return which run is best on close-ups, or on ordinary views if there are none."""
    known = (split for split in ("test", "test_far") if any(run.psnr(split) for run in runs))
    split = next(known, None)
    if split is None:
        return "No view was held out, so nothing tells which run is better."
    mean = {run.name: run.scores.get(split, {}).get("psnr") for run in runs}
    best, *others = sorted(runs, key=lambda run: -(mean[run.name] or -np.inf))
    parts = []
    for other in others:
        ours, theirs = best.psnr(split), other.psnr(split)
        both = ours.keys() & theirs.keys()
        if mean[other.name] is None or not both:
            continue
        wins = sum(ours[view] > theirs[view] for view in both)
        ahead = mean[best.name] - mean[other.name]
        change = f"{compare_psnr(ahead, 2)} than" if round(ahead, 2) else "as good as"
        parts.append(f"{change} {other.name} (better in {wins} of {len(both)} views)")
    text = f"{SPLIT_TITLES[split]} are best in {best.name}, with a PSNR of {mean[best.name]:.1f} dB"
    return f"{text}: {', '.join(parts)}." if parts else f"{text}."


def differences(runs: Sequence[Finished]) -> Table:
    """Return a row for each fact and setting in which the runs differ."""
    facts = []
    for run in runs:
        about = _about(run) | {"stage": run.stage, "minutes": _minutes(run)}
        facts.append(about | _flat(run.results["config"]))
    names = dict.fromkeys(itertools.chain.from_iterable(facts))
    body = [[name, *(_text(known.get(name)) for known in facts)] for name in names]
    body = [row for row in body if len(set(row[1:])) > 1]
    return Table("Differences between the runs", ["", *(run.name for run in runs)], body)


def _minutes(run: Finished) -> str | None:
    """Return the minutes of a run; None if it was resumed, because only the last are known."""
    seconds = {**run.results["seconds"], "compile": 0}  # which the stages' own seconds hold
    counted = (value for value in seconds.values() if isinstance(value, int | float))
    return None if run.resumed else f"{sum(counted) / 60:.0f}"


def _about(run: Finished) -> dict[str, Any]:
    return {name: run.results[name] for name in ("method", "preset", "seed")}


def _flat(config: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return the settings of a configuration by their names in `--set`."""
    settings: dict[str, Any] = {}
    for name, value in config.items():
        if isinstance(value, dict):
            settings |= _flat(value, before if name in GROUPS else f"{before}{name}.")
        else:
            settings[before + name] = value
    return settings


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ":".join(map(str, value))
    return "-" if value is None else str(value)


def write_comparison(folder: pathlib.Path, runs: Sequence[Finished]) -> None:
    """Write `compare.json` and `report.html`.

    Raises:
      RunError: a picture of a run cannot be read.
    """
    verdict, differ, scores = say_which_is_best(runs), differences(runs), _scores(runs)
    title = f"{runs[0].results['scene']}: {', '.join(scores)}"
    data: dict[str, Any] = {
        "verdict": verdict,
        "views": _views(runs),
        "tables": comparison_tables(runs),
        "zoom_plots": zoom_plots(scores),
        "all_scores": all_scores(scores),
        "differences": differ,
    }
    write_json(
        folder / "compare.json",
        {
            "scene": runs[0].results["scene"],
            "resolution": runs[0].results["resolution"],
            "verdict": verdict,
            "runs": {run.name: _record(run) for run in runs},
            "differences": {name: values for name, *values in differ.rows},
        },
    )
    for quality in QUALITIES:
        page = fill_page("comparison.html", title=title, quality=quality, **data)
        if len(page) <= MOST_BYTES:
            break
    write_file(folder / "report.html", page)


def _record(run: Finished) -> dict[str, Any]:
    scores = {
        split: {key: value for key, value in metrics.items() if key != "views"}
        for split, metrics in run.scores.items()
    }
    return {
        "folder": str(run.folder.resolve()),
        "stage": run.stage,
        **_about(run),
        "scores": scores,
    }


def _views(runs: Sequence[Finished]) -> list[View]:
    """Read the views with the best, middle and worst mean PSNR."""
    for split in ("test", "test_far"):
        if all(run.psnr(split) for run in runs):
            break
    else:
        return []
    psnr = [run.psnr(split) for run in runs]
    common = sorted(set.intersection(*map(set, psnr)))
    mean = {name: float(np.mean([known[name] for known in psnr])) for name in common}
    views = []
    for name in best_middle_worst(mean):
        truth = runs[0].picture("truth", split, name)
        renders = [
            Render(run.name, known[name], run.picture(run.stage, split, name))
            for run, known in zip(runs, psnr, strict=True)
        ]
        if any(render.image.shape != truth.shape for render in renders):
            raise RunError(f"--runs cannot be compared: their renders of {name} differ in size")
        views.append(View(name, truth, renders))
    return views
