"""TensoRF: presets."""

import dataclasses

from jaxcloseup.app.methods.volumes import (
    AdamConfig,
    DepthConfig,
    paper_preset,
    quick_preset,
    volumetric,
)
from jaxcloseup.fields.volume.config import TensorfConfig
from jaxcloseup.lazy import lazy_function


@dataclasses.dataclass(frozen=True)
class TensorfTrainingConfig(TensorfConfig, DepthConfig, AdamConfig):
    """A TensoRF and its training."""

    initial_lr: float = 2e-2


PAPER = paper_preset(
    "tensorf",
    TensorfTrainingConfig(lr_decay_steps=30_000),
    rays=4096,
    steps=30_000,
    closeup_steps=500,
)

QUICK = quick_preset(
    "tensorf",
    field=TensorfTrainingConfig(
        coarsest=32,
        finest=128,
        growths=3,
        grow_every=100,
        density_components=4,
        color_components=8,
        appearance=16,
        width=32,
        density_shift=-2.0,
        sparsity_weight=1e-3,
        smoothness_weight=0.05,
        num_coarse=48,
        num_fine=20,
        spacing=0.0,
        initial_lr=1e-2,
        lr_decay_steps=4200,
        chunk=1024,
    ),
    rays=512,
    steps=4000,
)

METHOD = volumetric(
    lazy_function("jaxcloseup.fields.volume.tensorf", "tensorf_field"),
    help="TensoRF, sums of vector-matrix products on a grid that grows (Chen et al. 2022)",
    presets={"quick": QUICK, "paper": PAPER},
)
