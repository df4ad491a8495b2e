"""NeRF, a coarse and a fine network: presets."""

import dataclasses

from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.volumes import (
    NETWORK_ADAM,
    AdamConfig,
    DepthConfig,
    quick_preset,
    volumetric,
)
from jaxcloseup.fields.volume.config import NerfConfig
from jaxcloseup.labels.config import LabelConfig
from jaxcloseup.lazy import lazy_function
from jaxcloseup.setting import setting
from jaxcloseup.training.config import TrainConfig


@dataclasses.dataclass(frozen=True)
class NerfTrainingConfig(NerfConfig, DepthConfig, AdamConfig):
    """A NeRF and its training."""

    initial_lr: float = 5e-4
    lr_decay_steps: int = 250_000
    normalize: bool = setting(
        False, "scale the scene to the unit cube around the cameras and their view"
    )


PAPER = Preset(
    method="nerf",
    field=NerfTrainingConfig(),
    train=TrainConfig(),
    labels=LabelConfig(),
    baseline_steps=200_000,
    closeup_steps=10_000,
)

# The authors' public script where it differs from the text.
RELEASED = dataclasses.replace(
    PAPER,
    train=TrainConfig(num_rays=1536, num_label_rays=563, label_rule="released"),
    labels=LabelConfig(
        magnification=(4.0, 4.0),
        anchor_tolerance=0.2,
        rgb_tolerance=0.1,
        depth_tolerance=0.05,
        forward_label=True,
    ),
)

QUICK = quick_preset(
    "nerf",
    field=NerfTrainingConfig(
        depth=4,
        width=64,
        skip_after=2,
        direction_width=64,
        num_coarse=24,
        num_fine=24,
        initial_lr=5e-3,
        lr_decay_steps=1600,
        normalize=True,
    ),
    rays=512,
    steps=1000,
    # The network is too small for the detail of larger photographs: windows.finest=1 wins nothing.
    finest=8,
)

METHOD = volumetric(
    lazy_function("jaxcloseup.fields.volume.nerf", "nerf_field"),
    help="a coarse and a fine network (Mildenhall et al. 2020)",
    presets={"quick": QUICK, "paper": PAPER, "released": RELEASED},
    make_optimizer=NETWORK_ADAM,
    normalize=lambda config: config.normalize,
)
