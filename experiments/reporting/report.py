"""The report of a run: a table for the terminal, and one self-contained page."""

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
    """A picture on the page.

    Attributes:
      section: heading that groups pictures.
      caption: text below the picture.
      image: uint8 `[H, W, 3]`.
    """

    section: str
    caption: str
    image: np.ndarray


def rows(results: Mapping[str, Any]) -> list[list[str]]:
    """Return the table of a run as text: a header, then a row for each split and stage."""
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
    """Print a table for each split, with a column for each stage to fit a narrow terminal."""
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
    """Write the page, which needs no other file.

    Args:
      path: file to write.
      results: what `results.json` holds.
      pictures: pictures to embed, grouped by section.
    """
    title = f"{results['scene']}: {results['method']}, preset {results['preset']}"
    size, finer = (results[key] for key in ("resolution", "finer_resolution"))
    sizes = f"{size[0]} x {size[1]} pixels"
    if finer is not None:
        sizes += f", finer ones {finer[0]} x {finer[1]}"
    header, *body = rows(results)
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width'>",
        f"<title>{html.escape(title)}</title><style>{STYLE}</style>",
        f"<h1>{html.escape(title)}</h1>",
        f"<p>{sizes}, seed {results['seed']}. The table shows the mean of each "
        "metric over the held-out views, on 8-bit images. Higher PSNR and SSIM are better; lower "
        "LPIPS and errors are better. <i>Seen by 3+ photographs</i> means the pixels whose surface "
        "at least 3 training photographs saw.</p>",
        "<p><i>closeup</i> and <i>test_time</i> continue the baseline with pseudo-labels. "
        "<i>control</i> continues it for as many steps without them, so compare <i>closeup</i> "
        "with <i>control</i>, not with <i>baseline</i>. <i>test_time_control</i> is the control of "
        "<i>test_time</i>, if that takes a different number of steps. <i>detail</i> adds to "
        "the renders of a stage, without training, what the photographs show beyond it.</p>",
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
    if results["detail"]:
        parts.append(_detail_table(results["detail"]))
    parts += figures(pictures)
    config = html.escape(json.dumps({k: results[k] for k in ("config", "versions")}, indent=1))
    parts.append(f"<details><summary>Configuration</summary><pre>{config}</pre></details></html>")
    write_file(path, "\n".join(parts).encode())


_COMPARISON_NOTE = (
    "Each picture shows the true image, the renders of the stages in the order trained, and the "
    "error of the last one: black is none, bright yellow is large."
)
_PICTURE_NOTES = {
    **dict.fromkeys(SPLIT_TITLES.values(), _COMPARISON_NOTE),
    "Pseudo-labels": "Each picture shows how one label is made: colors warped backward from the "
    "source photograph that the caption names, colors warped forward from all photographs, the "
    "pixels where both agree (kept), the same as a mask (white), the rendered depth, and the true "
    "image where it is known. Good labels cover much of the image and look like the true image.",
}


def figures(pictures: Sequence[Picture]) -> list[str]:
    """Return the lines of a page with the pictures, under a heading for each section."""
    parts, section = [], None
    for picture in pictures:
        if picture.section != section:
            section = picture.section
            parts.append(f"<h2>{html.escape(section)}</h2>")
            note = _PICTURE_NOTES.get(section.split(": ")[-1])  # a sweep's begin with the scene
            parts += [f"<p>{note}</p>"] if note else []
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
    axis = {"x": "magnification (times nearer)", "doubling": True}
    plots = [line_plot(curves, y="PSNR (dB)", title="PSNR", **axis)]
    text = (
        "Cameras move up to 16 times nearer to points of the ordinary views. The first plot shows "
        "the mean PSNR of each stage; higher is better."
    )
    gains = gains_over(curves, "control")
    if gains:
        plots.append(line_plot(gains, y="PSNR above control (dB)", title="Gain", **axis))
        text += (
            " The second plot shows how far each stage is above <i>control</i>: labels help where "
            "the curve of <i>closeup</i> is above 0."
        )
    return [f"<h2>PSNR by magnification</h2><p>{text}</p><div class=plots>", *plots, "</div>"]


def _label_plots(labels, left_out):
    plots = []
    names = {"error": "by agreement", "oracle": "by true error"}
    axis = {"x": "labels kept, as a share of all pixels", "y": "mean absolute error"}
    for depth, audit in labels.items():
        if audit["curve"] is not None:
            title = f"Labels from {depth.replace('_', ' ')}"
            plots.append((title, audit["curve"], names))
    text = (
        "Each plot shows the mean error of the labels kept so far; lower is better. <i>By "
        "agreement</i> keeps the labels first whose two warps agree best, as the mask does. <i>By "
        "true error</i> keeps the best labels first, which no mask can beat. AUSE, the area "
        "between the two curves relative to the error of all labels, is 0 for a perfect mask."
    )
    if left_out is not None:
        more = names | {"model": "model's own error"}
        plots.append(("Left-out photographs", left_out, more))
        text += (
            " On left-out photographs, labels above the <i>model's own error</i> are worse than "
            "the model on the same pixels."
        )
    if not plots:
        return []
    parts = [f"<h2>Error by number of labels</h2><p>{text}</p><div class=plots>"]
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
        "<h2>Labels against the exact scene</h2><p>The table compares labels of random virtual "
        "close-ups with the true image, blurred to the resolution of the source photograph. The "
        "labels are made from the exact depth and from the trained depth. Good labels have a small "
        "error, cover much of what the source photograph sees, and leak little: a leaked label "
        "colors a surface that the source does not see.</p><table><tr><th>depth"
        "<th>mean absolute error of kept labels<th>share of seen pixels that keep a label"
        f"<th>share of kept labels that leaked{lines}</table>"
    )


def _gate_table(gate):
    lines = "".join(
        f"<tr><td>{row['rgb_tolerance']}<td>{row['depth_tolerance']}<td>{row['coverage']:.0%}"
        f"<td>{format_metric('psnr', row['label_psnr'])}"
        f"<td>{format_metric('psnr', row['model_psnr'])}"
        for row in gate["left_out"]
    )
    return (
        "<h2>Labels against left-out photographs (the gate)</h2><p>The gate leaves out training "
        "photographs one by one and labels them from the others. Each row shows, for one pair of "
        "tolerances, the share of pixels with a label, and the PSNR of the labels and of the model "
        "on these pixels. The model was trained on these photographs, so labels may score below "
        "it and still help elsewhere. The first row decides, because labels do harm on scenes "
        f"where few of them agree so closely. Here {html.escape(verdict(gate))}.</p><table><tr>"
        "<th>color tolerance<th>depth tolerance<th>share with a label<th>PSNR of labels (dB)"
        f"<th>PSNR of the model (dB){lines}</table>"
    )


def _detail_table(detail):
    lines = "".join(
        f"<tr><td>{row['predicted']:.2f}<td>{row['actual']:.2f}<td>{row['pixels']:.1%}"
        for row in detail["reliability"]
    )
    (height, width), *_ = detail["sizes"]
    return (
        "<h2>Detail of the photographs</h2><p>The stage <i>detail</i> shows the renders of "
        f"<i>{html.escape(detail['stage'])}</i> with what photographs of {width} x {height} pixels "
        "show beyond them. How much of it is added at a pixel is predicted from how well the "
        "photographs agree, how sharply and from which angles they see the surface. The table "
        "compares the prediction with left-out photographs: of the detail that the other "
        "photographs show, the share that is predicted and that is really there.</p><table><tr>"
        f"<th>predicted share<th>actual share<th>share of pixels{lines}</table>"
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
