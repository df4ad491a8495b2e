"""What a run's page folds away: plots over magnification, and how right labels and detail are."""

import html
from collections.abc import Mapping
from typing import Any

from jaxcloseup.app.report.page import table
from jaxcloseup.app.report.plots import Curve, gains_over, line_plot, zoom_curves
from jaxcloseup.app.run.gate import verdict
from jaxcloseup.app.score.metrics_text import format_metric


def zoom_plots(stages: Mapping[str, Any]) -> list[str]:
    """Return the plots of PSNR by magnification; none without a zoom ladder."""
    curves = zoom_curves(stages)
    if not curves:
        return []
    axis = {"x": "magnification (times nearer)", "doubling": True}
    plots = [line_plot(curves, y="PSNR (dB)", title="PSNR", **axis)]
    text = (
        "Cameras move up to 16 times nearer to points of the ordinary views; at 0.5 they have half "
        "the focal length. The first plot shows the mean PSNR of each stage; higher is better."
    )
    gains = gains_over(curves, "control")
    if gains:
        plots.append(line_plot(gains, y="PSNR above control (dB)", title="Gain", **axis))
        text += (
            " The second plot shows how far each stage is above <i>control</i>: labels help where "
            "the curve of <i>closeup</i> is above 0."
        )
    return [f"<p>{text}</p><div class=plots>", *plots, "</div>"]


def label_plots(labels: Mapping[str, Any], left_out: Mapping[str, Any] | None) -> list[str]:
    """Return the plots of error by number of labels; none without any."""
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


def labels_table(labels: Mapping[str, Any]) -> str:
    """Return the table of labels against the exact scene."""
    header = [
        *("depth", "mean absolute error of kept labels"),
        *("share of seen pixels that keep a label", "share of kept labels that leaked"),
    ]
    body = [
        [depth.replace("_", " ")]
        + [format_metric(key, values[key]) for key in ("error", "kept", "leaked")]
        for depth, values in labels.items()
    ]
    return (
        "<h2>Labels against the exact scene</h2><p>The table compares labels of random virtual "
        "close-ups with the true image, blurred to the resolution of the source photograph. The "
        "labels are made from the exact depth and from the trained depth. Good labels have a small "
        "error, cover much of what the source photograph sees, and leak little: a leaked label "
        f"colors a surface that the source does not see.</p>{table(header, body)}"
    )


def gate_table(gate: Mapping[str, Any]) -> str:
    """Return the table of labels against left-out photographs."""
    header = [
        *("color tolerance", "depth tolerance", "share with a label"),
        *("PSNR of labels (dB)", "PSNR of the model (dB)"),
    ]
    body = [
        [f"{row['rgb_tolerance']}", f"{row['depth_tolerance']}", f"{row['coverage']:.0%}"]
        + [format_metric("psnr", row[key]) for key in ("label_psnr", "model_psnr")]
        for row in gate["left_out"]
    ]
    return (
        "<h2>Labels against left-out photographs (the gate)</h2><p>The gate leaves out training "
        "photographs one by one and labels them from the others. Each row shows, for one pair of "
        "tolerances, the share of pixels with a label, and the PSNR of the labels and of the model "
        "on these pixels. The model was trained on these photographs, so labels may score below "
        "it and still help elsewhere. The first row decides, because labels do harm on scenes "
        f"where few of them agree so closely. Here {html.escape(verdict(gate))}.</p>"
        f"{table(header, body)}"
    )


def detail_table(detail: Mapping[str, Any]) -> str:
    """Return the table of expected against actual errors of renders with detail."""
    header = ["tenth of the pixels", "expected error", "actual error"]
    body = [
        [str(number), *(f"{255 * row[key]:.1f}" for key in ("expected", "actual"))]
        for number, row in enumerate(detail["errors"], 1)
    ]
    (height, width), *_ = detail["sizes"]
    return (
        "<h2>Detail of the photographs</h2><p>The stage <i>detail</i> shows the renders of "
        f"<i>{html.escape(detail['stage'])}</i> with what photographs of {width} x {height} pixels "
        "show beyond them. How much of it is added at a pixel is predicted from how well the "
        "photographs agree, how sharply and from which angles they see the surface. Close-ups of "
        "other scenes taught the prediction, and how far colors are off in the end. The table "
        "compares that expected error with the actual one on the held-out views of this run, in "
        "gray levels of 255, once colors are corrected: from the tenth of the pixels where the "
        f"least is expected to that where the most is.</p>{table(header, body)}"
    )
