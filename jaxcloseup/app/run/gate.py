"""The gate: left-out photographs decide whether pseudo-labels are used, and with which weight.

The model has learned its training photographs, so it beats labels there even if the labels would
improve it elsewhere. The gate therefore measures on how many pixels a label's two warps and the
depth agree closely. That share separates captures on which labels help from those on which they
harm: it is about a tenth where colors or depth are poor, and a fifth to a third where labels help
(docs/labels.md has the figures).
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp

from jaxcloseup.app.run.labels import LabelStart
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.score.audit import audit_left_out
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.labels.config import LabelConfig, pseudo_settings
from jaxcloseup.labels.make import LabelSources, PseudoSettings


# Pairs of color and relative depth tolerance: the first decides, the looser ones are reported.
TOLERANCES = [(rgb, depth) for rgb in (0.02, 0.04, 0.08) for depth in (0.005, 0.02)]
# Shares of closely agreeing pixels above which labels have some weight, and full weight.
AGREEMENT = (0.1, 0.2)


def verdict(record: Mapping[str, Any]) -> str:
    """Return in one sentence what the gate decided and why, without a final period."""
    weight = record["weight"]
    used = "labels have full weight" if weight == 1 else f"labels have {weight:.0%} of their weight"
    used = used if weight else "labels are not used"
    return (
        f"{used}, because they agree closely on {record['agreement']:.0%} of the pixels of "
        f"left-out photographs (no weight up to {AGREEMENT[0]:.0%}, full weight from "
        f"{AGREEMENT[1]:.0%})"
    )


def weigh(programs: Programs, start: LabelStart) -> dict[str, Any] | None:
    """Return the record of `weigh_labels` and print its verdict; None without a gate.

    Labels with detail have weights of their own, and no gate.
    """
    preset = programs.preset
    if not preset.gated or "warp" not in (preset.labels.label, preset.target_labels.label):
        return None
    render = functools.partial(programs.render, start.state)
    record = weigh_labels(start.sources, render, pseudo_settings(preset.labels))
    print(f"     gate: {verdict(record)}")
    return record


def uses_labels(labels: LabelConfig, gate: Mapping[str, Any] | None) -> bool:
    """Return True if pseudo-labels are used; the gate can disable warped ones."""
    return labels.label != "warp" or gate is None or gate["weight"] > 0


def gated(labels: LabelConfig, gate: Mapping[str, Any] | None) -> PseudoSettings:
    """Return the settings of labels; the gate scales the weight of warped ones."""
    settings = pseudo_settings(labels)
    if gate is None or labels.label != "warp":
        return settings
    weight = jnp.float32(gate["weight"]) * settings.label_loss_weight
    return dataclasses.replace(settings, label_loss_weight=weight)


def weigh_labels(
    sources: LabelSources, render: Callable[[Camera], Rendering], settings: PseudoSettings
) -> dict[str, Any]:
    """Measure how well labels agree on left-out photographs, and derive their weight.

    Returns:
      A record for JSON. `weight`: a factor on `label_loss_weight`, in [0, 1]. `agreement`: share of
      the pixels of left-out photographs on which labels agree closely. `left_out`: for each pair of
      tolerances, the PSNR of labels and of the model on the labeled pixels, and the share of these
      pixels.
    """
    candidates = [
        dataclasses.replace(
            settings,
            use_mask=jnp.float32(1),
            rgb_tolerance=jnp.float32(rgb),
            depth_tolerance=jnp.float32(depth),
        )
        for rgb, depth in TOLERANCES
    ]
    rows: list[dict[str, Any]] = audit_left_out(sources, render, candidates)
    agreement = rows[0]["coverage"]
    low, high = AGREEMENT
    weight = min(max((agreement - low) / (high - low), 0.0), 1.0)
    evidence = [
        {"rgb_tolerance": rgb, "depth_tolerance": depth} | row
        for (rgb, depth), row in zip(TOLERANCES, rows, strict=True)
    ]
    return {"weight": weight, "agreement": agreement, "left_out": evidence}
