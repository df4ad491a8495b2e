"""Estimate depth and normal maps of photographs from the photographs alone."""

import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, mean_focal, pixel_grid
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.photos.views import Views, camera_at, to_float
from jaxcloseup.stereo.config import StereoConfig
from jaxcloseup.stereo.consistency import count_consistent
from jaxcloseup.stereo.matching import Photographs, match_planes, pack_photographs
from jaxcloseup.stereo.patchmatch import Matched, enlarge_planes, refine_planes, sweep_planes
from jaxcloseup.stereo.planes import plane_normals


_LUMA = 0.299, 0.587, 0.114  # of ITU-R BT.601
_PARALLAX = 0.2  # radians between the rays of useful neighbors, of which first steps make a pixel


class StereoMaps(NamedTuple):
    """Depth and normals of V photographs.

    Attributes:
      depth: `[V, H, W]` z-depth in world units; 0 where undefined.
      normal: `[V, H, W, 3]` unit world normals facing the camera; 0 where undefined.
      confidence: `[V, H, W]` in [0, 1], 0 where too few other photographs confirm the depth: how
        well patches match, times 1 - 1 / (1 + confirmations).
    """

    depth: jax.Array
    normal: jax.Array
    confidence: jax.Array


def estimate_depths(
    key: jax.Array,
    views: Views,
    neighbors: jax.Array,
    near: jax.Array | float,
    far: jax.Array | float,
    config: StereoConfig,
) -> StereoMaps:
    """Estimate depth, normal and confidence of every photograph by multi-view stereo.

    Everything is traced: `jax.jit` compiles one program for all photographs. On a CPU, patches are
    matched in the native library where it is there. The same key gives the same bits.

    Args:
      key: consumed.
      views: photographs with poses.
      neighbors: `[V, N]` int32, what each is matched with, see `choose_neighbors`.
      near: `[]` or `[V]` smallest z-depth, world units.
      far: `[]` or `[V]` largest z-depth.
      config: see there.

    Returns:
      `StereoMaps` of all photographs; where confidence is 0, depth is a guess or undefined.

    Raises:
      ValueError: `config.iterations` has fewer numbers than there are levels.
    """
    chex.assert_rank([views.rgb, neighbors], [4, 2])
    if len(config.iterations) < config.levels:
        raise ValueError(
            f"iterations has {len(config.iterations)} numbers, and levels is {config.levels}: "
            "each level needs one"
        )
    count = len(views)
    near, far = (jnp.broadcast_to(jnp.asarray(z, jnp.float32), (count,)) for z in (near, far))
    levels = make_levels(views, config)
    planes = None
    for level, photographs in reversed([*enumerate(levels)]):
        match = functools.partial(_match_level, photographs, config, level)
        keys = jax.random.split(jax.random.fold_in(key, level), count)
        matched = jax.lax.map(match, _Item(keys, jnp.arange(count), neighbors, near, far, planes))
        planes = matched.planes
    return join_maps(levels[0], matched, neighbors, config)


def make_levels(views: Views, config: StereoConfig) -> list[Photographs]:
    """Return grays of photographs at `config.levels` sizes, from fine to coarse."""
    gray = 255 * jnp.tensordot(to_float(views.rgb), jnp.array(_LUMA), axes=1)
    weight, cameras, levels = views.weight.astype(jnp.float32), views.cameras, []
    for _ in range(config.levels):
        levels.append(pack_photographs(cameras, gray, weight))
        count, height, width = gray.shape
        half = (count, (height + 1) // 2, (width + 1) // 2)
        ratio = jnp.array([half[2] / width, half[1] / height] * 2)
        cameras = Camera(cameras.camtoworld, cameras.intrinsics * ratio[None], *half[1:])
        gray = jax.image.resize(gray, half, "linear")
        weight = (jax.image.resize(weight, half, "linear") > 0.5).astype(jnp.float32)
    return levels


class _Item(NamedTuple):
    """What is different for each photograph; `planes` are those of the next coarser size."""

    key: jax.Array
    reference: jax.Array
    neighbors: jax.Array
    near: jax.Array
    far: jax.Array
    planes: jax.Array | None


def _match_level(
    photographs: Photographs, config: StereoConfig, level: int, item: _Item
) -> Matched:
    """Return the best planes of one photograph at one size."""
    key, reference, neighbors, near, far, planes = item
    height, width = photographs.quads.shape[1:]
    if planes is None:
        matched = sweep_planes(photographs, reference, neighbors, near, far, config)
    else:
        planes = enlarge_planes(planes, height, width)
        matched = Matched(
            planes, match_planes(photographs, reference, neighbors, planes[None], config)[0]
        )
    focal = mean_focal(camera_at(photographs.cameras, reference).intrinsics)

    def take_round(matched: Matched, index: jax.Array) -> tuple[Matched, None]:
        scale = jnp.exp2(-index.astype(jnp.float32)) / (_PARALLAX * focal)
        own = jax.random.fold_in(key, index)
        return refine_planes(own, photographs, reference, neighbors, matched, scale, config), None

    return jax.lax.scan(take_round, matched, jnp.arange(config.iterations[level]))[0]


def join_maps(
    photographs: Photographs, matched: Matched, neighbors: jax.Array, config: StereoConfig
) -> StereoMaps:
    """Return maps of planes `[V, 3, H, W]`, confident where neighbors confirm them."""
    cameras = photographs.cameras
    usable = (matched.cost < config.max_cost) & (photographs.weight > 0)
    planes = jnp.where(usable[:, None], matched.planes, 0)

    def join(item: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array, jax.Array]:
        reference, own, cost = item
        camera = camera_at(cameras, reference)
        found = count_consistent(cameras, planes, reference, own, config)
        confirmed = found.count >= config.confirmations
        share = 1 - 1 / (1 + found.count.astype(cost.dtype))
        confidence = jnp.where(confirmed, (1 - cost) * share, 0)
        plane = planes[reference].at[0].set(found.inverse_depth)
        normal = plane_normals(camera, pixel_grid(camera.height, camera.width), plane)
        return safe_divide(jnp.ones_like(cost), plane[0]), normal, confidence

    return StereoMaps(*jax.lax.map(join, (jnp.arange(len(neighbors)), neighbors, matched.cost)))
