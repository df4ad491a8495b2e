"""Configurations of splat fields, their rasterizer and density controls; no JAX is imported."""

import dataclasses
from collections.abc import Hashable
from typing import ClassVar


COMPOSITORS = ("auto", "loops", "kernel")


@dataclasses.dataclass(frozen=True)
class McmcConfig:
    """When and how many surfels move.

    Attributes:
      every: steps between relocations.
      start: the first relocation comes after this step.
      stop: the last relocation, and the last growth, comes before this step.
      growth: largest factor by which one relocation multiplies the number of living surfels.
      min_opacity: a surfel that is no more opaque than this is dead.
      noise: strength of the position noise, relative to the learning rate of the means; 0 is none.
    """

    every: int = 100
    start: int = 500
    stop: int = 25_000
    growth: float = 1.05
    min_opacity: float = 0.005
    noise: float = 5e5


@dataclasses.dataclass(frozen=True)
class AdaptiveConfig:
    """When surfels are added and removed; lengths are in extents of the capture.

    Attributes:
      every: steps between refinements.
      start: the first refinement comes after this step.
      stop: the last refinement and the last reset come before this step.
      gradient: a surfel is cloned or split where its mean 2-D gradient is at least this: the norm
        of the loss's gradient with respect to the image of its center, in units of half an image,
        averaged over the views in which it is not 0.
      small: a surfel up to this scale is cloned; a larger one is split.
      shrink: factor by which the halves of a split surfel are smaller.
      min_opacity: fainter surfels are removed.
      huge: larger surfels are removed after the first reset, unless they are split.
      reset_every: steps between resets of the opacities.
      reset_opacity: largest opacity after a reset.
    """

    every: int = 100
    start: int = 500
    stop: int = 15_000
    gradient: float = 2e-4
    small: float = 0.01
    shrink: float = 1.6
    min_opacity: float = 0.05
    huge: float = 0.1
    reset_every: int = 3000
    reset_opacity: float = 0.01


@dataclasses.dataclass(frozen=True)
class RasterizeConfig:
    """Static settings of the rasterizer; the sizes change no image whose pairs fit.

    Attributes:
      capacity: largest number of pairs of splats and the tiles that their boxes touch. `overflow`
        counts the pairs beyond it, which are those of the farthest splats; render again with a
        larger capacity.
      near: positive z-depth in world units; nothing nearer is drawn.
      antialias: convolve surfels with the pixel, see `project_discs`.
      tile: side of a tile in pixels; None: by the image's size, see `for_image`.
      chunk: number of a tile's splats that loops evaluate at once; None: 8.
      block: largest number of tiles that loops evaluate at once; None: by the platform.
      compositor: "loops" blends by `jax.lax`, with chunks and blocks; "kernel" by Pallas kernels,
        which other platforms than GPUs interpret, slowly; "auto" by kernels on a GPU that runs
        them, else by loops.

    Raises:
      ValueError: there is no such compositor.
    """

    capacity: int = 2**18
    near: float = 0.01
    antialias: bool = False
    tile: int | None = None
    chunk: int | None = None
    block: int | None = None
    compositor: str = "auto"

    def __post_init__(self) -> None:
        """Check the compositor's name."""
        if self.compositor not in COMPOSITORS:
            raise ValueError(
                f'RasterizeConfig.compositor must be one of {COMPOSITORS}, not "{self.compositor}"'
            )


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
