"""Tables of a sweep: means over seeds and scenes, and intervals of differences from control.

The interval measures how the mean difference of the trained models varies with the choice of views.
The standard deviation measures how the mean varies with the seed.
"""

import csv
import dataclasses
import io
import itertools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.app.report.page import Picture, by_section, fill_page
from jaxcloseup.app.report.plots import Curve, line_plot
from jaxcloseup.app.report.record_table import Table, format_number, markdown, print_tables
from jaxcloseup.app.run.stage_names import OWN_CONTROL
from jaxcloseup.app.score.ladder import MAGNIFICATIONS, PREFIX
from jaxcloseup.app.score.metrics_text import SPLIT_TITLES
from jaxcloseup.io.files import write_file, write_json


RESAMPLES = 4000
Scenes = Mapping[str, Mapping[str, Any]]  # scores of `run_sweep` by scene


@dataclasses.dataclass(frozen=True)
class Row:
    """One arm on one split."""

    arm: str  # name of the arm
    split: str  # name of the split
    psnr: float  # mean PSNR over scenes, seeds and views, in dB
    # standard deviation over seeds of the mean PSNR over scenes and views; only seeds with all
    # views count. None for one seed
    spread: float | None
    ssim: float | None  # mean SSIM
    lpips: float | None  # mean LPIPS with VGG
    gain: float | None  # mean difference of PSNR from control in dB, or None without control
    low: float | None  # lower end of the 95 % interval of `gain`, or None for a single view
    high: float | None  # upper end of that interval
    count: int  # number of images in the means, over scenes, seeds and views
    skipped: int  # number of steps that were not finite, over seeds and scenes


def paired_bootstrap(
    differences: Sequence[np.ndarray], *, resamples: int = RESAMPLES, share: float = 0.95
) -> tuple[float, float] | tuple[None, None]:
    """Return a bootstrap interval of the mean of paired differences, or (None, None) for one group.

    Args:
      differences: the differences of each group. Groups are resampled as a whole; a group holds the
        seeds of one view, which resemble each other.
      resamples: number of resamples.
      share: share of the resampled means inside the interval.
    """
    means = np.array([np.mean(group) for group in differences])
    if len(means) < 2:
        return None, None
    chosen = np.random.default_rng(0).integers(0, len(means), (resamples, len(means)))
    low, high = np.quantile(means[chosen].mean(axis=1), [(1 - share) / 2, (1 + share) / 2])
    return float(low), float(high)


def rows(scenes: Scenes) -> list[Row]:
    """Return a row for each split and arm."""
    arms = _arms(scenes)
    every = (_row(scenes, arm, split) for split in SPLIT_TITLES for arm in arms)
    return [row for row in every if row is not None]


def _row(scenes: Scenes, arm: str, split: str) -> Row | None:
    psnr = _by_view(scenes, arm, split, "psnr")
    if not psnr:
        return None
    by_seed: dict[str, list[float]] = {}
    for (_, seed, _), value in psnr.items():
        by_seed.setdefault(seed, []).append(value)
    most = max(map(len, by_seed.values()))
    seeds = [float(np.mean(values)) for values in by_seed.values() if len(values) == most]
    results = [result for by_arm in scenes.values() for result in by_arm.get(arm, {}).values()]
    gain = gain_over_control(scenes, arm, split)
    return Row(
        arm=arm,
        split=split,
        psnr=float(np.mean(list(psnr.values()))),
        spread=float(np.std(seeds, ddof=1)) if len(seeds) > 1 else None,
        ssim=_mean(scenes, arm, split, "ssim"),
        lpips=_mean(scenes, arm, split, "lpips_vgg"),
        gain=gain and gain.mean,
        low=gain and gain.low,
        high=gain and gain.high,
        count=len(psnr),
        skipped=sum(result["skipped"] for result in results),
    )


class Gain(NamedTuple):
    """Mean PSNR difference of an arm from control, and its 95 % interval; None for one view."""

    mean: float
    low: float | None
    high: float | None


def gain_over_control(scenes: Scenes, arm: str, split: str) -> Gain | None:
    """Return an arm's gain over control on the views that both have; None without such views.

    Control is the arm's own, if it has one, which takes as many steps as the arm does.
    """
    arms = _arms(scenes)
    own = f"{arm}{OWN_CONTROL}"
    control = _by_view(scenes, own if own in arms else "control", split, "psnr")
    if arm == "control" or arm.removesuffix(OWN_CONTROL) in set(arms) - {arm}:
        return None
    pairs: dict[tuple[str, str], list[float]] = {}
    for (scene, seed, view), value in _by_view(scenes, arm, split, "psnr").items():
        if (scene, seed, view) in control:
            pairs.setdefault((scene, view), []).append(value - control[scene, seed, view])
    if not pairs:
        return None
    groups = [np.array(group) for group in pairs.values()]
    low, high = paired_bootstrap(groups)
    return Gain(float(np.mean([group.mean() for group in groups])), low, high)


def gain_curves(scenes: Scenes) -> list[Curve]:
    """Return each arm's gain over control against magnification, with its 95 % interval."""
    curves = []
    for arm in _arms(scenes):
        gains = {m: gain_over_control(scenes, arm, f"{PREFIX}{m:g}") for m in MAGNIFICATIONS}
        known = {m: gain for m, gain in gains.items() if gain is not None}
        if known:
            lows = [gain.low for gain in known.values() if gain.low is not None]
            highs = [gain.high for gain in known.values() if gain.high is not None]
            whole = len(lows) == len(known)
            curves.append(
                Curve(
                    name=arm,
                    x=list(known),
                    y=[gain.mean for gain in known.values()],
                    low=lows if whole else None,
                    high=highs if whole else None,
                )
            )
    return curves


def print_sweep(scenes: Scenes) -> None:
    """Print a table for each split."""
    table = score_table(rows(scenes))
    by_split = itertools.groupby(table.rows, key=lambda line: line[0])
    print_tables(
        [Table(title, table.header[1:], [line[1:] for line in lines]) for title, lines in by_split]
    )


def write_sweep(
    folder: pathlib.Path, scenes: Scenes, about: Mapping[str, Any], pictures: Sequence[Picture] = ()
) -> None:
    """Write `sweep.json`, `table.md`, `table.csv` and `report.html`.

    Args:
      folder: folder to write to.
      scenes: the scores of `run_sweep` by scene.
      about: method, preset and other facts about the sweep.
      pictures: pictures for the report.
    """
    write_json(folder / "sweep.json", {"scenes": scenes, **about})
    scored = rows(scenes)
    table, curves = score_table(scored), gain_curves(scenes)
    write_file(folder / "table.md", markdown(table).encode())
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(field.name for field in dataclasses.fields(Row))
    writer.writerows(map(dataclasses.astuple, scored))
    write_file(folder / "table.csv", text.getvalue().encode())
    gain_plot = curves and line_plot(
        curves,
        x="magnification (times nearer)",
        y="PSNR above control (dB)",
        title="Gain",
        doubling=True,
        level=0,
    )
    page = fill_page(
        "sweep.html",
        title=f"Sweep: {about['method']}, preset {about['preset']}, {', '.join(scenes)}",
        scores=table,
        gain_plot=gain_plot,
        pictures=by_section(pictures),
    )
    write_file(folder / "report.html", page)


def score_table(scored: Sequence[Row]) -> Table:
    """Return the table of all rows."""
    header = ["views", "arm", "PSNR (dB)", "s.d.", "SSIM", "LPIPS", "gain (dB)", "95 %", "n"]
    body = [
        [
            SPLIT_TITLES[row.split],
            row.arm,
            format_number(row.psnr),
            format_number(row.spread),
            format_number(row.ssim, "{:.4f}"),
            format_number(row.lpips, "{:.4f}"),
            format_number(row.gain, "{:+.3f}"),
            "-" if row.low is None else f"{row.low:+.3f} to {row.high:+.3f}",
            str(row.count),
            str(row.skipped),
        ]
        for row in scored
    ]
    return Table("Scores", [*header, "skipped"], body, names=2)


def _arms(scenes: Scenes) -> list[str]:
    return list(dict.fromkeys(arm for by_arm in scenes.values() for arm in by_arm))


def _mean(scenes: Scenes, arm: str, split: str, metric: str) -> float | None:
    values = list(_by_view(scenes, arm, split, metric).values())
    return float(np.mean(values)) if values else None


def _by_view(
    scenes: Scenes, arm: str, split: str, metric: str
) -> dict[tuple[str, str, str], float]:
    """Return a metric by (scene, seed, view), where it is known."""
    return {
        (scene, seed, view): values[metric]
        for scene, by_arm in scenes.items()
        for seed, result in by_arm.get(arm, {}).items()
        for view, values in result["splits"].get(split, {"views": {}})["views"].items()
        if values.get(metric) is not None
    }
