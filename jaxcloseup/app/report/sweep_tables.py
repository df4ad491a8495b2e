"""Tables of a sweep: means over seeds and scenes, and intervals of differences from control.

The interval measures how the mean difference of the trained models varies with the choice of views.
The standard deviation measures how the mean varies with the seed.
"""

import csv
import io
import itertools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from jaxcloseup.app.report.page import Picture, figures, head, table
from jaxcloseup.app.report.plots import Curve, line_plot
from jaxcloseup.app.score.ladder import MAGNIFICATIONS, PREFIX
from jaxcloseup.app.score.metrics_text import SPLIT_TITLES
from jaxcloseup.io.files import write_file, write_json


RESAMPLES = 4000


class Row(NamedTuple):
    """One arm on one split.

    Attributes:
      arm: name of the arm.
      split: name of the split.
      psnr: mean PSNR over scenes, seeds and views, in dB.
      spread: standard deviation over seeds of the mean PSNR over scenes and views. Only seeds that
        have all views count; None for one seed.
      ssim: mean SSIM.
      lpips: mean LPIPS with VGG.
      gain: mean difference of PSNR from control in dB, or None without control.
      low: lower end of the 95 % interval of `gain`; None for a single view.
      high: upper end of that interval.
      count: number of images in the means, over scenes, seeds and views.
      skipped: number of steps that were not finite, over seeds and scenes.
    """

    arm: str
    split: str
    psnr: float
    spread: float | None
    ssim: float | None
    lpips: float | None
    gain: float | None
    low: float | None
    high: float | None
    count: int
    skipped: int


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


def rows(scenes: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    """Return a row for each split and arm.

    Args:
      scenes: the scores of `run_sweep` by scene.
    """
    table = []
    arms = _arms(scenes)
    for split in SPLIT_TITLES:
        for arm in arms:
            psnr = _by_view(scenes, arm, split, "psnr")
            if not psnr:
                continue
            by_seed: dict[str, list[float]] = {}
            for (_, seed, _), value in psnr.items():
                by_seed.setdefault(seed, []).append(value)
            most = max(map(len, by_seed.values()))
            seeds = [float(np.mean(values)) for values in by_seed.values() if len(values) == most]
            skipped = sum(
                result["skipped"]
                for by_arm in scenes.values()
                for result in by_arm.get(arm, {}).values()
            )
            table.append(
                Row(
                    arm,
                    split,
                    float(np.mean(list(psnr.values()))),
                    float(np.std(seeds, ddof=1)) if len(seeds) > 1 else None,
                    *(_mean(scenes, arm, split, metric) for metric in ("ssim", "lpips_vgg")),
                    *(gain_over_control(scenes, arm, split) or (None, None, None)),
                    len(psnr),
                    skipped,
                )
            )
    return table


def gain_over_control(
    scenes: Mapping[str, Mapping[str, Any]], arm: str, split: str
) -> tuple[float, float | None, float | None] | None:
    """Return an arm's mean PSNR difference from control and its 95 % interval; None if unknown."""
    if arm == "control":
        return None
    control = _by_view(scenes, "control", split, "psnr")
    pairs: dict[tuple[str, str], list[float]] = {}
    for (scene, seed, view), value in _by_view(scenes, arm, split, "psnr").items():
        if (scene, seed, view) in control:
            pairs.setdefault((scene, view), []).append(value - control[scene, seed, view])
    if not pairs:
        return None
    groups = [np.array(group) for group in pairs.values()]
    return float(np.mean([group.mean() for group in groups])), *paired_bootstrap(groups)


def gain_curves(scenes: Mapping[str, Mapping[str, Any]]) -> list[Curve]:
    """Return each arm's gain over control against magnification, with its 95 % interval."""
    curves = []
    for arm in _arms(scenes):
        found = {}
        for m in MAGNIFICATIONS:
            gain = gain_over_control(scenes, arm, f"{PREFIX}{m:g}")
            if gain is not None:
                found[m] = gain
        if found:
            gains, lows, highs = map(list, zip(*found.values(), strict=True))
            known = (lows, highs) if None not in lows else ()
            curves.append(Curve(arm, list(found), gains, *known))
    return curves


def print_sweep(scenes: Mapping[str, Mapping[str, Any]]) -> None:
    """Print a table for each split."""
    header, *body = _cells(rows(scenes))
    for title, lines in itertools.groupby(body, key=lambda line: line[0]):
        table = Table(*header[1:], title=title)
        for line in lines:
            table.add_row(*line[1:])
        Console().print(table)


def write_sweep(
    folder: pathlib.Path,
    scenes: Mapping[str, Any],
    about: Mapping[str, Any],
    pictures: Sequence[Picture] = (),
) -> None:
    """Write `sweep.json`, `table.md`, `table.csv` and `report.html`.

    Args:
      folder: folder to write to.
      scenes: the scores of `run_sweep` by scene.
      about: method, preset and other facts about the sweep.
      pictures: pictures for the report.
    """
    found = rows(scenes)
    write_json(folder / "sweep.json", {"scenes": scenes, **about})
    header, *body = _cells(found)
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(line) + " |" for line in body]
    write_file(folder / "table.md", "\n".join([*lines, ""]).encode())
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Row._fields)
    writer.writerows(found)
    write_file(folder / "table.csv", text.getvalue().encode())
    title = f"Sweep: {about['method']}, preset {about['preset']}, {', '.join(scenes)}"
    parts = [
        *head(title),
        "<p>The table shows the mean of each metric over scenes, seeds and views, and the standard "
        "deviation of PSNR over seeds (s.d.). Higher PSNR and SSIM and lower LPIPS are better. "
        "<i>control</i> continues the baseline without labels. The gain is an arm's PSNR above "
        "<i>control</i> on the same views, with a 95 % bootstrap interval over views: an arm "
        "helps if its whole interval is above 0. n is the number of images, and skipped is the "
        "number of steps that were not finite. All arms take the same number of steps, except "
        "<i>baseline</i>, which takes none, and <i>test_time</i>, which has its own number.</p>",
        table(header, body, names=2),
    ]
    curves = gain_curves(scenes)
    if curves:
        parts += [
            "<h2>Gain by magnification</h2><p>Cameras move up to 16 times nearer to points of the "
            "ordinary views; at 0.5 they have half the focal length. The plot shows each arm's "
            "PSNR above <i>control</i>, with its 95 % interval shaded: an arm helps where its "
            "curve is above 0.</p>",
            "<div class=plots>",
            line_plot(
                curves,
                x="magnification (times nearer)",
                y="PSNR above control (dB)",
                title="Gain",
                doubling=True,
                level=0,
            ),
            "</div>",
        ]
    parts += [*figures(pictures), "</html>"]
    write_file(folder / "report.html", "\n".join(parts).encode())


def _arms(scenes):
    return list(dict.fromkeys(arm for by_arm in scenes.values() for arm in by_arm))


def _mean(scenes, arm, split, metric):
    values = list(_by_view(scenes, arm, split, metric).values())
    return float(np.mean(values)) if values else None


def _by_view(scenes, arm, split, metric):
    """Return a metric by (scene, seed, view), where it is known."""
    return {
        (scene, seed, view): values[metric]
        for scene, by_arm in scenes.items()
        for seed, result in by_arm.get(arm, {}).items()
        for view, values in result["splits"].get(split, {"views": {}})["views"].items()
        if values.get(metric) is not None
    }


def _cells(found):
    def number(value, pattern="{:.2f}"):
        return "-" if value is None else pattern.format(value)

    body = [
        [
            SPLIT_TITLES[row.split],
            row.arm,
            number(row.psnr),
            number(row.spread),
            number(row.ssim, "{:.4f}"),
            number(row.lpips, "{:.4f}"),
            number(row.gain, "{:+.3f}"),
            "-" if row.low is None else f"{row.low:+.3f} to {row.high:+.3f}",
            str(row.count),
            str(row.skipped),
        ]
        for row in found
    ]
    header = [
        "views",
        "arm",
        "PSNR (dB)",
        "s.d.",
        "SSIM",
        "LPIPS",
        "gain (dB)",
        "95 %",
        "n",
        "skipped",
    ]
    return [header, *body]
