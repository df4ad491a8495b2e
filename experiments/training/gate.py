"""Whether to use pseudo-labels, and with which weight: decided by left-out photographs.

A model has learnt the photographs that it is trained on, so that labels lose against it there even
where they would teach it something elsewhere. What separates captures on which labels help from
those on which they harm is how often a label, its check by the other photographs and the depth
agree closely: on a tenth of the pixels where colors or depth are poor, on a fifth to a third where
labels help (BUILD.md has the figures).
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp

from experiments.evaluation.audit import audit_left_out
from jaxcloseup.field import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.pseudo import LabelSources, PseudoSettings


# Colors and relative depths agree closely, and looser pairs to look at.
TOLERANCES = [(rgb, depth) for rgb in (0.02, 0.04, 0.08) for depth in (0.005, 0.02)]
# Shares of pixels that agree closely, from which labels are used at all, and with full weight.
AGREEMENT = (0.1, 0.2)


def print_gate(found: Mapping[str, Any]) -> None:
    """Say what the left-out photographs showed."""
    print(f"     gate: {verdict(found)}")


def verdict(found: Mapping[str, Any]) -> str:
    """What the left-out photographs showed, in a sentence."""
    weight = found["weight"]
    used = "labels are used" if weight == 1 else f"labels weigh {weight:.0%} of their share"
    used = used if weight else "no labels are used"
    return (
        f"{used}, for on {found['agreement']:.0%} of the pixels of left-out photographs they agree "
        f"closely (none under {AGREEMENT[0]:.0%}, all from {AGREEMENT[1]:.0%})"
    )


def weigh_labels(
    sources: LabelSources,
    render: Callable[[Camera], Rendering],
    settings: PseudoSettings,
) -> tuple[PseudoSettings, dict[str, Any]]:
    """The settings with the share that labels deserve, which may be 0, and the evidence.

    Args:
      sources: the training photographs.
      render: `camera -> Rendering` of the model.
      settings: of the labels.

    Returns:
      Settings, and as JSON can hold it: `weight` in [0, 1], the factor on the labels' share;
      `agreement`, the share of pixels of left-out photographs on which labels agree closely; and
      `left_out`, for each pair of tolerances the labels' PSNR and the model's on the same pixels.
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
