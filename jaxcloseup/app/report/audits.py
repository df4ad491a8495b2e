"""Plots over magnification and number of labels, and tables of errors of labels and detail."""

from collections.abc import Mapping
from typing import Any

from jaxcloseup.app.report.plots import Curve, gains_over, line_plot, zoom_curves
from jaxcloseup.app.report.record_table import Table
from jaxcloseup.app.score.metrics_text import format_metric


def zoom_plots(stages: Mapping[str, Any]) -> list[str]:
    """Return the plots of PSNR, and its gain over control, by magnification; none without them."""
    curves = zoom_curves(stages)
    return [
        line_plot(
            drawn, x="magnification (times nearer)", y=f"{y} (dB)", title=title, doubling=True
        )
        for drawn, y, title in (
            (curves, "PSNR", "PSNR"),
            (gains_over(curves, "control"), "PSNR above control", "Gain"),
        )
        if drawn
    ]


def label_plots(labels: Mapping[str, Any], left_out: Mapping[str, Any] | None) -> list[str]:
    """Return the plots of error by number of labels; none without any."""
    names = {"error": "by agreement", "oracle": "by true error"}
    shown = [
        (f"Labels from {depth.replace('_', ' ')}", audit["curve"], names)
        for depth, audit in labels.items()
        if audit["curve"] is not None
    ]
    if left_out is not None:
        shown.append(("Left-out photographs", left_out, names | {"model": "model's own error"}))
    return [
        line_plot(
            [Curve(name, curve["coverage"], curve[key]) for key, name in keys.items()],
            x="labels kept, as a share of all pixels",
            y="mean absolute error",
            title=f"{title}: AUSE {curve['ause']:.2f}",
        )
        for title, curve, keys in shown
    ]


def labels_table(labels: Mapping[str, Any]) -> Table:
    """Return the table of labels against the exact scene."""
    columns = {
        "error": "mean absolute error of kept labels",
        "kept": "share of seen pixels that keep a label",
        "leaked": "share of kept labels that leaked",
    }
    body = [
        [depth.replace("_", " "), *(format_metric(key, values[key]) for key in columns)]
        for depth, values in labels.items()
    ]
    return Table("Labels against the exact scene", ["depth", *columns.values()], body)


def gate_table(gate: Mapping[str, Any]) -> Table:
    """Return the table of labels against left-out photographs."""
    header = [
        "color tolerance",
        "depth tolerance",
        "share with a label",
        "PSNR of labels (dB)",
        "PSNR of the model (dB)",
    ]
    body = [
        [
            str(row["rgb_tolerance"]),
            str(row["depth_tolerance"]),
            f"{row['coverage']:.0%}",
            format_metric("psnr", row["label_psnr"]),
            format_metric("psnr", row["model_psnr"]),
        ]
        for row in gate["left_out"]
    ]
    return Table("Labels against left-out photographs (the gate)", header, body)


def detail_table(detail: Mapping[str, Any]) -> Table:
    """Return the table of expected against actual errors of renders with detail."""
    body = [
        [str(number), *(f"{255 * row[key]:.1f}" for key in ("expected", "actual"))]
        for number, row in enumerate(detail["errors"], 1)
    ]
    header = ["tenth of the pixels", "expected error", "actual error"]
    title = "Detail of the photographs"
    if "ause" in detail:
        title += f": AUSE {detail['ause']:.2f}, correlation {detail['pearson']:.2f}"
    return Table(title, header, body)
