"""How close-ups are drawn and labeled, in plain numbers; no JAX is imported."""

import dataclasses
import math
from typing import TYPE_CHECKING


if TYPE_CHECKING:
    from jaxcloseup.labels.make import PseudoSettings

_CHOOSE_CODE = "label", "expected_depth"  # settings that are not traced


@dataclasses.dataclass(frozen=True)
class LabelConfig:
    """How random close-ups are drawn and labeled; the defaults are the paper's text.

    Attributes:
      label: what labels close-ups: "warp", the colors of photographs where warps agree, or
        "residual", their own render with detail, all made before the first step.
      magnification: range of lambda, how many times nearer virtual cameras come.
      max_angle: epsilon, the largest change of each Euler angle, radians.
      anchor_tolerance: largest relative distance of an anchor from its view's mean depth.
      look_at: turn virtual cameras about the anchor and not about themselves.
      fixed_anchors: draw only the four anchors of the paper's ablation.
      use_mask: keep labels only where both warps agree in color.
      rgb_tolerance: epsilon of the mask, the largest difference of a channel.
      depth_tolerance: relative agreement with the source view's depth.
      max_ray_angle: largest angle between the rays of a virtual pixel and its source, radians.
      num_sources: photographs whose colors are averaged.
      forward_label: take colors from the forward warps.
      leave_out_source: check a label against the other views alone.
      source_tolerance: relative depth tolerance for choosing a target view's source; inf ignores
        occlusion, as published.
      label_loss_weight: weight of the labels' loss in a step; the photographs' loss has the rest.
      lr_scale: factor on the learning rates in steps with labels.
      expected_depth: label from the expected depth (true) or the median depth (false); none takes
        the depth that the field renders.
    """

    label: str = "warp"
    magnification: tuple[float, float] = (2.0, 8.0)
    max_angle: float = math.pi / 4
    anchor_tolerance: float = math.inf
    look_at: bool = False
    fixed_anchors: bool = False
    use_mask: bool = True
    rgb_tolerance: float = 0.05
    depth_tolerance: float = math.inf
    max_ray_angle: float = math.inf
    num_sources: int = 1
    forward_label: bool = False
    leave_out_source: bool = False
    source_tolerance: float = math.inf
    label_loss_weight: float = 0.5
    lr_scale: float = 1.0
    expected_depth: bool | None = None


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
