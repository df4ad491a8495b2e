"""mip-NeRF: presets."""

import dataclasses

from jaxcloseup.app.methods.method import Preset, WindowConfig
from jaxcloseup.app.methods.volumes import (
    QUICK_LABELS,
    QUICK_TARGETS,
    AdamConfig,
    DepthConfig,
    volumetric,
)
from jaxcloseup.fields.volume.config import MipNerfConfig
from jaxcloseup.labels.config import LabelConfig
from jaxcloseup.lazy import lazy_function
from jaxcloseup.training.config import TrainConfig


@dataclasses.dataclass(frozen=True)
class MipNerfTrainingConfig(MipNerfConfig, DepthConfig, AdamConfig):
    """A mip-NeRF and its training."""

    initial_lr: float = 5e-4
    lr_decay: float = 0.01
    lr_decay_steps: int = 1_000_000


PAPER = Preset(
    method="mipnerf",
    field=MipNerfTrainingConfig(),
    train=TrainConfig(num_rays=4096, num_label_rays=4096),
    labels=LabelConfig(),
    baseline_steps=1_000_000,
    closeup_steps=10_000,
)

QUICK = Preset(
    method="mipnerf",
    field=MipNerfTrainingConfig(
        depth=4,
        width=64,
        skip_after=2,
        position_octaves=10,
        direction_width=64,
        num_coarse=24,
        num_fine=32,
        initial_lr=5e-3,
        lr_decay=0.1,
        lr_decay_steps=1600,
    ),
    train=TrainConfig(num_rays=512, num_label_rays=512, label_rule="pooled"),
    labels=QUICK_LABELS,
    targets=QUICK_TARGETS,
    baseline_steps=1000,
    closeup_steps=200,
    downscale=8,
    # The network is too small for the detail of larger photographs, as a NeRF's is.
    windows=WindowConfig(finest=8),
)

METHOD = volumetric(
    lazy_function("jaxcloseup.fields.volume.mipnerf", "mipnerf_field"),
    help="mip-NeRF, a network that sees cones (Barron et al. 2021)",
    presets={"quick": QUICK, "paper": PAPER},
)
