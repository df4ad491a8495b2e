"""Line plots as SVG text, for embedding in a page."""

import io
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib


matplotlib.use("Agg")
from matplotlib import pyplot as plt

from jaxcloseup.app.score.ladder import PREFIX, rungs_of


# The same data gives the same file: no random names and no date. Text stays text.
_STYLE = {"svg.hashsalt": "jaxcloseup", "svg.fonttype": "none", "font.size": 10}


class Curve(NamedTuple):
    """One line of a plot."""

    name: str  # name in the legend
    x: Sequence[float]  # x coordinates of its points
    y: Sequence[float]  # y coordinates of its points
    low: Sequence[float] | None = None  # lower ends of an interval at each point, or None
    high: Sequence[float] | None = None  # upper ends of an interval at each point, or None


def line_plot(
    curves: Sequence[Curve],
    *,
    x: str,
    y: str,
    title: str,
    doubling: bool = False,
    level: float | None = None,
) -> str:
    """Draw curves as an `<svg>` element.

    Args:
      curves: the curves; each has its own color and marker.
      x: label of the x axis, with its unit.
      y: label of the y axis, with its unit.
      title: title of the plot.
      doubling: whether the x axis is logarithmic with base 2, with a tick at each point.
      level: y of a thin horizontal line, or None.
    """
    with plt.style.context(["tableau-colorblind10", _STYLE]):
        figure, axes = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
        for curve, marker in zip(curves, "os^Dvx*P" * len(curves), strict=False):
            (line,) = axes.plot(curve.x, curve.y, marker=marker, label=curve.name, markersize=4)
            if curve.low is not None and curve.high is not None:
                axes.fill_between(
                    curve.x, curve.low, curve.high, color=line.get_color(), alpha=0.15, linewidth=0
                )
        if level is not None:
            axes.axhline(level, color="black", linewidth=0.6)
        if doubling:
            ticks = sorted({value for curve in curves for value in curve.x})
            axes.set_xscale("log", base=2)
            axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.set(xlabel=x, ylabel=y, title=title)
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
        plt.close(figure)
    return text.getvalue()[text.getvalue().index("<svg") :]


def zoom_curves(stages: Mapping[str, Mapping[str, Any]], metric: str = "psnr") -> list[Curve]:
    """Return a curve of a metric against magnification for each stage scored on the zoom ladder.

    Args:
      stages: metrics by stage and split, as in `results.json`.
      metric: name of the metric.
    """
    curves = []
    for stage, splits in stages.items():
        rungs = [(m, splits[f"{PREFIX}{m:g}"][metric]) for m in rungs_of(splits)]
        known = [(m, value) for m, value in rungs if value is not None]
        if known:
            curves.append(Curve(stage, *map(list, zip(*known, strict=True))))
    return curves


def gains_over(curves: Sequence[Curve], base: str) -> list[Curve]:
    """Subtract the curve named `base` from all curves, at the points that both have."""
    named = {curve.name: dict(zip(curve.x, curve.y, strict=True)) for curve in curves}
    below = named.get(base, {})
    gains = []
    for curve in curves:
        known = [(x, y - below[x]) for x, y in zip(curve.x, curve.y, strict=True) if x in below]
        if known:
            gains.append(Curve(curve.name, *map(list, zip(*known, strict=True))))
    return gains
