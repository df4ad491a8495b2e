"""Gather values at points that lie together: visit each photograph once, and sum what it shows."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, mean_focal, points_to_pixels
from jaxcloseup.geometry.numerics import matmul, safe_divide, safe_norm
from jaxcloseup.geometry.visibility import sphere_in_view
from jaxcloseup.geometry.warp import backward_warp
from jaxcloseup.photos.depth_maps import GatherSources
from jaxcloseup.photos.pyramids import Pyramid, fractional_level, read_pyramid
from jaxcloseup.photos.views import camera_at


_WIDEST = 20  # angles in units of `angle_scale`, beyond which all weigh alike
_COARSEST = 64  # footprints beyond which all weigh alike


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
    count: jax.Array  # type: ignore[assignment]  # hides a method of tuples
    footprint: jax.Array
    detail: jax.Array
    angle: jax.Array


class Reader(NamedTuple):
    """Everything that reading a photograph at points of a view needs.

    Attributes:
      position: `[3]` of the view's camera.
      sources: depth maps of the photographs.
      pyramid: values of the photographs, equal parts of its channels one after the other.
      settings: settings of each part.
      finest: the first level to read.
    """

    position: jax.Array
    sources: GatherSources
    pyramid: Pyramid
    settings: tuple[GatherSettings, ...]
    finest: jax.Array


class _Sums(NamedTuple):
    """Sums over photographs at points `[N]`; the fields of `Gathered` before division."""

    weight: jax.Array
    values: jax.Array
    squares: jax.Array
    count: jax.Array  # type: ignore[assignment]  # hides a method of tuples
    footprint: jax.Array
    detail: jax.Array
    angle: jax.Array


class _Reference(NamedTuple):
    """Mean `[N, C]` and variance `[N]` of a first visit, which robust weights compare with."""

    mean: jax.Array
    variance: jax.Array


def gather_points(
    points: jax.Array, side: jax.Array, reader: Reader, exclude: jax.Array
) -> tuple[Gathered, ...]:
    """Gather at points that are culled together, for each part of the pyramid's channels.

    Args:
      points: `[N, 3]` in world units.
      side: `[N]` side of the view's pixel at each point; 0 marks points that are undefined.
      reader: see there.
      exclude: index of a photograph to leave out; -1 leaves out none.
    """
    views = jnp.arange(reader.sources.maps.shape[0])
    may_see = jax.vmap(lambda camera: _may_see(camera, points, side))(reader.sources.cameras)
    may_see &= views != exclude
    channels = reader.pyramid.values.shape[-1] // len(reader.settings)

    def visit(references: Sequence[_Reference | None]) -> tuple[Gathered, ...]:
        def add(
            sums: tuple[_Sums, ...], item: tuple[jax.Array, jax.Array]
        ) -> tuple[tuple[_Sums, ...], None]:
            view, visible = item
            return jax.lax.cond(
                visible,
                lambda: _add_view(sums, points, side, view, reader, references),
                lambda: sums,
            ), None

        none = jnp.zeros(side.shape, points.dtype)
        zero = jnp.zeros((*side.shape, channels), points.dtype)
        start = _Sums(none, zero, none, none, jnp.full_like(none, jnp.inf), none, none)
        sums, _ = jax.lax.scan(add, (start,) * len(reader.settings), (views, may_see))
        return tuple(map(_finish, sums))

    gathered = visit((None,) * len(reader.settings))
    if any(settings.robust for settings in reader.settings):
        robust = visit([_Reference(part.mean, part.variance) for part in gathered])
        gathered = tuple(
            part._replace(mean=again.mean, weight=again.weight) if settings.robust else part
            for part, again, settings in zip(gathered, robust, reader.settings, strict=True)
        )
    return gathered


def _finish(sums: _Sums) -> Gathered:
    mean = safe_divide(sums.values, sums.weight[:, None])
    squares = safe_divide(sums.squares, sums.weight)
    return Gathered(
        mean=mean,
        weight=sums.weight,
        variance=jnp.maximum(squares - jnp.mean(mean * mean, axis=-1), 0),
        count=sums.count,
        footprint=sums.footprint,
        detail=safe_divide(sums.detail, sums.weight),
        angle=safe_divide(sums.angle, sums.weight),
    )


def _read_maps(
    sources: GatherSources, view: jax.Array, landed: jax.Array
) -> tuple[jax.Array, jax.Array]:
    maps = backward_warp(sources.maps[view, 1:-1, 1:-1], landed)
    inverse, trust = jnp.moveaxis(maps, -1, 0)
    return inverse, trust


def _add_view(
    sums: tuple[_Sums, ...],
    points: jax.Array,
    side: jax.Array,
    view: jax.Array,
    reader: Reader,
    references: Sequence[_Reference | None],
) -> tuple[_Sums, ...]:
    """Add what one photograph shows to the sums of all parts."""
    sources, pyramid = reader.sources, reader.pyramid
    source = camera_at(sources.cameras, view)
    landed, depth = points_to_pixels(source, points)
    inverse, trust = _read_maps(sources, view, landed)
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
    def read(finer: float) -> list[jax.Array]:
        level = fractional_level(-size - finer, coarseness)
        level = jnp.maximum(level, jnp.asarray(reader.finest, size.dtype))
        return jnp.split(read_pyramid(pyramid, view, ray, level), len(sums), axis=-1)

    def add(
        before: _Sums, part: int, settings: GatherSettings, reference: _Reference | None
    ) -> _Sums:
        difference = (depth * inverse - 1) / settings.tolerance
        seen = trust * jnp.maximum(1 - difference * difference, 0) ** 2
        seen = jnp.where(known, seen, 0)
        weight = seen * jnp.exp(-jnp.minimum(angle / settings.angle_scale, _WIDEST))
        weight = weight / jnp.clip(footprint, 1, _COARSEST) ** 2
        value = read(settings.finer)[part]
        if reference is not None:
            apart = jnp.mean((value - reference.mean) ** 2, axis=-1)
            apart = settings.robust * safe_divide(apart, reference.variance)
            weight = weight / (1 + apart) ** 2
        return _Sums(
            weight=before.weight + weight,
            values=before.values + weight[:, None] * value,
            squares=before.squares + weight * jnp.mean(value * value, axis=-1),
            count=before.count + seen,
            footprint=jnp.where(
                seen > 0, jnp.minimum(before.footprint, footprint), before.footprint
            ),
            detail=before.detail - weight * sharpest,
            angle=before.angle + weight * angle,
        )

    parts = zip(sums, reader.settings, references, strict=True)
    return tuple(
        add(before, part, settings, reference)
        for part, (before, settings, reference) in enumerate(parts)
    )


def _may_see(camera: Camera, points: jax.Array, side: jax.Array) -> jax.Array:
    """Return whether the sphere around points `[N, 3]` meets the camera's view, `[]` bool.

    The answer is never wrongly False.
    """
    known = side > 0
    number = jnp.sum(known, dtype=points.dtype)
    center = jnp.sum(jnp.where(known[:, None], points, 0), axis=0) / jnp.maximum(number, 1)
    apart = jnp.where(known, jnp.linalg.norm(points - center[None], axis=-1), 0)
    radius = jnp.max(apart)
    center = matmul(center - camera.position, camera.rotation)
    return sphere_in_view(camera, center, radius) & (number > 0)


def _angle(to_view: jax.Array, to_photograph: jax.Array) -> jax.Array:
    """Compute angles `[N]` between vectors `[N, 3]`, with finite gradients for parallel ones."""
    ours, theirs = (
        safe_divide(vector, safe_norm(vector, keepdims=True)) for vector in (to_view, to_photograph)
    )
    return 2 * jnp.arcsin(jnp.minimum(safe_norm(ours - theirs) / 2, 0.999))
