"""Configurations of fields of splats: discs, and volumetric Gaussians."""

import dataclasses
from collections.abc import Hashable
from typing import ClassVar

from jaxcloseup.fields.splats.mcmc import McmcConfig
from jaxcloseup.fields.splats.rasterize import RasterizeConfig


@dataclasses.dataclass(frozen=True)
class SplatConfig:
    """What surfels and volumetric Gaussians share; lengths are in extents of the capture.

    Attributes:
      num_scales: standard deviations of a splat: 2 of a disc, 3 of a volumetric Gaussian.
      capacity: largest number of surfels.
      sh_degree: degree of the color's spherical harmonics, 0 to 3.
      sh_every: steps after which rendering uses one more degree.
      initial_opacity: opacity of surfels at the initial points.
      depth: "median" or "expected": what a new field renders for labels; `with_expected_depth`
        changes it.
      background: gray level in [0, 1] behind the scene; None is black.
      color_ridge: in training, each image may change its colors by an affine map; this is the
        resistance to it, see `fit_colors`, and None allows no change. Rendered images have no such
        change: part of the loss compares their unchanged colors with the photographs.
      ssim_weight: share of 1 - SSIM in the image loss; the absolute difference has the rest.
      distortion_weight: weight of the spread of light along a ray, scaled to a mean depth of 1.
      regularize_from: first step with the losses of distortion and, of surfels, of normals.
      opacity_weight: weight of the mean opacity.
      scale_weight: weight of the mean scale.
      means_lr: learning rate of the means at step 0 and from step `means_lr_steps` on; it decays
        exponentially in between.
      means_lr_steps: steps over which `means_lr` decays.
      late_lr_scale: factor on all learning rates from step `means_lr_steps` on.
      sh_lr: Adam's learning rate of the constant color; view-dependent color has 1/20 of it.
      opacity_lr: Adam's learning rate of the opacity logits.
      scale_lr: Adam's learning rate of the log scales.
      rotation_lr: Adam's learning rate of the quaternions.
      max_scale: largest standard deviation of a surfel, see `surfel_field`; None sets no bound. A
        large surfel may be hidden from every photograph, and fill a close-up.
      selective_adam: leave surfels that a step does not see alone, see `scale_by_selective_adam`.
      density: config of a density control, which moves, adds and removes surfels, see
        `density_control`; None has none.
      raster: static sizes of the rasterizer.
    """

    num_scales: ClassVar[int]

    capacity: int = 200_000
    sh_degree: int = 3
    sh_every: int = 1000
    initial_opacity: float = 0.5
    depth: str = "median"
    background: float | None = None
    color_ridge: float | None = None
    ssim_weight: float = 0.2
    distortion_weight: float = 1.0
    regularize_from: int = 3000
    opacity_weight: float = 0.01
    scale_weight: float = 0.01
    means_lr: tuple[float, float] = (1.6e-4, 1.6e-6)
    means_lr_steps: int = 30_000
    late_lr_scale: float = 1.0
    sh_lr: float = 2.5e-3
    opacity_lr: float = 5e-2
    scale_lr: float = 5e-3
    rotation_lr: float = 1e-3
    max_scale: float | None = None
    selective_adam: bool = False
    density: Hashable | None = dataclasses.field(default_factory=McmcConfig)
    raster: RasterizeConfig = dataclasses.field(default_factory=RasterizeConfig)


@dataclasses.dataclass(frozen=True)
class SurfelConfig(SplatConfig):
    """Surfels and their training.

    Attributes:
      normal_weight: weight of the disagreement between normals and `depth`.
    """

    num_scales: ClassVar[int] = 2

    normal_weight: float = 0.05


@dataclasses.dataclass(frozen=True)
class GaussianConfig(SplatConfig):
    """Volumetric Gaussians and their training, by default without the loss of distortion."""

    num_scales: ClassVar[int] = 3

    distortion_weight: float = 0.0
