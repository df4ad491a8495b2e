"""Named sets of hyper-parameters, for each method.

`quick` is the smallest run that shows the method honestly, `paper` the text of the paper and
`released` what its public script, which knows NeRF alone, does where the two differ.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxcloseup.field import RadianceField
from jaxcloseup.geometry.poses import PoseSettings
from jaxcloseup.pseudo import PseudoSettings
from jaxcloseup.scenes import Scene
from jaxcloseup.splats.adaptive import AdaptiveConfig
from jaxcloseup.splats.field import SurfelConfig, camera_extent, surfel_field, surfel_optimizer
from jaxcloseup.splats.mcmc import McmcConfig
from jaxcloseup.splats.rasterize import RasterizeConfig
from jaxcloseup.splats.surfels import random_points
from jaxcloseup.train import TrainConfig
from jaxcloseup.volume.nerf import NerfConfig, nerf


FEWEST_POINTS = 100  # of a capture, to begin with these alone


@dataclasses.dataclass(frozen=True)
class Preset:
    """One experiment; plain numbers, so that it prints and serializes.

    Attributes:
      field: the network and its sampling, or the surfels and their training.
      train: what a step looks at.
      baseline_steps: stage 1, on photographs alone.
      closeup_steps: stage 2, with labels, and as many of its control without.
      learning_rate: Adam's for a NeRF, at the first step.
      decay_rate: factor on it over `decay_steps`, continued through both stages.
      decay_steps: see `decay_rate`.
      downscale: photographs are reduced by this factor.
      normalize: scale the scene to the unit cube around what the cameras look at.
      magnification: range of lambda.
      max_angle: epsilon, radians.
      anchor_tolerance: relative distance of anchors from the mean depth.
      rgb_tolerance: epsilon of the mask.
      depth_tolerance: relative agreement with the source view's depth.
      forward_label: colors from the forward warps.
      leave_out_source: labels are held against the other views alone.
      label_loss_weight: of the labels' loss in a step's, unless both are pooled.
      source_tolerance: relative agreement in depth of a wanted view with its source; inf: none.
      test_time_steps: in total for a NeRF, for each target view for surfels.
      gated: labels weigh what left-out photographs show that they deserve, which may be nothing.
    """

    field: NerfConfig | SurfelConfig = dataclasses.field(default_factory=NerfConfig)
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    baseline_steps: int = 200_000
    closeup_steps: int = 10_000
    learning_rate: float = 5e-4
    decay_rate: float = 0.1
    decay_steps: int = 250_000
    downscale: int = 1
    normalize: bool = False
    magnification: tuple[float, float] = (2.0, 8.0)
    max_angle: float = math.pi / 4
    anchor_tolerance: float = math.inf
    rgb_tolerance: float = 0.05
    depth_tolerance: float = math.inf
    forward_label: bool = False
    leave_out_source: bool = False
    label_loss_weight: float = 0.5
    source_tolerance: float = math.inf
    test_time_steps: int = 200
    gated: bool = False


PAPER = Preset()

RELEASED = dataclasses.replace(
    PAPER,
    train=TrainConfig(
        num_rays=1536,
        num_label_rays=563,
        perturbed_depth=True,
        undivided_depth=True,
        pooled_loss=True,
    ),
    magnification=(4.0, 4.0),
    anchor_tolerance=0.2,
    rgb_tolerance=0.1,
    depth_tolerance=0.05,
    forward_label=True,
)

# A short training leaves depth errors of several per cent, under which the paper's labels are worse
# than the model: only labels that the other views confirm closely are kept, at a pixel's weight.
QUICK = dataclasses.replace(
    PAPER,
    field=NerfConfig(
        depth=4, width=64, skip_after=2, direction_width=64, num_coarse=24, num_fine=24
    ),
    train=TrainConfig(num_rays=512, num_label_rays=512, pooled_loss=True),
    baseline_steps=1000,
    closeup_steps=200,
    learning_rate=5e-3,
    decay_steps=1600,
    downscale=8,
    normalize=True,
    rgb_tolerance=0.04,
    depth_tolerance=0.02,
    leave_out_source=True,
    source_tolerance=0.05,
)

WHOLE_IMAGES = TrainConfig(num_rays=None, num_label_rays=None)

PAPER_SURFELS = Preset(
    field=SurfelConfig(density=McmcConfig(stop=25_000)),
    train=WHOLE_IMAGES,
    baseline_steps=30_000,
    closeup_steps=500,
    test_time_steps=5,
)

QUICK_SURFELS = dataclasses.replace(
    PAPER_SURFELS,
    field=SurfelConfig(
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
    baseline_steps=2000,
    closeup_steps=200,
    downscale=8,
    magnification=(1.5, 3.0),
    leave_out_source=True,
    source_tolerance=0.05,
    label_loss_weight=0.05,
    gated=True,
)

# Instead of Monte Carlo moves; what it needs beside it is in `with_classic_density`.
# The quick training is too short for a reset of opacities.
CLASSIC_DENSITY = {
    "quick": AdaptiveConfig(start=200, stop=1200),
    "paper": AdaptiveConfig(),
}

PRESETS = {
    "nerf": {"quick": QUICK, "paper": PAPER, "released": RELEASED},
    "surfels": {"quick": QUICK_SURFELS, "paper": PAPER_SURFELS},
}


def with_classic_density(field: SurfelConfig, preset: str) -> SurfelConfig:
    """The field with clone, split and prune, which starts fainter and needs no pull to fade."""
    return dataclasses.replace(
        field,
        density=CLASSIC_DENSITY[preset],
        initial_opacity=0.1,
        opacity_weight=0.0,
        scale_weight=0.0,
    )


def make_field(preset: Preset, scene: Scene, *, growth: int = 1) -> RadianceField:
    """The preset's field for a scene; `growth` multiplies a rasterizer's capacity."""
    if isinstance(preset.field, SurfelConfig):
        raster, size = preset.field.raster, extent(scene)
        # In a small scene the near plane must not hide what close-ups are for.
        near = min(raster.near, 0.01 * size)
        raster = dataclasses.replace(raster, capacity=raster.capacity * growth, near=near)
        config = dataclasses.replace(preset.field, raster=raster)
        return surfel_field(config, extent=size)
    center, scale = (0.0, 0.0, 0.0), 1.0
    if preset.normalize:
        center, scale = unit_cube(scene)
    return nerf(preset.field, near=scene.near, far=scene.far, center=center, scale=scale)


def make_train_config(preset: Preset) -> TrainConfig:
    """What a step looks at, differentiated in the chunks that suit the network and the machine."""
    if isinstance(preset.field, SurfelConfig):
        return preset.train
    return dataclasses.replace(preset.train, gradient_chunk=preset.field.rays_at_once)


def make_optimizer(preset: Preset, scene: Scene) -> optax.GradientTransformation:
    """Adam: for a NeRF with exponentially decaying learning rate, for surfels with their own."""
    if isinstance(preset.field, SurfelConfig):
        return surfel_optimizer(preset.field, extent=extent(scene))
    schedule = optax.exponential_decay(preset.learning_rate, preset.decay_steps, preset.decay_rate)
    return optax.adam(schedule)


def initial_points(key: jax.Array, scene: Scene, count: int = 5000) -> tuple[Any, Any]:
    """Points `[P, 3]` and colors to start from: the capture's, and if few random, gray ones."""
    if len(scene.points) >= FEWEST_POINTS:
        return scene.points, scene.rgb
    points = random_points(key, scene.train.cameras, near=scene.near, far=scene.far, count=count)
    gray = jnp.full_like(points, 0.5)
    if not len(scene.points):
        return points, gray
    return np.concatenate([scene.points, points]), np.concatenate([scene.rgb, gray])


def extent(scene: Scene) -> float:
    """Size of a capture: the reach of its cameras, or half its depth if they stand in one place."""
    reach = float(camera_extent(scene.train.cameras))
    # Of equal positions the mean is another one, by rounding.
    return reach if reach > 1e-4 * scene.far else 0.5 * scene.far


def unit_cube(scene: Scene) -> tuple[tuple[float, float, float], float]:
    """Center and scale that bring the cameras and most of what they see into [-1, 1]."""
    positions = np.asarray(scene.train.cameras.position)
    forward = np.asarray(scene.train.cameras.rotation)[..., 2]
    middle = positions + 0.5 * (scene.near + scene.far) * forward
    seen = scene.points if len(scene.points) else middle
    both = np.concatenate([positions, np.percentile(seen, [5, 95], axis=0)])
    low, high = both.min(axis=0), both.max(axis=0)
    return tuple(((low + high) / 2).tolist()), float(2 / (high - low).max())


def test_time_steps(preset: Preset, count: int) -> int:
    """Steps in all for `count` wanted views: surfels take the preset's for each of them."""
    whole_images = isinstance(preset.field, SurfelConfig)
    return preset.test_time_steps * (count if whole_images else 1)


def pseudo_settings(preset: Preset) -> PseudoSettings:
    """The preset's traced settings."""
    return PseudoSettings(
        pose=PoseSettings(
            magnification=jnp.array(preset.magnification),
            max_angle=jnp.float32(preset.max_angle),
            anchor_tolerance=jnp.float32(preset.anchor_tolerance),
        ),
        use_mask=jnp.float32(1),
        rgb_tolerance=jnp.float32(preset.rgb_tolerance),
        depth_tolerance=jnp.float32(preset.depth_tolerance),
        fixed_anchors=jnp.float32(0),
        forward_label=jnp.float32(preset.forward_label),
        leave_out_source=jnp.float32(preset.leave_out_source),
        label_loss_weight=jnp.float32(preset.label_loss_weight),
        source_tolerance=jnp.float32(preset.source_tolerance),
    )
