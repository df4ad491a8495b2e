"""Surfels (2D Gaussian splatting): presets, field, optimizer and exports."""

import dataclasses
import functools
import math
import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxcloseup.app import progress
from jaxcloseup.app.methods.method import (
    CoarseConfig,
    LabelConfig,
    Method,
    Preset,
    TargetConfig,
    WindowConfig,
)
from jaxcloseup.artifacts.surfel_ply import write_surfels
from jaxcloseup.artifacts.viewer_gaussians import as_gaussians
from jaxcloseup.fields.contract import RadianceField, Rendering
from jaxcloseup.fields.splats.config import (
    AdaptiveConfig,
    McmcConfig,
    RasterizeConfig,
    SurfelConfig,
)
from jaxcloseup.fields.splats.control import replace_surfels
from jaxcloseup.fields.splats.filters import sampling_intervals, smoothed
from jaxcloseup.fields.splats.refinement import join_surfels, replace_least, surfels_where_wrong
from jaxcloseup.fields.splats.splat_field import (
    SurfelBuffers,
    camera_extent,
    surfel_field,
    surfel_optimizer,
    with_expected_depth,
)
from jaxcloseup.fields.splats.surfels import Surfels, pad_rows
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views, camera_at, to_float
from jaxcloseup.setting import setting
from jaxcloseup.training.config import TrainConfig
from jaxcloseup.training.steps import TrainState


@dataclasses.dataclass(frozen=True)
class SplatTraining:
    """What experiments add to the configuration of surfels, and of volumetric Gaussians."""

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


_REPLACED = 0.2  # share of all splats that target views may replace
_REFINED_AT = 4  # times the photographs' training size, at which new surfels are looked for
WHOLE_IMAGES = TrainConfig(num_rays=None, num_label_rays=None)

PAPER = Preset(
    method="surfels",
    field=SurfelTrainingConfig(density=McmcConfig(stop=25_000)),
    train=WHOLE_IMAGES,
    labels=LabelConfig(),
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
QUICK = dataclasses.replace(
    REDUCED,
    field=dataclasses.replace(
        REDUCED.field,
        capacity=60_000,
        sh_every=1,
        regularize_from=1,
        means_lr=(4e-4, 1.6e-5),
        means_lr_steps=2400,
        sh_lr=7.5e-3,
        scale_lr=1.5e-2,
        color_ridge=0.1,
        max_scale=0.1,
        selective_adam=True,
        steps_per_target=20,
        fewest_target_steps=40,
        surfels_per_target=1000,
        density=McmcConfig(start=0, stop=700, growth=1.0, noise=0.0),
        raster=RasterizeConfig(capacity=2**17, antialias=True),
    ),
    coarse=CoarseConfig(
        field=dataclasses.replace(
            REDUCED.field,
            means_lr_steps=1500,
            raster=dataclasses.replace(REDUCED.field.raster, antialias=True),
        ),
        steps=1500,
    ),
    windows=WindowConfig(),
    targets=TargetConfig("residual", label_loss_weight=0.7, lr_scale=10.0, control_lr_scale=2.0),
    score_downscale=4,
    baseline_steps=2500,
)


# The same with windows twice as wide and high, twice the surfels, and as many steps.
STANDARD = dataclasses.replace(
    QUICK,
    field=dataclasses.replace(
        QUICK.field,
        capacity=120_000,
        raster=dataclasses.replace(QUICK.field.raster, capacity=2**18, block=128),
    ),
    coarse=dataclasses.replace(
        QUICK.coarse,
        field=dataclasses.replace(
            QUICK.coarse.field,
            capacity=20_000,
            raster=dataclasses.replace(QUICK.coarse.field.raster, capacity=2**17, block=128),
        ),
    ),
    downscale=4,
    score_downscale=2,
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
QUICK_ADAPTIVE = with_adaptive_density(REDUCED, AdaptiveConfig(start=200, stop=1200))
PAPER_ADAPTIVE = with_adaptive_density(PAPER, AdaptiveConfig())


def make_field(config: SplatTraining, scene: Scene, growth: int) -> RadianceField:
    """Splats sized for a scene; `growth` multiplies the rasterizer's capacity."""
    size, capacity = extent(scene), config.raster.capacity * growth
    raster = dataclasses.replace(config.raster, capacity=capacity, near=_near(config, scene))
    config = dataclasses.replace(config, raster=raster)
    center = jnp.mean(jnp.asarray(scene.train.cameras.position), axis=0)
    return surfel_field(config, extent=size, center=center, photographs=_photographs(config, scene))


def _near(config, scene):
    """The near plane, which in a small scene must not hide what close-ups are for."""
    return min(config.raster.near, 0.01 * extent(scene))


def _photographs(config, scene):
    """Cameras of the photographs whose pixels bound how small splats are; None without a bound."""
    if config.smoothed_at is None:
        return None
    cameras = scene.train.cameras
    times = max(1, scene.metadata.get("downscale", 1) / config.smoothed_at)
    return cameras.replace(
        intrinsics=cameras.intrinsics * times,
        height=round(cameras.height * times),
        width=round(cameras.width * times),
    )


def make_optimizer(config: SplatTraining, scene: Scene) -> optax.GradientTransformation:
    """Adam with a learning rate for each kind of parameter."""
    return surfel_optimizer(config, extent=extent(scene))


def extent(scene: Scene) -> float:
    """Size of a capture: the reach of its cameras, or half its depth if they stand in one place."""
    reach = float(camera_extent(scene.train.cameras))
    # Rounding gives identical cameras a tiny extent.
    return reach if reach > 1e-4 * scene.far else 0.5 * scene.far


def export(folder: pathlib.Path, stage: str, surfels: Surfels, buffers: SurfelBuffers) -> None:
    """Write `splats/<stage>.ply`, for viewers of Gaussian splats."""
    surfels = smoothed(surfels, buffers.interval)
    write_surfels(folder / "splats" / f"{stage}.ply", surfels, buffers.alive)


def refine(
    key: jax.Array,
    config: SplatTraining,
    surfels: Surfels,
    buffers: SurfelBuffers,
    render: Callable[[Surfels, SurfelBuffers, Camera], Rendering],
    scene: Scene,
    pyramid: Pyramid,
) -> tuple[Surfels, SurfelBuffers]:
    """Fill the rows that `config` has beyond `surfels` where photographs show more than these."""
    views, cameras = pyramid.values.shape[0], scene.train.cameras
    level = pyramid.level_near(_REFINED_AT * cameras.width)
    free = config.capacity - int(buffers.alive.sum())
    each = min(max(0, free) // views, math.prod(pyramid.sizes[level]))
    kind = {"sh_degree": config.sh_degree, "num_scales": config.num_scales}
    # With all rows, so that what is compiled here is what renders the field later.
    shown = _with_rows((surfels, buffers), config.capacity)

    def search(view):
        camera = pyramid.camera(camera_at(cameras, view), view, level)
        photograph, seen = to_float(pyramid.image(view, level)), render(*shown, camera)
        data = photograph[..., :3], photograph[..., 3], seen.rgb, label_depth(seen)
        return _sample(jax.random.fold_in(key, view), camera, *data, count=each, **kind)

    new = _search_each(search, views, "photographs searched")
    # The filter of finer photographs is smaller, so what the coarse one made stays as it is.
    old = smoothed(surfels, buffers.interval), buffers.alive
    surfels, alive = join_surfels(old, new, config.capacity)
    return surfels, buffers.replace(alive=alive, interval=_intervals(config, surfels, scene))


def _intervals(config, surfels, scene):
    """Intervals of the smoothing filter, or None without it."""
    photographs = _photographs(config, scene)
    if photographs is None:
        return None
    return sampling_intervals(surfels.means, photographs, near=_near(config, scene))


def add_for_targets(
    key: jax.Array,
    config: SplatTraining,
    state: TrainState,
    labels: Views,
    render: Callable[[Camera], Rendering],
    scene: Scene,
) -> TrainState:
    """Put splats where labels of target views show more, in place of those that show least."""
    count, height, width = labels.weight.shape
    room = int(_REPLACED * config.capacity) // count
    each = min(config.surfels_per_target, room, height * width)
    if each == 0:
        return state

    def search(view):
        camera = camera_at(labels.cameras, view)
        seen = render(camera)
        data = labels.rgb[view], labels.weight[view], seen.rgb, label_depth(seen)
        return _sample(
            *(jax.random.fold_in(key, view), camera, *data),
            **{"count": each, "sh_degree": config.sh_degree, "num_scales": config.num_scales},
        )

    new, found = _search_each(search, count, "views searched for more")
    old = state.params, state.buffers.alive
    surfels, alive, changed = replace_least(*old, _in_kind(new, state.params), found)
    state = replace_surfels(state, surfels, alive, changed)
    interval = _intervals(config, surfels, scene)
    return state.replace(buffers=state.buffers.replace(interval=interval))


def _search_each(search, count, what):
    """What `search(view)` finds in every view, rows of all together."""
    found = progress.each(search, range(count), what)
    return jax.tree.map(lambda *rows: np.concatenate(rows), *found)


def _in_kind(new, surfels):
    """New surfels with the parameters, 0, that a density control gave the others."""
    own = vars(new)
    added = {k: v for k, v in vars(surfels).items() if k not in own}
    zeros = {k: np.zeros((len(new.means), *v.shape[1:]), v.dtype) for k, v in added.items()}
    return surfels.replace(**own, **zeros)


_sample = jax.jit(surfels_where_wrong, static_argnames=("count", "sh_degree", "num_scales"))


@functools.partial(jax.jit, static_argnames="rows")
def _with_rows(tree, rows):
    return jax.tree.map(lambda leaf: pad_rows(leaf, rows) if leaf.ndim else leaf, tree)


METHOD = Method(
    presets={
        "quick": QUICK,
        "standard": STANDARD,
        "paper": PAPER,
        "reduced": REDUCED,
        "quick_adaptive": QUICK_ADAPTIVE,
        "paper_adaptive": PAPER_ADAPTIVE,
    },
    make_field=make_field,
    make_optimizer=make_optimizer,
    renders_pixels=False,
    target_steps=lambda config, count: max(
        config.steps_per_target * count, config.fewest_target_steps
    ),
    max_points=lambda config: config.capacity,
    with_expected_depth=with_expected_depth,
    export=export,
    gaussians=lambda surfels, buffers, position: as_gaussians(
        smoothed(surfels, buffers.interval), buffers.alive, position
    ),
    background=lambda config: config.background or 0.0,
    refine=refine,
    add_for_targets=add_for_targets,
)
