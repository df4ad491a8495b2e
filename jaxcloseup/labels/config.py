"""How close-ups are drawn and labeled, in plain numbers; no JAX is imported."""

import dataclasses
import math
from typing import TYPE_CHECKING

from jaxcloseup.setting import setting


if TYPE_CHECKING:
    from jaxcloseup.labels.make import PseudoSettings

_CHOOSE_CODE = "label", "expected_depth"  # settings that are not traced


@dataclasses.dataclass(frozen=True)
class LabelConfig:
    """How random close-ups are drawn and labeled; the defaults are the paper's text."""

    label: str = setting(
        "warp",
        "source of labels: warp takes colors of photographs where warps agree; residual takes "
        "renders with detail, all made before the first step",
        choices=("warp", "residual"),
    )
    magnification: tuple[float, float] = setting(
        (2.0, 8.0), "range of lambda, by how much nearer virtual cameras are", low=1, rising=True
    )
    max_angle: float = setting(
        math.pi / 4, "epsilon, the largest change of each Euler angle in radians"
    )
    anchor_tolerance: float = setting(
        math.inf, "largest relative distance of an anchor from its view's mean depth"
    )
    look_at: bool = setting(False, "turn virtual cameras about the anchor, not about themselves")
    fixed_anchors: bool = setting(False, "draw only the four anchors of the paper's ablation")
    use_mask: bool = setting(True, "keep labels only where both warps agree in color")
    rgb_tolerance: float = setting(0.05, "epsilon of the mask, the largest difference of a channel")
    depth_tolerance: float = setting(
        math.inf, "largest relative difference from the source view's depth"
    )
    max_ray_angle: float = setting(
        math.inf, "largest angle between the rays of a virtual pixel and its source in radians"
    )
    num_sources: int = setting(1, "photographs whose colors are averaged", low=1)
    forward_label: bool = setting(False, "take colors from the forward warps")
    leave_out_source: bool = setting(False, "check a label against the other views alone")
    source_tolerance: float = setting(
        math.inf,
        "relative depth tolerance for choosing a target view's source; inf ignores occlusion, "
        "as published",
    )
    label_loss_weight: float = setting(
        0.5, "weight of the labels' loss in a step; the photographs' loss has the rest", high=1
    )
    lr_scale: float = setting(1.0, "factor on the learning rates in steps with labels")
    expected_depth: bool | None = setting(
        None,
        "label from the expected depth (true) or the median depth (false); none takes the depth "
        "that the field renders",
    )


def pseudo_settings(labels: LabelConfig) -> "PseudoSettings":
    """Return the traced settings of pseudo-labels."""
    import jax.numpy as jnp

    from jaxcloseup.geometry.poses import PoseSettings
    from jaxcloseup.labels.make import PseudoSettings

    values = {
        name: jnp.asarray(value, jnp.float32)
        for name, value in vars(labels).items()
        if name not in _CHOOSE_CODE
    }
    pose = {field.name: values.pop(field.name) for field in dataclasses.fields(PoseSettings)}
    return PseudoSettings(pose=PoseSettings(**pose), **values)
