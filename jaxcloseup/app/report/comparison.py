"""Several finished runs on one scene, compared: a verdict, tables, close-ups and one page."""

import html
import itertools
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.app.methods.settings import GROUPS
from jaxcloseup.app.report.audits import zoom_plots
from jaxcloseup.app.report.headline import tables, than
from jaxcloseup.app.report.page import figure, folded, head, score_tables, slider, table
from jaxcloseup.app.report.run_page import rows
from jaxcloseup.app.report.showcase import best_middle_worst
from jaxcloseup.app.score.metrics_text import FINER, SPLIT_TITLES
from jaxcloseup.app.store.stored_run import RunError, read_fields
from jaxcloseup.captures.photo_files import read_image
from jaxcloseup.io.files import write_file, write_json
from jaxcloseup.photos.scene import SceneError


MOST_BYTES = 3_000_000  # of the page
_QUALITIES = (90, 75, 50, 25)  # of pictures, the first with which the page is small enough
_STAGES = ("detail", "closeup", "control", "baseline")  # compared is the first that a run has
_RESULTS = {
    **{"scene": str, "method": str, "preset": str, "seed": int, "resolution": list},
    **{"stages": dict, "config": dict, "seconds": dict},
}


class Finished(NamedTuple):
    """A finished run.

    Attributes:
      name: what tells it from the others.
      folder: its folder.
      results: its `results.json`.
      photographs: the hash of the data that it was trained on.
      stage: the stage that is compared.
      scores: that stage's scores by split.
    """

    name: str
    folder: pathlib.Path
    results: Mapping[str, Any]
    photographs: str
    stage: str
    scores: Mapping[str, Any]


def read_finished(folders: Sequence[str]) -> list[Finished]:
    """Read runs, and check that they can be compared.

    Raises:
      RunError: fewer than two runs are named, one is not finished or damaged, or they differ in
        scene, split or resolution.
    """
    paths = [pathlib.Path(folder) for folder in folders]
    if len({path.resolve() for path in paths}) < max(2, len(paths)):
        raise RunError("--runs must name at least two folders of runs, each once, between commas")
    common = os.path.commonpath([path.resolve() for path in paths])
    runs = [_read(path, str(path.resolve().relative_to(common))) for path in paths]
    first = runs[0]
    for run in runs[1:]:
        _check_alike(first, run)
    return runs


def _read(folder, name):
    path = folder / "results.json"
    if not path.exists():
        raise RunError(
            f"--runs: {folder} has no results.json: name folders of finished runs of "
            "experiments.run"
        )
    results = read_fields(path, _RESULTS)
    about = read_fields(folder / "manifest.json", {"data_sha256": str})
    stages = results["stages"]
    stage = next((stage for stage in (*_STAGES, *stages) if stage in stages), None)
    if stage is None or not _is_scored(stages[stage]):
        raise RunError(
            f"{path}: stages must hold scores by stage and split: restore the file from a copy of "
            "the run"
        )
    return Finished(name, folder, results, about["data_sha256"], stage, stages[stage])


def _is_scored(splits):
    """Whether these are scores by split, as runs write them."""

    def is_number(value):
        return value is None or (isinstance(value, int | float) and np.isfinite(value))

    return isinstance(splits, dict) and all(
        isinstance(scores, dict)
        and isinstance(scores.get("views"), dict)
        and all(
            is_number(scores.get(key))
            for key in scores
            if not key.endswith("reason") and key != "views"
        )
        and all(
            isinstance(view, dict) and is_number(view.get("psnr"))
            for view in scores["views"].values()
        )
        for scores in splits.values()
    )


def _check_alike(first, run):
    def views(one):
        return {
            split: sorted(one.scores.get(split, {"views": ()})["views"])
            for split in SPLIT_TITLES
            if not split.endswith(FINER)
        }

    def size(one):
        finer = one.results.get("finer_resolution")
        return one.results["resolution"], finer

    (own, own_finer), (other, other_finer) = size(first), size(run)
    if own == other and own_finer and other_finer:
        own, other = own_finer, other_finer
    if first.results["scene"] != run.results["scene"]:
        found = f"shows {first.results['scene']} and {run.name} shows {run.results['scene']}"
        advice = "name runs of one scene"
    elif own != other:
        found = f"has views of {_pixels(own)} and {run.name} of {_pixels(other)}"
        advice = "name runs with one --downscale"
    elif views(first) != views(run) or first.photographs != run.photographs:
        found = f"and {run.name} have other photographs, or another split of them"
        advice = "name runs with one --split of the same photographs"
    else:
        return
    raise RunError(f"--runs cannot be compared: {first.name} {found}: {advice}")


def _pixels(size):
    return f"{' x '.join(map(str, size))} pixels"


def as_stages(runs: Sequence[Finished]) -> dict[str, Any]:
    """What tables take: results whose stages are the runs."""
    finer = (run.results.get("finer_resolution") for run in runs)
    return {
        "stages": {run.name: run.scores for run in runs},
        "gate": None,
        "finer_resolution": next((size for size in finer if size), None),
    }


def comparison_tables(runs: Sequence[Finished]) -> dict[str, tuple[list[str], list[list[str]]]]:
    """A header and a row for each run, by the title of the views; at most six columns."""
    found = tables(as_stages(runs))
    return {title: (["run", *header[1:]], body) for title, (header, body) in found.items()}


def say_which_is_best(runs: Sequence[Finished]) -> str:
    """Which run is best, in a sentence: on close-ups, or ordinary views if there are none."""
    known = (split for split in ("test", "test_far") if any(_psnr(run, split) for run in runs))
    split = next(known, None)
    if split is None:
        return "No view was held out, so nothing tells which run is better."
    mean = {run.name: run.scores.get(split, {}).get("psnr") for run in runs}
    best, *others = sorted(runs, key=lambda run: -(mean[run.name] or -np.inf))
    parts = []
    for other in others:
        ours, theirs = _psnr(best, split), _psnr(other, split)
        both = ours.keys() & theirs.keys()
        if mean[other.name] is None or not both:
            continue
        wins = sum(ours[view] > theirs[view] for view in both)
        ahead = mean[best.name] - mean[other.name]
        change = f"{than(ahead, 2)} than" if round(ahead, 2) else "as good as"
        parts.append(f"{change} {other.name} (better in {wins} of {len(both)} views)")
    text = f"{SPLIT_TITLES[split]} are best in {best.name}, with a PSNR of {mean[best.name]:.1f} dB"
    return f"{text}: {', '.join(parts)}." if parts else f"{text}."


def _psnr(run, split):
    """PSNR by view, where it is known."""
    views = run.scores.get(split, {"views": {}})["views"]
    return {name: view["psnr"] for name, view in views.items() if view.get("psnr") is not None}


def differences(runs: Sequence[Finished]) -> list[list[str]]:
    """A row for each thing in which the runs differ: its name, and what it is in each run."""
    facts = []
    for run in runs:
        about = {name: run.results[name] for name in ("method", "preset", "seed")}
        seconds = sum(
            one for one in run.results["seconds"].values() if isinstance(one, int | float)
        )
        about |= {"stage": run.stage, "minutes": f"{seconds / 60:.0f}"}
        facts.append(about | _flat(run.results["config"]))
    names = dict.fromkeys(itertools.chain.from_iterable(facts))
    found = [[name, *(_text(one.get(name)) for one in facts)] for name in names]
    return [row for row in found if len(set(row[1:])) > 1]


def _flat(config, before=""):
    """The settings of a configuration by the names that `--set` has for them."""
    found = {}
    for name, value in config.items():
        if isinstance(value, dict):
            found |= _flat(value, before if name in GROUPS else f"{before}{name}.")
        else:
            found[before + name] = value
    return found


def _text(value):
    if isinstance(value, list):
        return ":".join(map(str, value))
    return "-" if value is None else str(value)


def write_comparison(folder: pathlib.Path, runs: Sequence[Finished]) -> None:
    """Write `compare.json` and `report.html`, one page that needs no other file.

    Raises:
      RunError: a picture of a run cannot be read.
    """
    shown = _close_ups(runs)
    write_json(
        folder / "compare.json",
        {
            "scene": runs[0].results["scene"],
            "resolution": runs[0].results["resolution"],
            "verdict": say_which_is_best(runs),
            "runs": {run.name: _record(run) for run in runs},
            "differences": {name: values for name, *values in differences(runs)},
        },
    )
    for quality in _QUALITIES:
        page = "\n".join(_page(runs, shown, quality)).encode()
        if len(page) <= MOST_BYTES:
            break
    write_file(folder / "report.html", page)


def _record(run):
    scores = {
        split: {key: value for key, value in found.items() if key != "views"}
        for split, found in run.scores.items()
    }
    about = {name: run.results[name] for name in ("method", "preset", "seed")}
    return {"folder": str(run.folder.resolve()), "stage": run.stage, **about, "scores": scores}


def _close_ups(runs):
    """Name, truth and renders of the views with the best, middle and worst mean PSNR."""
    for split in (f"test{FINER}", "test", f"test_far{FINER}", "test_far"):
        if all(_psnr(run, split) for run in runs):
            break
    else:
        return []
    common = set.intersection(*(set(_psnr(run, split)) for run in runs))
    psnr = {name: np.mean([_psnr(run, split)[name] for run in runs]) for name in sorted(common)}
    found = []
    for name in best_middle_worst(psnr):
        truth = _picture(runs[0], "truth", split, name)
        renders = [
            (run.name, _psnr(run, split)[name], _picture(run, run.stage, split, name))
            for run in runs
        ]
        if any(image.shape != truth.shape for *_, image in renders):
            raise RunError(f"--runs cannot be compared: their renders of {name} differ in size")
        found.append((name, truth, renders))
    return found


def _picture(run, stage, split, name):
    path = run.folder / "renders" / stage / split / "rgb" / f"{name}.png"
    try:
        return read_image(path)
    except (SceneError, OSError) as error:
        raise RunError(f"--runs: {error}") from None


def _page(runs, shown, quality):
    names = ", ".join(run.name for run in runs)
    parts = [
        *head(f"{runs[0].results['scene']}: {names}"),
        f"<p class=verdict>{html.escape(say_which_is_best(runs))}</p>",
    ]
    if shown:
        parts.append(
            "<h2>Views</h2><p class=quiet>The views that the runs render best, middling and worst, "
            "by their mean PSNR. Move across a picture: on its left is the truth, and on its right "
            "what the run renders; the pictures beside it move too.</p>"
        )
    for name, truth, renders in shown:
        parts.append(f"<h3>{html.escape(name)}</h3><div class=pair>")
        for run, psnr, image in renders:
            caption = f"{run}: {psnr:.1f} dB"
            parts.append(slider(truth, image, ("the truth", caption), caption, quality=quality))
        parts += [figure(truth, "the truth", quality=quality), "</div>"]
    parts += ["<h2>Scores</h2>", *score_tables(comparison_tables(runs))]
    parts.append(
        "<p class=quiet>Higher PSNR and SSIM are better, and lower LPIPS. Compared is the stage "
        "<i>detail</i> of a run, or else <i>closeup</i>, <i>control</i> or <i>baseline</i>.</p>"
    )
    found = as_stages(runs)
    parts += folded("PSNR by magnification", zoom_plots(found["stages"]))
    header, *body = rows(found)
    parts += folded("All scores", [table(header, body, names=2)])
    differ = table(["", *(run.name for run in runs)], differences(runs))
    return [*parts, *folded("In what the runs differ", [differ]), "</html>"]
