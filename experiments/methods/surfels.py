"""Surfels (2D Gaussian splatting): presets, field, optimizer and exports."""

import dataclasses
import pathlib

import optax

from experiments.methods.method import LabelConfig, Method, Preset
from jaxcloseup.artifacts.gaussians import as_gaussians
from jaxcloseup.artifacts.surfel_ply import write_surfels
from jaxcloseup.field import RadianceField
from jaxcloseup.scene import Scene
from jaxcloseup.splats.adaptive import AdaptiveConfig
from jaxcloseup.splats.field import (
    SurfelBuffers,
    SurfelConfig,
    camera_extent,
    surfel_field,
    surfel_optimizer,
    with_expected_depth,
)
from jaxcloseup.splats.mcmc import McmcConfig
from jaxcloseup.splats.rasterize import RasterizeConfig
from jaxcloseup.splats.surfels import Surfels
from jaxcloseup.train import TrainConfig


@dataclasses.dataclass(frozen=True)
class SurfelTrainingConfig(SurfelConfig):
    """Surfels and their training.

    Attributes:
      steps_per_target: steps for each target view.
    """

    steps_per_target: int = 5


WHOLE_IMAGES = TrainConfig(num_rays=None, num_label_rays=None)

PAPER = Preset(
    method="surfels",
    field=SurfelTrainingConfig(density=McmcConfig(stop=25_000)),
    train=WHOLE_IMAGES,
    labels=LabelConfig(),
    baseline_steps=30_000,
    closeup_steps=500,
)

QUICK = Preset(
    method="surfels",
    field=SurfelTrainingConfig(
        capacity=10_000,
        sh_degree=1,
        sh_every=500,
        regularize_from=500,
        means_lr=(1.6e-3, 1.6e-5),
        means_lr_steps=2000,
        late_lr_scale=0.1,
        rotation_lr=5e-3,
        distortion_weight=0.1,
        density=McmcConfig(start=200, stop=1600, growth=1.1, noise=5e4),
        raster=RasterizeConfig(capacity=2**15, block=32),
    ),
    train=WHOLE_IMAGES,
    labels=LabelConfig(
        magnification=(1.5, 3.0),
        leave_out_source=True,
        source_tolerance=0.05,
        label_loss_weight=0.05,
    ),
    baseline_steps=2000,
    closeup_steps=200,
    downscale=8,
    gated=True,
)


def with_adaptive_density(preset: Preset, density: AdaptiveConfig) -> Preset:
    """The preset with clone, split and prune, which starts fainter and needs no prior to fade."""
    field = dataclasses.replace(
        preset.field,
        density=density,
        initial_opacity=0.1,
        opacity_weight=0.0,
        scale_weight=0.0,
    )
    return dataclasses.replace(preset, field=field)


# The quick training is too short for a reset of opacities.
QUICK_ADAPTIVE = with_adaptive_density(QUICK, AdaptiveConfig(start=200, stop=1200))
PAPER_ADAPTIVE = with_adaptive_density(PAPER, AdaptiveConfig())


def make_field(config: SurfelTrainingConfig, scene: Scene, growth: int) -> RadianceField:
    """Surfels sized for a scene; `growth` multiplies the rasterizer's capacity."""
    size = extent(scene)
    # In a small scene the near plane must not hide what close-ups are for.
    near = min(config.raster.near, 0.01 * size)
    raster = dataclasses.replace(config.raster, capacity=config.raster.capacity * growth, near=near)
    return surfel_field(dataclasses.replace(config, raster=raster), extent=size)


def make_optimizer(config: SurfelTrainingConfig, scene: Scene) -> optax.GradientTransformation:
    """Adam with a learning rate for each kind of parameter."""
    return surfel_optimizer(config, extent=extent(scene))


def extent(scene: Scene) -> float:
    """Size of a capture: the reach of its cameras, or half its depth if they stand in one place."""
    reach = float(camera_extent(scene.train.cameras))
    # Rounding gives identical cameras a tiny extent.
    return reach if reach > 1e-4 * scene.far else 0.5 * scene.far


def export(folder: pathlib.Path, stage: str, surfels: Surfels, buffers: SurfelBuffers) -> None:
    """Write `splats/<stage>.ply`, for viewers of Gaussian splats."""
    write_surfels(folder / "splats" / f"{stage}.ply", surfels, buffers.alive)


METHOD = Method(
    presets={
        "quick": QUICK,
        "paper": PAPER,
        "quick_adaptive": QUICK_ADAPTIVE,
        "paper_adaptive": PAPER_ADAPTIVE,
    },
    make_field=make_field,
    make_optimizer=make_optimizer,
    renders_pixels=False,
    target_steps=lambda config, count: config.steps_per_target * count,
    max_points=lambda config: config.capacity,
    with_expected_depth=with_expected_depth,
    export=export,
    gaussians=lambda surfels, buffers: as_gaussians(surfels, buffers.alive),
    background=lambda config: config.background or 0.0,
)
