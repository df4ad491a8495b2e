"""Configurations of splat fields, their rasterizer and density controls; no JAX is imported."""

import dataclasses
from collections.abc import Hashable
from typing import ClassVar

from jaxcloseup.setting import setting


COMPOSITORS = ("auto", "native", "loops", "kernel")
PLATFORMS = ("cpu", "gpu", "tpu")


@dataclasses.dataclass(frozen=True)
class McmcConfig:
    """When and how many surfels move."""

    every: int = setting(100, "steps between relocations", low=1)
    start: int = setting(500, "step after which relocations begin")
    stop: int = setting(25_000, "step before which relocations and growth end")
    growth: float = setting(
        1.05, "largest factor by which one relocation multiplies the number of living splats"
    )
    min_opacity: float = setting(0.005, "splats no more opaque than this are dead", high=1)
    noise: float = setting(
        5e5,
        "strength of the position noise, relative to the learning rate of the means; 0 adds none",
    )


@dataclasses.dataclass(frozen=True)
class AdaptiveConfig:
    """When surfels are added and removed; lengths are in extents of the capture."""

    every: int = setting(100, "steps between refinements", low=1)
    start: int = setting(500, "step after which refinements begin")
    stop: int = setting(15_000, "step before which refinements and resets end")
    gradient: float = setting(
        2e-4,
        "smallest mean 2-D gradient at which a splat is cloned or split: the norm of the loss's "
        "gradient with respect to the image of its center, in units of half an image, averaged "
        "over the views in which it is not 0",
    )
    small: float = setting(0.01, "splats up to this scale are cloned, larger ones split")
    shrink: float = setting(1.6, "factor by which the halves of a split splat are smaller")
    min_opacity: float = setting(0.05, "fainter splats are removed", high=1)
    huge: float = setting(
        0.1, "larger splats are removed after the first reset, unless they are split"
    )
    reset_every: int = setting(3000, "steps between resets of the opacities", low=1)
    reset_opacity: float = setting(0.01, "largest opacity after a reset", high=1)


@dataclasses.dataclass(frozen=True)
class RasterizeConfig:
    """Static settings of the rasterizer; the sizes change no image whose pairs fit.

    Raises:
      ValueError: there is no such compositor or platform, or `near` is not positive.
    """

    capacity: int = setting(
        2**18,
        "largest number of pairs of splats and tiles that their boxes touch; pairs of the "
        "farthest splats beyond it are left out and counted as overflow",
        low=1,
        high=10**8,
    )
    near: float = setting(0.01, "near plane, a positive z-depth in world units")
    antialias: bool = setting(False, "convolve splats with the pixel, see `project_discs`")
    tile: int | None = setting(
        None,
        "side of a tile in pixels; none chooses by the image's size, see `plan_raster`",
        low=1,
        high=64,
    )
    chunk: int | None = setting(
        None, "splats of a tile that loops evaluate at once; none is 8", low=1
    )
    block: int | None = setting(
        None,
        "largest number of tiles that loops evaluate at once; none chooses by the platform",
        low=1,
    )
    compositor: str = setting(
        "auto",
        "native blends by the native library, on CPUs and where it was built, in lists of any "
        "length; loops by `jax.lax`, in chunks and blocks; kernel by Pallas kernels, which only "
        "GPUs run fast; auto by the fastest that runs",
        choices=COMPOSITORS,
    )
    platform: str | None = setting(
        None,
        "platform for which sizes and the compositor that are left open are chosen; none asks JAX",
        choices=PLATFORMS,
    )

    def __post_init__(self) -> None:
        """Check the names and the near plane."""
        if not self.near > 0:
            raise ValueError(f"near must be a positive depth, not {self.near}")
        if self.compositor not in COMPOSITORS:
            raise ValueError(
                f'RasterizeConfig.compositor must be one of {COMPOSITORS}, not "{self.compositor}"'
            )
        if self.platform not in (None, *PLATFORMS):
            raise ValueError(
                f"RasterizeConfig.platform must be None or one of {PLATFORMS}, not {self.platform}"
            )


@dataclasses.dataclass(frozen=True)
class RasterPlan:
    """A `RasterizeConfig` for one image, with nothing left open; see `plan_raster`."""

    capacity: int  # largest number of pairs of splats and tiles
    near: float  # z-depth before which nothing is drawn
    tile: int  # side of a tile in pixels
    chunk: int = 8  # number of a tile's splats that loops evaluate at once
    block: int = 256  # largest number of tiles that loops evaluate at once
    pairs_at_once: int = 2**14  # largest number of pairs that are listed at once
    compositor: str = "loops"  # one of `COMPOSITORS` except "auto"
    interpret: bool = False  # whether kernels are interpreted


@dataclasses.dataclass(frozen=True)
class SplatConfig:
    """What surfels and volumetric Gaussians share; lengths are in extents of the capture."""

    num_scales: ClassVar[int]

    capacity: int = setting(200_000, "largest number of splats", low=1, high=10**8)
    sh_degree: int = setting(3, "degree of the color's spherical harmonics", high=3)
    sh_every: int = setting(1000, "steps after which rendering uses one more degree", low=1)
    initial_opacity: float = setting(0.5, "opacity of splats at the initial points", high=1)
    depth: str = setting(
        "median",
        "depth along a ray that a new field renders for labels",
        choices=("median", "expected"),
    )
    background: float | None = setting(None, "gray level behind the scene; none is black", high=1)
    color_ridge: float | None = setting(
        None,
        "ridge penalty of the affine color change that training fits to each image, see "
        "`fit_colors`; none fits no change. Renders have no such change: part of the loss "
        "compares unchanged colors",
    )
    ssim_weight: float = setting(
        0.2, "share of 1 - SSIM in the image loss; the absolute difference has the rest", high=1
    )
    distortion_weight: float = setting(
        1.0, "weight of the spread of light along a ray, scaled to a mean depth of 1"
    )
    regularize_from: int = setting(
        3000, "first step with the losses of distortion and of surfels' normals"
    )
    depth_weight: float = setting(
        0.0, "weight of the relative error of depths that stereo found; 0 learns from none"
    )
    depth_kept: float = setting(
        0.0, "share of `depth_weight` that stays: it falls until `means_lr_steps`", high=1
    )
    opacity_weight: float = setting(0.01, "weight of the mean opacity")
    scale_weight: float = setting(0.01, "weight of the mean scale")
    means_lr: tuple[float, float] = setting(
        (1.6e-4, 1.6e-6),
        "learning rate of the means at step 0 and from step `means_lr_steps` on, with "
        "exponential decay in between",
    )
    means_lr_steps: int = setting(30_000, "steps over which `means_lr` decays", low=1)
    late_lr_scale: float = setting(
        1.0, "factor on all learning rates from step `means_lr_steps` on"
    )
    sh_lr: float = setting(
        2.5e-3, "Adam's learning rate of the constant color; view-dependent color has 1/20 of it"
    )
    opacity_lr: float = setting(5e-2, "Adam's learning rate of the opacity logits")
    scale_lr: float = setting(5e-3, "Adam's learning rate of the log scales")
    rotation_lr: float = setting(1e-3, "Adam's learning rate of the quaternions")
    max_scale: float | None = setting(
        None,
        "largest standard deviation of a splat; none sets no bound. A large splat may be "
        "occluded in every photograph and fill a close-up",
        low=1e-6,
    )
    selective_adam: bool = setting(
        False, "update only splats that a step sees, see `scale_by_selective_adam`"
    )
    density: Hashable | None = setting(
        McmcConfig(),
        "configuration of a density control, which moves, adds and removes splats, see "
        "`density_control`",
    )
    raster: RasterizeConfig = setting(RasterizeConfig(), "static sizes of the rasterizer")


@dataclasses.dataclass(frozen=True)
class SurfelConfig(SplatConfig):
    """Surfels and their training."""

    num_scales: ClassVar[int] = 2

    normal_weight: float = setting(0.05, "weight of the disagreement between normals and `depth`")


@dataclasses.dataclass(frozen=True)
class GaussianConfig(SplatConfig):
    """Volumetric Gaussians and their training, by default without the loss of distortion."""

    num_scales: ClassVar[int] = 3

    distortion_weight: float = 0.0
