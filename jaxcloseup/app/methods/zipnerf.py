"""Zip-NeRF: presets."""

import dataclasses

from jaxcloseup.app.methods.method import Preset, WindowConfig
from jaxcloseup.app.methods.volumes import (
    QUICK_LABELS,
    QUICK_TARGETS,
    AdamConfig,
    DepthConfig,
    volumetric,
)
from jaxcloseup.fields.volume.config import HashGridConfig, ZipNerfConfig
from jaxcloseup.labels.config import LabelConfig
from jaxcloseup.lazy import lazy_function
from jaxcloseup.training.config import TrainConfig


@dataclasses.dataclass(frozen=True)
class ZipNerfTrainingConfig(ZipNerfConfig, DepthConfig, AdamConfig):
    """A Zip-NeRF and its training."""


PAPER = Preset(
    method="zipnerf",
    field=ZipNerfTrainingConfig(lr_decay_steps=25_000),
    train=TrainConfig(num_rays=2**14, num_label_rays=2**14),
    labels=LabelConfig(),
    baseline_steps=25_000,
    closeup_steps=500,
)

QUICK = Preset(
    method="zipnerf",
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
    train=TrainConfig(num_rays=1024, num_label_rays=1024, label_rule="pooled"),
    labels=QUICK_LABELS,
    targets=QUICK_TARGETS,
    baseline_steps=3000,
    closeup_steps=200,
    downscale=8,
    windows=WindowConfig(),
)

METHOD = volumetric(
    lazy_function("jaxcloseup.fields.volume.zipnerf", "zipnerf_field"),
    help="Zip-NeRF, anti-aliased hash features over proposals (Barron et al. 2023)",
    presets={"quick": QUICK, "paper": PAPER},
)
