"""The gate: left-out photographs decide whether pseudo-labels are used, and with which weight.

The model has learned its training photographs, so it beats labels there even if the labels would
improve it elsewhere. The gate therefore measures on how many pixels a label's two warps and the
depth agree closely. That share separates captures on which labels help from those on which they
harm: it is about a tenth where colors or depth are poor, and a fifth to a third where labels help
(docs/results.md has the figures).
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp

from experiments import progress
from experiments.evaluation.audit import audit_left_out
from experiments.methods import pseudo_settings
from experiments.training.programs import Programs
from experiments.training.setup import LabelStart
from jaxcloseup.field import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.pseudo import LabelSources, PseudoSettings


# Pairs of color and relative depth tolerance: the first decides, the looser ones are reported.
TOLERANCES = [(rgb, depth) for rgb in (0.02, 0.04, 0.08) for depth in (0.005, 0.02)]
# Shares of closely agreeing pixels above which labels have some weight, and full weight.
AGREEMENT = (0.1, 0.2)


def verdict(found: Mapping[str, Any]) -> str:
    """Return in one sentence what the gate decided and why, without a final period."""
    weight = found["weight"]
    used = "labels have full weight" if weight == 1 else f"labels have {weight:.0%} of their weight"
    used = used if weight else "labels are not used"
    return (
        f"{used}, because they agree closely on {found['agreement']:.0%} of the pixels of left-out "
        f"photographs (no weight up to {AGREEMENT[0]:.0%}, full weight from {AGREEMENT[1]:.0%})"
    )


def weigh(programs: Programs, start: LabelStart) -> tuple[PseudoSettings, dict[str, Any] | None]:
    """The preset's settings of labels after its gate, and the gate's record, if it has one.

    Labels with detail have weights of their own, and no gate.
    """
    preset = programs.preset
    settings = pseudo_settings(preset.labels)
    if not preset.gated or preset.labels.label == "residual":
        return settings, None
    render = functools.partial(programs.render, start.state)
    settings, found = weigh_labels(start.sources, render, settings)
    print(f"gate: {verdict(found)}")
    if not found["weight"]:
        progress.skip("closeup", "test_time")
    return settings, found


def weigh_labels(
    sources: LabelSources,
    render: Callable[[Camera], Rendering],
    settings: PseudoSettings,
) -> tuple[PseudoSettings, dict[str, Any]]:
    """Scale the weight of labels by how well they agree on left-out photographs.

    Args:
      sources: the training photographs with their depths.
      render: `camera -> Rendering` of the model.
      settings: settings of the labels.

    Returns:
      The settings with the scaled `label_loss_weight`, and a record for JSON. `weight`: the factor,
      in [0, 1]. `agreement`: share of the pixels of left-out photographs on which labels agree
      closely. `left_out`: for each pair of tolerances, the PSNR of labels and of the model on the
      labeled pixels, and the share of these pixels.
    """
    candidates = [
        settings.replace(
            use_mask=jnp.float32(1), rgb_tolerance=jnp.float32(rgb), depth_tolerance=jnp.float32(d)
        )
        for rgb, d in TOLERANCES
    ]
    rows = audit_left_out(sources, render, candidates)
    agreement = rows[0]["coverage"]
    low, high = AGREEMENT
    weight = min(max((agreement - low) / (high - low), 0.0), 1.0)
    evidence = [
        {"rgb_tolerance": rgb, "depth_tolerance": depth} | row
        for (rgb, depth), row in zip(TOLERANCES, rows, strict=True)
    ]
    found = {"weight": weight, "agreement": agreement, "left_out": evidence}
    return settings.replace(label_loss_weight=weight * settings.label_loss_weight), found
