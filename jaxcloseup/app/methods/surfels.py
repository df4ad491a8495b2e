"""Surfels (2D Gaussian splatting): presets."""

import dataclasses

from jaxcloseup.app.methods.method import (
    CoarseConfig,
    Method,
    Preset,
    StereoTraining,
    TargetConfig,
    WindowConfig,
)
from jaxcloseup.fields.splats.config import (
    AdaptiveConfig,
    McmcConfig,
    RasterizeConfig,
    SurfelConfig,
)
from jaxcloseup.labels.config import LabelConfig
from jaxcloseup.lazy import lazy_function
from jaxcloseup.setting import setting
from jaxcloseup.training.config import TrainConfig


TRAINING = "jaxcloseup.app.methods.shared.splat_training"


@dataclasses.dataclass(frozen=True)
class SplatTraining:
    """How runs train surfels and volumetric Gaussians, beside the field's configuration."""

    steps_per_target: int = setting(5, "steps for each target view", low=1)
    fewest_target_steps: int = setting(1, "smallest number of steps for all target views", low=1)
    surfels_per_target: int = setting(
        0,
        "splats added for each target view where its labels show more detail, replacing the "
        "least visible splats",
    )
    smoothed_at: int | None = setting(
        None,
        "divisor of the photographs' size whose pixels bound how small splats are, by the "
        "smoothing filter in space; none applies no filter",
        low=1,
    )


@dataclasses.dataclass(frozen=True)
class SurfelTrainingConfig(SplatTraining, SurfelConfig):
    """Surfels and their training."""


WHOLE_IMAGES = TrainConfig(num_rays=None, num_label_rays=None)

# The defaults of the published code: no loss of distortion, normals from step 7000 on, of the
# expected depth. Labels take the median depth, which mixes no surfaces along a ray.
PAPER = Preset(
    method="surfels",
    field=SurfelTrainingConfig(
        depth="expected",
        distortion_weight=0.0,
        regularize_from=7000,
        density=McmcConfig(stop=25_000),
    ),
    train=WHOLE_IMAGES,
    labels=LabelConfig(expected_depth=False),
    baseline_steps=30_000,
    closeup_steps=500,
)

# Photographs reduced eightfold alone.
REDUCED = Preset(
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
        raster=RasterizeConfig(capacity=2**15),
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

# First a coarse model, fast; then small surfels where photographs show more, taught by windows.
# A surfel above `max_scale` may hide from photographs, and cost a close-up 10 dB.
_COARSE = dataclasses.replace(
    REDUCED.field,
    means_lr_steps=1500,
    depth_weight=1.0,
    raster=dataclasses.replace(REDUCED.field.raster, antialias=True),
)
QUICK = dataclasses.replace(
    REDUCED,
    field=dataclasses.replace(
        REDUCED.field,
        capacity=300_000,
        sh_every=1,
        regularize_from=1,
        means_lr=(4e-4, 1.6e-5),
        means_lr_steps=6300,
        sh_lr=7.5e-3,
        scale_lr=1.5e-2,
        color_ridge=0.1,
        depth_weight=1.0,
        max_scale=0.1,
        selective_adam=True,
        steps_per_target=20,
        fewest_target_steps=40,
        surfels_per_target=1000,
        density=McmcConfig(start=0, stop=700, growth=1.0, noise=0.0),
        raster=RasterizeConfig(capacity=2**17, antialias=True),
    ),
    coarse=CoarseConfig(field=_COARSE, steps=1500, poses=True),
    windows=WindowConfig(whole_share=0.03),
    stereo=StereoTraining(),
    targets=TargetConfig("residual", label_loss_weight=0.7, lr_scale=10.0, control_lr_scale=2.0),
    baseline_steps=6500,
    downscale=None,
)


# The same with windows twice as wide and high, twice the surfels, and as many steps.
STANDARD = dataclasses.replace(
    QUICK,
    field=dataclasses.replace(
        QUICK.field,
        capacity=500_000,
        raster=dataclasses.replace(QUICK.field.raster, capacity=2**18, block=128),
    ),
    coarse=CoarseConfig(
        field=dataclasses.replace(
            _COARSE,
            capacity=20_000,
            raster=dataclasses.replace(_COARSE.raster, capacity=2**17, block=128),
        ),
        steps=1500,
        poses=True,
    ),
    step_pixels=4 * QUICK.step_pixels,
)


def with_adaptive_density(preset: Preset, density: AdaptiveConfig) -> Preset:
    """Return the preset with clone, split and prune; it starts fainter, without decay."""
    field = dataclasses.replace(
        preset.field, density=density, initial_opacity=0.1, opacity_weight=0.0, scale_weight=0.0
    )
    return dataclasses.replace(preset, field=field)


# The quick training is too short for a reset of opacities.
QUICK_ADAPTIVE = with_adaptive_density(REDUCED, AdaptiveConfig(start=200, stop=1200))
PAPER_ADAPTIVE = with_adaptive_density(PAPER, AdaptiveConfig())

METHOD = Method(
    help="2D Gaussian splatting (Huang et al. 2024)",
    presets={
        "quick": QUICK,
        "standard": STANDARD,
        "paper": PAPER,
        "reduced": REDUCED,
        "quick_adaptive": QUICK_ADAPTIVE,
        "paper_adaptive": PAPER_ADAPTIVE,
    },
    make_field=lazy_function(TRAINING, "make_field"),
    make_optimizer=lazy_function(TRAINING, "make_optimizer"),
    renders_pixels=False,
    target_steps=lambda config, count: max(
        config.steps_per_target * count, config.fewest_target_steps
    ),
    max_points=lambda config: config.capacity,
    with_expected_depth=lazy_function(
        "jaxcloseup.fields.splats.splat_field", "with_expected_depth"
    ),
    splats=lazy_function(TRAINING, "splats"),
    background=lambda config: config.background or 0.0,
    refine=lazy_function(TRAINING, "refine"),
    add_for_targets=lazy_function(TRAINING, "add_for_targets"),
)
