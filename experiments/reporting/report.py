"""What a run leaves behind: a table, results.json and one self-contained page."""

import html
import itertools
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from experiments.evaluation.metrics_text import COLUMNS, SPLIT_TITLES, format_metric
from experiments.reporting.plots import Curve, gains_over, line_plot, zoom_curves
from experiments.training.gate import verdict
from jaxcloseup.artifacts.images import png_data_uri
from jaxcloseup.files import write_file


class Picture(NamedTuple):
    """A picture of the page: `image` is uint8 `[H, W, 3]`, `section` groups pictures."""

    section: str
    caption: str
    image: np.ndarray


def rows(results: Mapping[str, Any]) -> list[list[str]]:
    """The table of a run: a row for each split and stage, first the header."""
    shown = [
        key
        for key in COLUMNS
        if any(
            split.get(key) is not None for s in results["stages"].values() for split in s.values()
        )
    ]
    table = [["views", "stage", *(COLUMNS[key] for key in shown)]]
    for split, title in SPLIT_TITLES.items():
        for stage, splits in results["stages"].items():
            if split in splits:
                values = [splits[split].get(key) for key in shown]
                table.append([title, stage, *map(format_metric, shown, values)])
    return table


def print_table(results: Mapping[str, Any]) -> None:
    """Print a table for each split, a column for each stage: it fits a narrow terminal."""
    header, *body = rows(results)
    for split, group in itertools.groupby(body, key=lambda row: row[0]):
        _, stages, *metrics = zip(*group, strict=True)
        table = Table(split, *stages)
        for name, values in zip(header[2:], metrics, strict=True):
            table.add_row(name, *values)
        Console().print(table)


def write_report(
    path: pathlib.Path, results: Mapping[str, Any], pictures: Sequence[Picture]
) -> None:
    """Write the page: title, table, pictures by section, configuration; no file beside it."""
    title = f"{results['scene']}: {results['method']}, preset {results['preset']}"
    width, height = results["resolution"]
    header, *body = rows(results)
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width'>",
        f"<title>{html.escape(title)}</title><style>{STYLE}</style>",
        f"<h1>{html.escape(title)}</h1>",
        f"<p>{width} x {height} pixels, seed {results['seed']}. Metrics are means over views, on "
        "8-bit images. <i>control</i> is the baseline after as many further steps as "
        "<i>closeup</i>, without pseudo-labels: a gain counts against it. <i>test_time_control</i> "
        "is the same for <i>test_time</i>, where that takes another number of steps.</p>",
        "<div class=wide><table><tr>",
        *(f"<th>{html.escape(cell)}" for cell in header),
        *("<tr>" + "".join(f"<td>{html.escape(cell)}" for cell in row) for row in body),
        "</table></div>",
    ]
    parts += _zoom_plots(results["stages"])
    if results["labels"]:
        parts.append(_labels_table(results["labels"]))
    parts += _label_plots(results["labels"], results["left_out"])
    if results["gate"]:
        parts.append(_gate_table(results["gate"]))
    parts += figures(pictures)
    config = html.escape(json.dumps({k: results[k] for k in ("config", "versions")}, indent=1))
    parts.append(f"<details><summary>Configuration</summary><pre>{config}</pre></details></html>")
    write_file(path, "\n".join(parts).encode())


def figures(pictures: Sequence[Picture]) -> list[str]:
    """Lines of a page with pictures in it, under a heading for each section."""
    parts, section = [], None
    for picture in pictures:
        if picture.section != section:
            section = picture.section
            parts.append(f"<h2>{html.escape(section)}</h2>")
        caption = html.escape(picture.caption)
        parts.append(
            f"<figure><img alt='{caption}' src='{png_data_uri(picture.image)}'>"
            f"<figcaption>{caption}</figcaption></figure>"
        )
    return parts


def _zoom_plots(stages):
    curves = zoom_curves(stages)
    if not curves:
        return []
    axis = {"x": "times nearer", "doubling": True}
    parts = [
        "<h2>Against magnification</h2><p>Cameras that come nearer and nearer to points of the "
        "ordinary views.</p><div class=plots>",
        line_plot(curves, y="PSNR (dB)", title="PSNR", **axis),
    ]
    gains = gains_over(curves, "control")
    if gains:
        axis |= {"y": "PSNR above control (dB)"}
        parts.append(line_plot(gains, title="Gain", **axis))
    return [*parts, "</div>"]


def _label_plots(labels, left_out):
    plots = []
    names = {"error": "by the mask", "oracle": "by their true error"}
    axis = {"x": "share of all pixels", "y": "mean absolute error"}
    for depth, of_depth in labels.items():
        if of_depth["curve"] is not None:
            title = f"Labels from {depth.replace('_', ' ')}"
            plots.append((title, of_depth["curve"], names))
    if left_out is not None:
        more = names | {"model": "of the model there"}
        plots.append(("Left-out photographs", left_out, more))
    if not plots:
        return []
    parts = [
        "<h2>How many labels, and how good</h2><p>Labels are kept by how well the two warps agree, "
        "those that agree best first; the lower curve is the best order there is. The area between "
        "them, AUSE, is 0 for a mask that knows.</p><div class=plots>"
    ]
    for title, curve, shown in plots:
        curves = [Curve(name, curve["coverage"], curve[key]) for key, name in shown.items()]
        parts.append(line_plot(curves, title=f"{title}: AUSE {curve['ause']:.2f}", **axis))
    return [*parts, "</div>"]


def _labels_table(labels):
    lines = "".join(
        f"<tr><td>{depth.replace('_', ' ')}"
        + "".join(f"<td>{format_metric(key, values[key])}" for key in ("error", "kept", "leaked"))
        for depth, values in labels.items()
    )
    return (
        "<h2>Labels against the truth</h2><p>Random virtual close-ups; the truth is blurred to the "
        "source photograph's pixels.</p><table><tr><th>depth<th>mean absolute error of kept "
        "labels<th>kept, of what the source sees<th>leaked: kept though the source does not see it"
        f"{lines}</table>"
    )


def _gate_table(gate):
    lines = "".join(
        f"<tr><td>{row['rgb_tolerance']}<td>{row['depth_tolerance']}<td>{row['coverage']:.0%}"
        f"<td>{format_metric('psnr', row['label_psnr'])}"
        f"<td>{format_metric('psnr', row['model_psnr'])}"
        for row in gate["left_out"]
    )
    return (
        "<h2>Labels against left-out photographs</h2><p>Training photographs are left out one by "
        "one and labeled from the others. The model was trained on them, and labels need not be "
        "nearer to them than it is; but where few of them agree closely (the first line) they do "
        f"harm. Here {html.escape(verdict(gate))}.</p><table><tr>"
        "<th>tolerance of color<th>of depth<th>labeled<th>PSNR of labels (dB)"
        f"<th>PSNR of the model (dB){lines}</table>"
    )


STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1200px; margin: 2em auto; padding: 0 1em }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th, td { padding: .25em .8em; text-align: right; border-bottom: 1px solid #ccc }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left }
.wide { overflow-x: auto }
figure { margin: 1em 0 }
.plots { display: flex; flex-wrap: wrap; gap: 1em }
.plots svg { max-width: 100%; height: auto }
img { width: 100%; image-rendering: pixelated }
figcaption { color: #555 }
"""
