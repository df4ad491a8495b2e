"""mip-NeRF: presets."""

import dataclasses

from jaxcloseup.app.methods.volumes import (
    AdamConfig,
    DepthConfig,
    paper_preset,
    quick_preset,
    volumetric,
)
from jaxcloseup.fields.volume.config import MipNerfConfig
from jaxcloseup.lazy import lazy_function


@dataclasses.dataclass(frozen=True)
class MipNerfTrainingConfig(MipNerfConfig, DepthConfig, AdamConfig):
    """A mip-NeRF and its training."""

    initial_lr: float = 5e-4
    lr_decay: float = 0.01
    lr_decay_steps: int = 1_000_000


PAPER = paper_preset(
    "mipnerf", MipNerfTrainingConfig(), rays=4096, steps=1_000_000, closeup_steps=10_000
)

QUICK = quick_preset(
    "mipnerf",
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
    rays=512,
    steps=1000,
    # The network is too small for the detail of larger photographs, as a NeRF's is.
    finest=8,
)

METHOD = volumetric(
    lazy_function("jaxcloseup.fields.volume.mipnerf", "mipnerf_field"),
    help="mip-NeRF, a network that sees cones (Barron et al. 2021)",
    presets={"quick": QUICK, "paper": PAPER},
)
