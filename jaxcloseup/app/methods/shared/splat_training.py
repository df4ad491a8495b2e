"""Fields, optimizers and refinement of surfels and volumetric Gaussians."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxcloseup.app import progress
from jaxcloseup.app.methods.gaussians import GaussianTrainingConfig
from jaxcloseup.app.methods.surfels import SurfelTrainingConfig
from jaxcloseup.fields.contract import RadianceField, Rendering
from jaxcloseup.fields.splats.config import RasterizeConfig
from jaxcloseup.fields.splats.control import replace_surfels
from jaxcloseup.fields.splats.filters import sampling_intervals, smoothed
from jaxcloseup.fields.splats.raster_plan import plan_raster
from jaxcloseup.fields.splats.refinement import join_surfels, replace_least, surfels_where_wrong
from jaxcloseup.fields.splats.splat_field import (
    SurfelBuffers,
    camera_extent,
    depth_hold,
    surfel_field,
    with_expected_depth,
)
from jaxcloseup.fields.splats.splat_optimizer import surfel_optimizer
from jaxcloseup.fields.splats.surfels import Surfels, pad_rows
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.native import library
from jaxcloseup.photos.depth_maps import GatherSources, read_depths
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views, camera_at, to_float
from jaxcloseup.training.state import TrainState


SplatTrainingConfig = SurfelTrainingConfig | GaussianTrainingConfig
_REPLACED = 0.2  # share of all splats that target views may replace
# Pixels of a photograph for each new surfel: photographs show the same surface several times, and
# more surfels than they resolve learn each photograph by heart, more slowly.
_PIXELS = 12
_REFINED_AT = 8  # times the photographs' training size, at which new surfels are looked for


def make_field(config: SplatTrainingConfig, scene: Scene, growth: int) -> RadianceField:
    """Return splats sized for a scene; `growth` multiplies the rasterizer's capacity.

    Raises:
      LibraryError: the native compositor is asked for, and missing.
    """
    size, capacity = extent(scene), config.raster.capacity * growth
    raster = dataclasses.replace(
        config.raster,
        capacity=capacity,
        near=_near(config, scene),
        platform=config.raster.platform or jax.default_backend(),
    )
    _check_compositor(raster)
    config = dataclasses.replace(config, raster=raster)
    center = jnp.mean(jnp.asarray(scene.train.cameras.position), axis=0)
    return surfel_field(config, extent=size, center=center, photographs=_photographs(config, scene))


def _check_compositor(raster: RasterizeConfig) -> None:
    """Raise or say what keeps the fastest compositor from running, before anything is compiled."""
    if raster.compositor == "auto" and raster.platform != "cpu":
        return  # a GPU says it when it compiles kernels
    plan = plan_raster(raster, height=1, width=1)
    if (raster.compositor, plan.compositor) == ("auto", "loops"):
        _say_that_it_is_slow()


@functools.cache
def _say_that_it_is_slow() -> None:
    """Print one line, once in a program, about the missing native library."""
    print(f"{library.missing()}, so splats are several times slower: {library.INSTALL}")


def _near(config: SplatTrainingConfig, scene: Scene) -> float:
    """Return the near plane; in a small scene it must not cut off what close-ups show."""
    return min(config.raster.near, 0.01 * extent(scene))


def _photographs(config: SplatTrainingConfig, scene: Scene) -> Camera | None:
    """Return the cameras whose pixels bound how small splats are; None without a bound."""
    if config.smoothed_at is None:
        return None
    cameras = scene.train.cameras
    times = max(1, scene.metadata.get("downscale", 1) / config.smoothed_at)
    return cameras.replace(
        intrinsics=cameras.intrinsics * times,
        height=round(cameras.height * times),
        width=round(cameras.width * times),
    )


def make_optimizer(config: SplatTrainingConfig, scene: Scene) -> optax.GradientTransformation:
    """Return Adam with a learning rate for each kind of parameter."""
    return surfel_optimizer(config, extent=extent(scene))


def extent(scene: Scene) -> float:
    """Return a capture's size: its cameras' reach, or half its depth if they stand in one place."""
    reach = float(camera_extent(scene.train.cameras))
    # Rounding gives identical cameras a tiny extent.
    return reach if reach > 1e-4 * scene.far else 0.5 * scene.far


def splats(surfels: Surfels, buffers: SurfelBuffers) -> tuple[Surfels, jax.Array]:
    """Return what other programs draw, and which of it is alive, `[N]` bool."""
    return smoothed(surfels, buffers.interval), buffers.alive


def refine(
    key: jax.Array,
    config: SplatTrainingConfig,
    surfels: Surfels,
    buffers: SurfelBuffers,
    render: Callable[[Surfels, SurfelBuffers, Camera], Rendering],
    scene: Scene,
    pyramid: Pyramid,
    depths: GatherSources | None = None,
) -> tuple[Surfels, SurfelBuffers]:
    """Fill the rows that `config` has beyond `surfels` where photographs show more than these.

    Small photographs fill only as many as they resolve. New surfels lie at the depths that were
    measured, and elsewhere at those that are rendered.
    """
    surfels = surfels.replace(sh=_of_degree(surfels.sh, config.sh_degree))
    views, cameras = len(pyramid), scene.train.cameras
    level = pyramid.level_near(_REFINED_AT * cameras.width)
    free = config.capacity - int(buffers.alive.sum())
    smallest, finest = np.asarray(pyramid.extents)[:, (level, 0)].prod(-1).min(0).tolist()
    each = min(max(0, free) // views, smallest, finest // _PIXELS)
    sample = _sampler(config, each)
    # With all rows, so that what is compiled here is what renders the field later.
    padded, padded_buffers = _with_rows((surfels, buffers), config.capacity)

    def search(view: int) -> Any:
        camera = pyramid.camera(camera_at(cameras, view), view, level)
        photograph = to_float(pyramid.image(view, level))
        seen = render(padded, padded_buffers, camera)
        depth = label_depth(seen)
        if depths is not None:
            known = read_depths(depths, view, camera).depth
            depth = jnp.where(known > 0, known, depth)
        return sample(
            jax.random.fold_in(key, view),
            camera,
            photograph[..., :3],
            photograph[..., 3],
            seen.rgb,
            depth,
        )

    new = _search_each(search, views, "photographs searched")
    # The filter of finer photographs is smaller, so what the coarse one made stays as it is.
    old = smoothed(surfels, buffers.interval), buffers.alive
    surfels, alive = _join(old, new, capacity=config.capacity)
    interval = _intervals(config, surfels, scene)
    hold = depth_hold(config, jnp.int32(0))
    buffers = buffers.replace(alive=alive, interval=interval, hold=hold)
    return surfels, with_expected_depth(buffers, config.depth == "expected")


def _of_degree(sh: jax.Array, degree: int) -> jax.Array:
    """Return harmonics `[N, (degree + 1)^2, 3]`: too many are cut, and new ones are 0."""
    count = (degree + 1) ** 2
    return jnp.pad(sh[:, :count], ((0, 0), (0, max(0, count - sh.shape[1])), (0, 0)))


def _intervals(config: SplatTrainingConfig, surfels: Surfels, scene: Scene) -> jax.Array | None:
    """Return the intervals of the smoothing filter, or None without it."""
    photographs = _photographs(config, scene)
    if photographs is None:
        return None
    return sampling_intervals(surfels.means, photographs, near=_near(config, scene))


def add_for_targets(
    key: jax.Array,
    config: SplatTrainingConfig,
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
    sample = _sampler(config, each)

    def search(view: int) -> Any:
        camera = camera_at(labels.cameras, view)
        seen = render(camera)
        return sample(
            jax.random.fold_in(key, view),
            camera,
            labels.rgb[view],
            labels.weight[view],
            seen.rgb,
            label_depth(seen),
        )

    new, found = _search_each(search, count, "views searched for more")
    old = state.params, state.buffers.alive
    surfels, alive, changed = _replace_least(*old, _in_kind(new, state.params), found)
    state = replace_surfels(state, surfels, alive, changed)
    interval = _intervals(config, surfels, scene)
    buffers = state.buffers.replace(interval=interval)
    return dataclasses.replace(state, buffers=buffers)


def _search_each(search: Callable[[int], Any], count: int, what: str) -> Any:
    """Return the rows that `search(view)` finds in every view, all together."""
    found = progress.each(search, range(count), what)
    return jax.tree.map(lambda *rows: np.concatenate(rows), *found)


def _in_kind(new: Surfels, surfels: Surfels) -> Surfels:
    """Return new surfels with the further parameters, 0, that a density control gave the others."""
    values = vars(new)
    added = {k: v for k, v in vars(surfels).items() if k not in values}
    zeros = {k: np.zeros((len(new.means), *v.shape[1:]), v.dtype) for k, v in added.items()}
    return surfels.replace(**values, **zeros)


def _sampler(config: SplatTrainingConfig, count: int) -> Callable[..., Any]:
    """Return `surfels_where_wrong` for `count` splats of the field's kind."""
    return functools.partial(
        _sample, count=count, sh_degree=config.sh_degree, num_scales=config.num_scales
    )


_sample = jax.jit(surfels_where_wrong, static_argnames=("count", "sh_degree", "num_scales"))
_join = jax.jit(join_surfels, static_argnames="capacity")
_replace_least = jax.jit(replace_least)


@functools.partial(jax.jit, static_argnames="rows")
def _with_rows(tree: Any, rows: int) -> Any:
    return jax.tree.map(lambda leaf: pad_rows(leaf, rows) if leaf.ndim else leaf, tree)
