"""Summarize a capture, explain which photographs it leaves out, and draw it from above."""

import io
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib


matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection
from matplotlib.ticker import MaxNLocator

from jaxcloseup.app.process.options import FEWEST
from jaxcloseup.captures.colmap import read_colmap
from jaxcloseup.captures.colmap_files import find_model_files
from jaxcloseup.io.files import write_file


_FEW_FEATURES = 50  # in a photograph; fewer seldom give a pose
_SHOWN = 3  # names in a line
_MOST_POINTS = 20_000  # in the picture


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


def draw_from_above(model: pathlib.Path, path: pathlib.Path) -> None:
    """Draw the cameras and points of a model from above, as a PNG.

    Up is as perpendicular as possible to the cameras' horizontal axes, since few people tilt a
    camera sideways.

    Raises:
      SceneError: the model cannot be read.
      OSError: the picture cannot be written.
    """
    files = find_model_files(model)
    assert files is not None  # the mapping has written it
    _, frames, points, rgb, *_ = read_colmap(files)
    poses = np.stack([frame.camtoworld for frame in frames])
    plane = _horizontal(poses[:, :, :3])
    if len(points) > _MOST_POINTS:
        some = np.linspace(0, len(points) - 1, _MOST_POINTS).astype(int)
        points, rgb = points[some], rgb[some]
    flat, cameras = points @ plane.T, poses[:, :, 3] @ plane.T
    forward = poses[:, :, 2] @ plane.T
    low, high = np.min(cameras, 0), np.max(cameras, 0)
    if len(flat):
        near, far = np.percentile(flat, [2, 98], axis=0)
        low, high = np.minimum(low, near), np.maximum(high, far)
    side = max(high - low)
    figure, axes = plt.subplots(figsize=(8, 8), layout="constrained")
    axes.scatter(flat[:, 0], flat[:, 1], s=3, c=np.clip(rgb, 0, 1), linewidths=0)
    length = side / 25
    across = forward[:, ::-1] * [-1, 1]
    wedges = [
        np.stack([c + length * (f - a / 3), c, c + length * (f + a / 3)])
        for c, f, a in zip(cameras, forward, across, strict=True)
    ]
    order = np.arange(len(cameras))
    axes.add_collection(LineCollection(wedges, array=order, cmap="viridis", linewidths=1))
    shown = axes.scatter(cameras[:, 0], cameras[:, 1], s=14, c=order, cmap="viridis", zorder=3)
    ticks = MaxNLocator(integer=True)
    figure.colorbar(shown, ax=axes, shrink=0.6, label="photographs, by name", ticks=ticks)
    middle = (low + high) / 2
    axes.set_xlim(middle[0] - 0.56 * side, middle[0] + 0.56 * side)
    axes.set_ylim(middle[1] - 0.56 * side, middle[1] + 0.56 * side)
    axes.set_aspect("equal")
    axes.set_title(f"{len(frames)} cameras and {len(points):,} points from above")
    axes.set_xlabel("units of the capture")
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110, metadata={"Software": None})
    plt.close(figure)
    write_file(path, file.getvalue())


def _horizontal(rotations: np.ndarray) -> np.ndarray:
    """Return horizontal axes `[2, 3]`, x to the right, for rotations `[V, 3, 3]` to the world."""
    right, up = rotations[:, :, 0], -rotations[:, :, 1].mean(0)
    values, vectors = np.linalg.eigh(right.T @ right)
    # Horizontal axes of cameras that look the same way are alike and leave up open: take their own.
    axis = vectors[:, 0] if values[0] < values[1] / 4 else up / np.linalg.norm(up)
    axis = axis * np.sign(axis @ up)
    mean = right.mean(0) - axis * (axis @ right.mean(0))
    if np.linalg.norm(mean) < 1e-3:  # a full circle
        mean = right[0] - axis * (axis @ right[0])
    x = mean / np.linalg.norm(mean)
    return np.stack([x, np.cross(axis, x)])
