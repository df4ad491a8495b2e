"""Gather: what photographs that see the points of a view show there, read at the view's detail.

Any field and any values: colors make a view from photographs alone, residuals (photograph minus
render) show what the photographs know beyond a model.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.geometry.cameras import Camera, mean_focal, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.numerics import matmul, safe_divide, safe_norm
from jaxcloseup.geometry.visibility import sphere_in_view
from jaxcloseup.geometry.warp import backward_warp
from jaxcloseup.photos.pyramids import Pyramid, fractional_level, read_pyramid
from jaxcloseup.photos.views import camera_at


_CHUNK = 2048  # points that are culled together; a window that teaches weights fits
_CHUNKS = 16  # chunks for which one program is compiled, to serve images of many sizes
_WIDEST = 20  # angles in units of `angle_scale`, beyond which all weigh alike
_COARSEST = 64  # footprints beyond which all weigh alike


@struct.dataclass
class GatherSources:
    """Depth maps that confirm what photographs see, V views.

    Attributes:
      cameras: stacked cameras of the depth maps.
      inverse_depth: `[V, H, W]` 1 / z-depth, 0 where undefined.
      trust: `[V, H, W]` in [0, 1], 0 where the photograph does not count or its depth has an edge.
    """

    cameras: Camera
    inverse_depth: jax.Array
    trust: jax.Array


class GatherSettings(NamedTuple):
    """How photographs are weighed.

    Attributes:
      tolerance: relative difference of depths at which a photograph no longer sees a point.
      angle_scale: angle in radians between two rays at which a photograph's weight falls to 1 / e.
      finer: levels by which values are read finer than the view's pixels: interpolation blurs.
      robust: 0 averages all alike; at 1, a photograph that differs from the others by their
        standard deviation has a quarter of its weight.
    """

    tolerance: float = 0.08
    angle_scale: float = 0.05
    finer: float = 0.3
    robust: float = 0.0


DEFAULT = GatherSettings()


class Gathered(NamedTuple):
    """What the photographs show at points `[...]`; 0 where none sees a point.

    Attributes:
      mean: `[..., C]` weighted mean of the values.
      weight: `[...]` sum of the weights.
      variance: `[...]` weighted variance between the photographs, the mean over channels.
      count: `[...]` number of photographs that see the point, each counted in [0, 1] by how surely.
      footprint: `[...]` side of the finest pixel on the surface, in pixels of the view; infinity
        where no photograph sees the point.
      detail: `[...]` weighted mean of -log2 of all these photographs' footprints.
      angle: `[...]` weighted mean of the angle between the rays, radians.
    """

    mean: jax.Array
    weight: jax.Array
    variance: jax.Array
    count: jax.Array
    footprint: jax.Array
    detail: jax.Array
    angle: jax.Array


def gather_sources(
    cameras: Camera, depths: jax.Array, weight: jax.Array, *, edge: float = 0.2
) -> GatherSources:
    """Prepare depth maps for `gather`, once for many views.

    Inverse depth is linear over a plane, so its second difference, relative to the inverse depth
    itself, shows the edges of a depth map and nothing else.

    Args:
      cameras: stacked cameras of the depth maps.
      depths: `[V, H, W]` z-depths; 0 is undefined.
      weight: `[V, H, W]` weights of the photographs in [0, 1].
      edge: relative second difference at which a pixel, and its neighbors, have 1 / 4 of their
        trust.
    """
    chex.assert_equal_shape([depths, weight])
    inverse = safe_divide(jnp.ones_like(depths), depths)
    bend = jnp.zeros_like(inverse)
    for axis in (1, 2):
        size = inverse.shape[axis]
        if size > 2:
            before, here, after = (
                jax.lax.slice_in_dim(inverse, start, start + size - 2, axis=axis)
                for start in (0, 1, 2)
            )
            inner = tuple(slice(1, -1) if i == axis else slice(None) for i in range(3))
            bend = bend.at[inner].max(jnp.abs(before + after - 2 * here))
    trust = weight / (1 + (safe_divide(bend, inverse) / edge) ** 2) ** 2
    trust = jnp.where(depths > 0, trust, 0)
    trust = jax.lax.reduce_window(trust, jnp.inf, jax.lax.min, (1, 3, 3), (1, 1, 1), "SAME")
    return GatherSources(cameras, inverse, trust)


def gather(
    camera: Camera,
    pixels: jax.Array,
    depth: jax.Array,
    sources: GatherSources,
    pyramid: Pyramid,
    settings: GatherSettings = DEFAULT,
    *,
    exclude: jax.Array | int = -1,
    finest: jax.Array | int = 0,
) -> Gathered:
    """Average what the photographs show at the surface of a view.

    A photograph sees a point where its own depth map, interpolated, confirms the point's z-depth,
    away from the map's edges. Its value is read bilinearly from the two levels of the pyramid whose
    pixels on the surface are next in size to the view's. Its weight is exp(-angle / angle_scale),
    divided by the square of the footprint of its finest pixel where that is above 1.

    Args:
      camera: camera of the view.
      pixels: `[..., 2]` pixel centers of the view.
      depth: `[...]` their z-depth; 0 is undefined.
      sources: depth maps of the photographs.
      pyramid: values of the same photographs.
      settings: see there.
      exclude: index of a photograph to leave out; -1 leaves out none.
      finest: the first level to read, as if there were no finer one.

    Returns:
      `Gathered` of the pixels `[...]`. `mean` is differentiable in float values and in `depth`,
      which no photograph's choice of level or of photographs makes discontinuous.
    """
    return gather_parts(
        camera, pixels, depth, sources, pyramid, (settings,), exclude=exclude, finest=finest
    )[0]


def gather_parts(
    camera: Camera,
    pixels: jax.Array,
    depth: jax.Array,
    sources: GatherSources,
    pyramid: Pyramid,
    settings: Sequence[GatherSettings],
    *,
    exclude: jax.Array | int = -1,
    finest: jax.Array | int = 0,
) -> tuple[Gathered, ...]:
    """Gather equal parts of a pyramid's channels, each by settings of its own, in one visit.

    Outside `jax.jit`, views of all sizes share what takes long to compile.

    Args:
      camera: camera of the view.
      pixels: `[..., 2]` pixel centers of the view.
      depth: `[...]` their z-depth; 0 is undefined.
      sources: depth maps of the photographs.
      pyramid: values of the same photographs, one part of their channels after the other.
      settings: of each part.
      exclude: index of a photograph to leave out; -1 leaves out none.
      finest: the first level to read, as if there were no finer one.

    Returns:
      `Gathered` of the pixels `[...]` for each part, as from `gather`.
    """
    chex.assert_equal_shape_prefix([pixels, depth], depth.ndim)
    if pyramid.values.shape[-1] % len(settings):
        raise ValueError(
            f"{pyramid.values.shape[-1]} channels are not {len(settings)} parts of one size"
        )
    view, level = (jnp.asarray(index, jnp.int32) for index in (exclude, finest))
    reader = camera.position, sources, pyramid, level
    # Blocks of one size share a program; in a trace, each would be a copy of it.
    traced = any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((camera, pixels, depth)))
    found = [
        _gather_chunks(points, side, reader, view, settings=tuple(settings))
        for points, side in _surface(camera, pixels, depth, whole=traced)
    ]
    return _as_images(found, shape=depth.shape)


@functools.partial(jax.jit, static_argnames="whole")
def _surface(camera, pixels, depth, *, whole):
    """Points `[K, N, 3]` of a view in chunks, and sides `[K, N]` of its pixels there, in blocks.

    The side is 0 where depth is undefined, and behind the last pixel. `whole` makes one block.
    """
    defined = (depth > 0) & jnp.isfinite(depth)
    points = pixels_to_points(camera, pixels, jnp.where(defined, depth, 1)).reshape(-1, 3)
    side = jnp.where(defined, depth, 0).reshape(-1) / mean_focal(camera.intrinsics)
    pad = -side.size % (_CHUNKS * _CHUNK)
    points = jnp.pad(points, ((0, pad), (0, 0))).reshape(-1, _CHUNK, 3)
    side = jnp.pad(side, (0, pad)).reshape(-1, _CHUNK)
    blocks = 1 if whole else max(1, len(side) // _CHUNKS)
    return list(zip(jnp.split(points, blocks), jnp.split(side, blocks), strict=True))


@functools.partial(jax.jit, static_argnames="settings")
def _gather_chunks(points, side, reader, exclude, *, settings):
    """`Gathered` of points in chunks, for each of the settings."""
    position, sources, pyramid, finest = reader
    reader = _Reader(position, sources, pyramid, settings, finest)

    def gather_chunk(chunk):
        gather = functools.partial(_gather_chunk, *chunk, reader, exclude)

        def nothing():
            zeros = jax.tree.map(jnp.zeros_like, jax.eval_shape(gather))
            return tuple(one._replace(footprint=one.footprint + jnp.inf) for one in zeros)

        return jax.lax.cond(jnp.any(chunk[1] > 0), gather, nothing)

    return jax.lax.map(gather_chunk, (points, side))


@functools.partial(jax.jit, static_argnames="shape")
def _as_images(found, *, shape):
    """What was found at points in blocks of chunks, as images of a shape."""

    def one(*blocks):
        array = jnp.concatenate(blocks)
        array = array.reshape(-1, *array.shape[2:])[: math.prod(shape)]
        return array.reshape(*shape, *array.shape[1:])

    return jax.tree.map(one, *found)


class _Reader(NamedTuple):
    """What reading one photograph needs."""

    position: jax.Array
    sources: GatherSources
    pyramid: Pyramid
    settings: tuple[GatherSettings, ...]
    finest: jax.Array | int


class _Sums(NamedTuple):
    weight: jax.Array
    values: jax.Array
    squares: jax.Array
    count: jax.Array
    footprint: jax.Array
    detail: jax.Array
    angle: jax.Array


def _gather_chunk(points, side, reader, exclude):
    """`Gathered` of points `[N, 3]` that are visited together; `side` 0 marks undefined ones."""
    views = jnp.arange(reader.sources.trust.shape[0])
    may_see = jax.vmap(lambda camera: _may_see(camera, points, side))(reader.sources.cameras)
    may_see &= views != exclude
    channels = reader.pyramid.values.shape[-1] // len(reader.settings)

    def sums(references):
        def add(so_far, item):
            view, visible = item
            return jax.lax.cond(
                visible,
                lambda: _add_view(so_far, points, side, view, reader, references),
                lambda: so_far,
            ), None

        none = jnp.zeros(side.shape, points.dtype)
        zero = jnp.zeros((*side.shape, channels), points.dtype)
        start = _Sums(none, zero, none, none, jnp.full_like(none, jnp.inf), none, none)
        start = (start,) * len(reader.settings)
        return tuple(map(_finish, jax.lax.scan(add, start, (views, may_see))[0]))

    found = sums((None,) * len(reader.settings))
    if any(settings.robust for settings in reader.settings):
        robust = sums(tuple((one.mean, one.variance) for one in found))
        found = tuple(
            one._replace(mean=again.mean, weight=again.weight) if settings.robust else one
            for one, again, settings in zip(found, robust, reader.settings, strict=True)
        )
    return found


def _finish(sums: _Sums) -> Gathered:
    mean = safe_divide(sums.values, sums.weight[:, None])
    squares = safe_divide(sums.squares, sums.weight)
    return Gathered(
        mean,
        sums.weight,
        jnp.maximum(squares - jnp.mean(mean * mean, axis=-1), 0),
        sums.count,
        sums.footprint,
        safe_divide(sums.detail, sums.weight),
        safe_divide(sums.angle, sums.weight),
    )


def _add_view(sums, points, side, view, reader, references):
    """The sums of all parts, with what one photograph shows."""
    sources, pyramid = reader.sources, reader.pyramid
    source = camera_at(sources.cameras, view)
    landed, depth = points_to_pixels(source, points)
    maps = jnp.stack([sources.inverse_depth[view], sources.trust[view]], axis=-1)
    inverse, trust = jnp.moveaxis(backward_warp(maps, landed), -1, 0)
    known = (side > 0) & (depth > 0)

    # log2 of the footprint of the finest level's pixel, and of the finest that is read.
    size = jnp.log2(jnp.where(known, depth, 1) / jnp.where(side > 0, side, 1))
    size = size - jnp.log2(mean_focal(pyramid.intrinsics[view][0]))
    coarseness = pyramid.coarseness(view)
    sharpest = size + coarseness[reader.finest]
    footprint = jnp.exp2(sharpest)
    angle = _angle(points - reader.position[None], points - source.position[None])
    ray = (landed - source.intrinsics[None, 2:]) / source.intrinsics[None, :2]

    @functools.cache  # parts that are read alike are read together
    def read(finer):
        level = fractional_level(-size - finer, coarseness)
        level = jnp.maximum(level, jnp.asarray(reader.finest, size.dtype))
        return jnp.split(read_pyramid(pyramid, view, ray, level), len(sums), axis=-1)

    def add(so_far, part, settings, reference):
        difference = (depth * inverse - 1) / settings.tolerance
        seen = trust * jnp.maximum(1 - difference * difference, 0) ** 2
        seen = jnp.where(known, seen, 0)
        weight = seen * jnp.exp(-jnp.minimum(angle / settings.angle_scale, _WIDEST))
        weight = weight / jnp.clip(footprint, 1, _COARSEST) ** 2
        value = read(settings.finer)[part]
        if reference is not None:
            mean, variance = reference
            apart = jnp.mean((value - mean) ** 2, axis=-1)
            apart = settings.robust * safe_divide(apart, variance)
            weight = weight / (1 + apart) ** 2
        return _Sums(
            so_far.weight + weight,
            so_far.values + weight[:, None] * value,
            so_far.squares + weight * jnp.mean(value * value, axis=-1),
            so_far.count + seen,
            jnp.where(seen > 0, jnp.minimum(so_far.footprint, footprint), so_far.footprint),
            so_far.detail - weight * sharpest,
            so_far.angle + weight * angle,
        )

    parts = zip(sums, range(len(sums)), reader.settings, references, strict=True)
    return tuple(add(*part) for part in parts)


def _may_see(camera, points, side):
    """Whether the sphere around points `[N, 3]` meets the camera's view: `[]`, never wrongly no."""
    known = side > 0
    number = jnp.sum(known, dtype=points.dtype)
    center = jnp.sum(jnp.where(known[:, None], points, 0), axis=0) / jnp.maximum(number, 1)
    apart = jnp.where(known, jnp.linalg.norm(points - center[None], axis=-1), 0)
    radius = jnp.max(apart)
    center = matmul(center - camera.position, camera.rotation)
    return sphere_in_view(camera, center, radius) & (number > 0)


def _angle(ours, theirs):
    """Angle `[N]` between vectors `[N, 3]`, with a finite gradient where they are parallel."""
    ours, theirs = (safe_divide(v, safe_norm(v, keepdims=True)) for v in (ours, theirs))
    return 2 * jnp.arcsin(jnp.minimum(safe_norm(ours - theirs) / 2, 0.999))
