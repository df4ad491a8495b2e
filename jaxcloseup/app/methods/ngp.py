"""Instant-NGP with proposals: presets."""

import dataclasses

from jaxcloseup.app.methods.method import StereoTraining
from jaxcloseup.app.methods.volumes import (
    AdamConfig,
    DepthConfig,
    paper_preset,
    quick_preset,
    volumetric,
)
from jaxcloseup.fields.volume.config import HashGridConfig, NgpConfig
from jaxcloseup.lazy import lazy_function


@dataclasses.dataclass(frozen=True)
class NgpTrainingConfig(NgpConfig, DepthConfig, AdamConfig):
    """Instant-NGP and its training."""


PAPER = paper_preset("ngp", NgpTrainingConfig(), rays=2**13, steps=30_000, closeup_steps=500)

QUICK = quick_preset(
    "ngp",
    field=NgpTrainingConfig(
        grid=HashGridConfig(levels=8, features=2, log2_entries=17, coarsest=16, finest=1024),
        proposal=HashGridConfig(levels=4, features=2, log2_entries=14, coarsest=8, finest=128),
        width=32,
        color_layers=1,
        direction_octaves=2,
        num_coarse=48,
        num_middle=0,
        num_fine=16,
        spacing=0.0,
        distortion_weight=1e-3,
        initial_lr=1e-2,
        lr_decay_steps=2700,
        depth_weight=0.01,
        depth_from="stereo",
        chunk=2048,
    ),
    rays=1024,
    steps=2500,
    stereo=StereoTraining(points=0),
)

METHOD = volumetric(
    lazy_function("jaxcloseup.fields.volume.ngp", "ngp_field"),
    help="Instant-NGP, a hash grid and small networks, with proposals (Müller et al. 2022)",
    presets={"quick": QUICK, "paper": PAPER},
)
