"""Instant-NGP with proposals: presets and field."""

import dataclasses

from experiments.methods.method import LabelConfig, Method, Preset, WindowConfig
from experiments.methods.volumes import (
    AdamConfig,
    DepthConfig,
    adam,
    depth_supervision,
    unit_cube,
)
from jaxcloseup.field import RadianceField
from jaxcloseup.scene import Scene
from jaxcloseup.train import TrainConfig
from jaxcloseup.volume.hash_grid import HashGridConfig
from jaxcloseup.volume.ngp import NgpConfig, ngp


@dataclasses.dataclass(frozen=True)
class NgpTrainingConfig(NgpConfig, DepthConfig, AdamConfig):
    """Instant-NGP and its training."""


PAPER = Preset(
    method="ngp",
    field=NgpTrainingConfig(),
    train=TrainConfig(num_rays=2**13, num_label_rays=2**13),
    labels=LabelConfig(),
    baseline_steps=30_000,
    closeup_steps=500,
)

QUICK = Preset(
    method="ngp",
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
        contracted=True,
        distortion_weight=1e-3,
        initial_lr=1e-2,
        lr_decay_steps=2700,
        chunk=2048,
    ),
    train=TrainConfig(num_rays=1024, num_label_rays=1024, label_rule="pooled"),
    labels=LabelConfig(
        rgb_tolerance=0.04, depth_tolerance=0.02, leave_out_source=True, source_tolerance=0.05
    ),
    baseline_steps=2500,
    closeup_steps=200,
    downscale=8,
    windows=WindowConfig(),
)


def make_field(config: NgpTrainingConfig, scene: Scene, growth: int) -> RadianceField:
    """Instant-NGP between the scene's near and far; nothing overflows."""
    del growth
    center, scale = unit_cube(scene)
    return ngp(
        config,
        near=scene.near,
        far=scene.far,
        center=center,
        scale=scale,
        supervision=depth_supervision(config, scene),
    )


METHOD = Method(
    presets={"quick": QUICK, "paper": PAPER},
    make_field=make_field,
    make_optimizer=adam,
    renders_pixels=True,
    target_steps=lambda config, count: config.target_steps,
)
