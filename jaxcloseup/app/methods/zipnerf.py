"""Zip-NeRF: presets."""

import dataclasses

from jaxcloseup.app.methods.volumes import (
    AdamConfig,
    DepthConfig,
    paper_preset,
    quick_preset,
    volumetric,
)
from jaxcloseup.fields.volume.config import HashGridConfig, ZipNerfConfig
from jaxcloseup.lazy import lazy_function


@dataclasses.dataclass(frozen=True)
class ZipNerfTrainingConfig(ZipNerfConfig, DepthConfig, AdamConfig):
    """A Zip-NeRF and its training."""


PAPER = paper_preset(
    "zipnerf",
    ZipNerfTrainingConfig(lr_decay_steps=25_000),
    rays=2**14,
    steps=25_000,
    closeup_steps=500,
)

QUICK = quick_preset(
    "zipnerf",
    field=ZipNerfTrainingConfig(
        grid=HashGridConfig(levels=8, features=2, log2_entries=17, coarsest=16, finest=1024),
        proposal=HashGridConfig(levels=4, features=2, log2_entries=14, coarsest=8, finest=128),
        points=3,
        proposal_points=1,
        width=32,
        color_layers=1,
        direction_octaves=2,
        num_coarse=48,
        num_middle=0,
        num_fine=16,
        spacing=0.0,
        contracted=False,
        proposal_weight=1.0,
        distortion_weight=1e-3,
        decay_weight=1e-4,
        lr_decay_steps=3200,
        chunk=1024,
    ),
    rays=1024,
    steps=3000,
)

METHOD = volumetric(
    lazy_function("jaxcloseup.fields.volume.zipnerf", "zipnerf_field"),
    help="Zip-NeRF, anti-aliased hash features over proposals (Barron et al. 2023)",
    presets={"quick": QUICK, "paper": PAPER},
)
