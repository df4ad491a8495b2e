"""Gather: what photographs that see the points of a view show there, read at the view's detail.

Any field and any values: colors make a view from photographs alone, residuals (photograph minus
render) show what the photographs know beyond a model.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, mean_focal, pixels_to_points
from jaxcloseup.photos import gather_native
from jaxcloseup.photos.depth_maps import GatherSources
from jaxcloseup.photos.gather_sums import Gathered, GatherSettings, Reader, gather_points
from jaxcloseup.photos.pyramids import Pyramid


_CHUNK = 2048  # points that are culled together; a window that teaches weights fits
_CHUNKS = 16  # chunks for which one program is compiled, to serve images of many sizes


DEFAULT = GatherSettings()


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
    arrays = _Arrays(
        *(camera, pixels, depth, sources, pyramid),
        *(jnp.asarray(index, jnp.int32) for index in (finest, exclude)),
    )
    if not gather_native.can_gather(*arrays[:5], parts=len(settings)):
        return _gather_blocks(tuple(settings), arrays)
    if _is_traced(arrays):
        return _gather_natively(tuple(settings), arrays)
    platforms = {device.platform for device in jnp.asarray(pyramid.values).devices()}
    gather = _compiled_natively if platforms == {"cpu"} else _gather_blocks
    return gather(tuple(settings), arrays)


class _Arrays(NamedTuple):
    """What is gathered, and where from: arguments of `gather_parts`."""

    camera: Camera
    pixels: jax.Array
    depth: jax.Array
    sources: GatherSources
    pyramid: Pyramid
    finest: jax.Array
    exclude: jax.Array


def _is_traced(arrays: Any) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arrays))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _gather_natively(settings: tuple[GatherSettings, ...], arrays: _Arrays) -> tuple[Gathered, ...]:
    """Gather by the native library where a program is compiled for CPUs."""
    native = functools.partial(gather_native.gather_image, settings=settings)
    return jax.lax.platform_dependent(
        arrays,
        cpu=lambda arrays: native(*arrays[:5], finest=arrays.finest, exclude=arrays.exclude),
        default=functools.partial(_gather_blocks, settings),
    )


@_gather_natively.defjvp
def _differentiate(
    settings: tuple[GatherSettings, ...], primals: tuple[_Arrays], tangents: tuple[_Arrays]
) -> Any:
    """Differentiate what is gathered in JAX instead."""
    return jax.jvp(functools.partial(_gather_blocks, settings), primals, tangents)


_compiled_natively = jax.jit(_gather_natively, static_argnums=0)


def _gather_blocks(settings: tuple[GatherSettings, ...], arrays: _Arrays) -> tuple[Gathered, ...]:
    """Gather in JAX, on any platform."""
    camera, pixels, depth, sources, pyramid, finest, exclude = arrays
    # Blocks of one size share a program; in a trace, each would be a copy of it.
    traced = _is_traced((camera, pixels, depth))
    blocks = [
        _gather_chunks(
            points, side, camera.position, sources, pyramid, finest, exclude, settings=settings
        )
        for points, side in _surface(camera, pixels, depth, whole=traced)
    ]
    return _as_images(blocks, shape=depth.shape)


@functools.partial(jax.jit, static_argnames="whole")
def _surface(
    camera: Camera, pixels: jax.Array, depth: jax.Array, *, whole: bool
) -> list[tuple[jax.Array, jax.Array]]:
    """Return points `[K, N, 3]` of a view in chunks, and sides `[K, N]` of its pixels, by block.

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
def _gather_chunks(
    points: jax.Array,
    side: jax.Array,
    position: jax.Array,
    sources: GatherSources,
    pyramid: Pyramid,
    finest: jax.Array,
    exclude: jax.Array,
    *,
    settings: tuple[GatherSettings, ...],
) -> tuple[Gathered, ...]:
    """Gather at points in chunks, for each of the settings; chunks without a surface are cheap."""
    reader = Reader(position, sources, pyramid, settings, finest)

    def gather_chunk(chunk: tuple[jax.Array, jax.Array]) -> tuple[Gathered, ...]:
        points, side = chunk

        def gather() -> tuple[Gathered, ...]:
            return gather_points(points, side, reader, exclude)

        def nothing() -> tuple[Gathered, ...]:
            zeros = jax.tree.map(jnp.zeros_like, jax.eval_shape(gather))
            return tuple(part._replace(footprint=part.footprint + jnp.inf) for part in zeros)

        return jax.lax.cond(jnp.any(side > 0), gather, nothing)

    return jax.lax.map(gather_chunk, (points, side))


@functools.partial(jax.jit, static_argnames="shape")
def _as_images(
    blocks: list[tuple[Gathered, ...]], *, shape: tuple[int, ...]
) -> tuple[Gathered, ...]:
    """Join blocks of chunks of points to images of a shape, without the points that pad them."""

    def join(*parts: jax.Array) -> jax.Array:
        array = jnp.concatenate(parts)
        array = array.reshape(-1, *array.shape[2:])[: math.prod(shape)]
        return array.reshape(*shape, *array.shape[1:])

    return jax.tree.map(join, *blocks)
