"""Summarize a capture, and explain which photographs it leaves out."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib


matplotlib.use("Agg")

from jaxcloseup.app.process.options import FEWEST


_FEW_FEATURES = 50  # in a photograph; fewer seldom give a pose
_SHOWN = 3  # names in a line


def why_left_out(
    names: Sequence[str],
    features: Mapping[str, int],
    partners: Mapping[str, int],
    models: Sequence[Mapping[str, Any]],
) -> dict[str, str]:
    """Return why photographs have no pose in the first model, by name.

    Args:
      names: all photographs.
      features: number of features of each.
      partners: for each, number of other photographs that show the same.
      models: result of `solver.map_photographs`.
    """
    solved, *others = (set(model["photographs"]) for model in models)
    reasons = {}
    for name in names:
        if name in solved:
            continue
        if any(name in other for other in others if len(other - solved) >= FEWEST):
            reasons[name] = "belongs to another model, which shares too little with the larger one"
        elif features[name] < _FEW_FEATURES:
            reasons[name] = f"has only {features[name]} features: blank, dark or blurred"
        elif not partners[name]:
            reasons[name] = "shows nothing that another photograph shows"
        else:
            reasons[name] = "fits no pose, though others show the same"
    return reasons


def other_models(models: Sequence[Mapping[str, Any]]) -> list[int]:
    """Count the photographs that each further model adds; leave out models that add too few."""
    known, sizes = set(models[0]["photographs"]), []
    for model in models[1:]:
        new = set(model["photographs"]) - known
        known |= new
        sizes += [len(new)] if len(new) >= FEWEST else []
    return sizes


def summary_lines(summary: Mapping[str, Any]) -> list[str]:
    """Describe the field `summary` of `process.json` in lines for the terminal."""
    registered, total = summary["registered"], summary["photographs"]
    error, track = summary["reprojection_error"], summary["track_length"]
    lines = [
        f"{registered} of {total} photographs have a pose; {summary['points']:,} points, which "
        f"{track:.1f} photographs see on average; reprojection error {error:.2f} pixels"
    ]
    for lens in summary["lenses"]:
        (width, height), focal = lens["size"], next(iter(lens["parameters"].values()))
        source = "began from EXIF" if lens["focal_length_in_exif"] else "no EXIF"
        lines.append(
            f"lens of {lens['photographs']} photographs of {width} x {height}: focal length "
            f"{focal:.1f} pixels ({source})"
        )
    if summary["other_models"]:
        sizes = ", ".join(map(str, summary["other_models"]))
        lines.append(
            f"the photographs fall into {len(summary['other_models']) + 1} models that do not "
            f"connect: the largest is taken; the others have {sizes}. Photographs between them "
            "would connect them."
        )
    by_reason: dict[str, list[str]] = {}
    for name, reason in summary["left_out"].items():
        by_reason.setdefault(reason, []).append(name)
    for reason, names in by_reason.items():
        hidden = len(names) - _SHOWN
        more = f" and {hidden} more (process.json names all)" if hidden > 0 else ""
        lines.append(f"left out: {', '.join(names[:_SHOWN])}{more}: {reason}")
    if registered < total / 2:
        lines.append("less than half have a pose: add photographs that overlap more")
    return lines
