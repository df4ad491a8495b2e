"""Whether to use pseudo-labels, and with which tolerances: decided by left-out photographs."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from experiments.audit import audit_left_out
from jaxcloseup.batch import Views
from jaxcloseup.field import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.pseudo import PseudoSettings


TOLERANCES = [(rgb, depth) for rgb in (0.02, 0.04, 0.08) for depth in (0.005, 0.02)]
LEAST_COVERAGE = 0.05  # below it, what is kept is what has no texture


def print_gate(found: Mapping[str, Any]) -> None:
    """Say what the left-out photographs showed."""
    rows = found["left_out"]
    if found["use_labels"]:
        row = rows[found["chosen"]]
        print(
            f"     gate: labels of left-out photographs beat the model, {row['label_psnr']:.2f} to "
            f"{row['model_psnr']:.2f} dB on {row['coverage']:.0%} of the pixels, at tolerances "
            f"{row['rgb_tolerance']} of colour and {row['depth_tolerance']} of depth"
        )
        return
    known = list(filter(_is_known, rows))
    text = "     gate: no labels, for those of left-out photographs do not beat the model"
    if known:
        row = max(known, key=lambda r: r["label_psnr"] - r["model_psnr"])
        text += f": {row['label_psnr']:.2f} to {row['model_psnr']:.2f} dB at best"
    print(text)


def choose_settings(
    views: Views,
    depths: jax.Array,
    render: Callable[[Camera], Rendering],
    settings: PseudoSettings,
) -> tuple[PseudoSettings | None, dict[str, Any]]:
    """The settings with most labels among those whose labels beat the model, or None.

    Args:
      views: training photographs.
      depths: `[V, H, W]` their rendered z-depth.
      render: `camera -> Rendering` of the model.
      settings: all but the tolerances.

    Returns:
      Settings or None, and the evidence: `use_labels` and a row of `left_out` for each pair of
      tolerances, as JSON can hold it.
    """
    candidates = [
        settings.replace(rgb_tolerance=jnp.float32(rgb), depth_tolerance=jnp.float32(depth))
        for rgb, depth in TOLERANCES
    ]
    rows = audit_left_out(views, depths, render, candidates)
    best = None
    for i, row in enumerate(rows):
        if not _is_known(row) or row["coverage"] < LEAST_COVERAGE:
            continue
        more = best is None or row["coverage"] > rows[best]["coverage"]
        if row["label_psnr"] > row["model_psnr"] and more:
            best = i
    evidence = [
        {"rgb_tolerance": rgb, "depth_tolerance": depth} | row
        for (rgb, depth), row in zip(TOLERANCES, rows, strict=True)
    ]
    found = {"use_labels": best is not None, "chosen": best, "left_out": evidence}
    return (None if best is None else candidates[best]), found


def _is_known(row):
    return row["label_psnr"] is not None and row["model_psnr"] is not None
