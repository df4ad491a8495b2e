"""Rays of a camera, and a radiance field made of a function that traces them.

Rays are `[R]`. They go through in chunks, one after another, in training as for whole images: the
working set stays in the cache, and memory does not grow with the number of rays.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import RadianceField, Rendering
from jaxcloseup.fields.volume.depth_supervision import (
    DepthSupervision,
    PixelSupervision,
    PointSupervision,
    mean_divergence,
    measured_divergence,
)
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_rays
from jaxcloseup.geometry.numerics import safe_divide, safe_norm


_SUPERVISED = 1  # folded into the key of rays through known points


@dataclasses.dataclass(frozen=True)
class Extent:
    """The depths that a field covers, and its own coordinates: `(position - center) * scale`.

    Attributes:
      near: z-depth of the first samples, world units.
      far: z-depth of the last samples, world units.
      center: world position of the origin of the field's coordinates.
      scale: field units per world unit.

    Raises:
      ValueError: the depth range is empty.
    """

    near: float
    far: float
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        """Raise a ValueError if the depth range is empty."""
        if not 0 < self.near < self.far:
            raise ValueError(
                f"near and far must satisfy 0 < near < far, not {self.near} and {self.far}"
            )


class Rays(NamedTuple):
    """Rays with unit camera-z, so their parameter is z-depth, in a field's own coordinates.

    Attributes:
      origins: `[R, 3]` field units.
      directions: `[R, 3]` field units per unit of z-depth.
      length: `[R]` world units per unit of z-depth.
      pixel: `[R]` width of a pixel at z-depth 1, field units.
    """

    origins: jax.Array
    directions: jax.Array
    length: jax.Array
    pixel: jax.Array

    @property
    def unit(self) -> jax.Array:
        """Return unit directions, coordinates first, `[3, R]`."""
        return (self.directions / safe_norm(self.directions, keepdims=True)).T

    def at(self, depth: jax.Array) -> jax.Array:
        """Return positions `[3, R, S]` at z-depths `[R, S]`."""
        return self.origins.T[..., None] + self.directions.T[..., None] * depth[None]

    def at_middles(self, edges: jax.Array) -> jax.Array:
        """Return positions `[3, R * S]` in the middle of intervals with edges `[R, S + 1]`."""
        return self.at(0.5 * (edges[..., 1:] + edges[..., :-1])).reshape(3, -1)


class VolumeAux(NamedTuple):
    """The `aux` of a volumetric field's rendering.

    Attributes:
      coarse_rgb: `[..., 3]` colors of the coarse pass, for the loss; None from fields whose coarse
        passes have no colors.
      median_depth: `[...]` z-depth at which half of the light is absorbed, 0 where it never is.
      expected_depth: `[...]` weighted sum of z-depths, not divided by alpha.
      penalty: `[...]` what the loss adds for each ray; None for fields without regularizers.
      light: `Traced.light` of these pixels, for a loss on their measured depth; otherwise None.
    """

    coarse_rgb: jax.Array | None
    median_depth: jax.Array
    expected_depth: jax.Array
    penalty: jax.Array | None = None
    light: list[tuple[jax.Array, jax.Array]] | None = None


class Traced(NamedTuple):
    """What R rays show.

    Attributes:
      rendering: `[R]`, with a `VolumeAux`.
      light: of each pass that photographs supervise, first to last: edges `[R, S + 1]` of its
        intervals, ascending z-depths, and weights `[R, S]`, the shares of light from there.
    """

    rendering: Rendering
    light: list[tuple[jax.Array, jax.Array]]


Trace = Callable[[Any, Any, jax.Array | None, Rays], Traced]


def ray_field(
    extent: Extent,
    *,
    init: Callable[[jax.Array, jax.Array, jax.Array], tuple[Any, Any]],
    trace: Trace,
    chunk: int | None = None,
    loss: Callable[..., tuple[jax.Array, dict[str, jax.Array]]] | None = None,
    supervision: DepthSupervision | None = None,
) -> RadianceField:
    """Return a field that traces rays; one that keeps `buffers` up to date replaces its `adapt`.

    Args:
      extent: the field's coordinates.
      init: `(key, points [P, 3], rgb [P, 3]) -> (params, buffers)`.
      trace: `(params, buffers, key, rays [R]) -> Traced`; `key` is None in a deterministic
        rendering.
      chunk: rays traced, and in training differentiated, at once; None for all.
      loss: `photometric_loss` by default.
      supervision: a loss on depth, for renderings with a key: a penalty of points, or of pixels the
        field's `depth_loss`.

    Returns:
      A field whose `render` takes single pixels, also with stacked cameras.
    """
    depth_loss = _depth_loss(supervision) if isinstance(supervision, PixelSupervision) else None

    def trace_pixels(
        params: Any,
        buffers: Any,
        camera: Camera,
        pixels: jax.Array,
        key: jax.Array | None,
        take: Callable[[Traced], Any],
    ) -> Any:
        """Return `take(Traced)` of pixels `[N, 2]`, chunk by chunk."""

        def trace_rays(keyed: tuple[Any, jax.Array, jax.Array, jax.Array]) -> Any:
            key, *world_rays = keyed
            return take(trace(params, buffers, key, _to_field(extent, *world_rays)))

        return _map_chunks(trace_rays, key, _rays(camera, pixels), chunk)

    def render(
        params: Any, buffers: Any, camera: Camera, pixels: Any, key: jax.Array | None
    ) -> Rendering:
        pixels = pixel_grid(camera.height, camera.width) if pixels is None else pixels
        shape, pixels = pixels.shape[:-1], pixels.reshape(-1, 2)
        bound = functools.partial(trace_pixels, params, buffers)
        lit = depth_loss is not None and key is not None
        rendering = bound(camera, pixels, key, _with_light if lit else lambda seen: seen.rendering)
        if isinstance(supervision, PointSupervision) and key is not None:
            see = functools.partial(bound, take=lambda traced: traced.light)
            key = jax.random.fold_in(key, _SUPERVISED)
            more = mean_divergence(supervision, key, len(pixels), see)
            rendering = _add_penalty(rendering, more)
        return jax.tree.map(lambda x: x.reshape((*shape, *x.shape[1:])), rendering)

    loss = loss or photometric_loss
    return RadianceField(init, render, loss, gradient_chunk=chunk, depth_loss=depth_loss)


def _depth_loss(supervision: PixelSupervision) -> Callable[..., jax.Array]:
    """Return a field's `depth_loss`."""

    def depth_loss(rendering: Rendering, depth: jax.Array, trust: jax.Array) -> jax.Array:
        return supervision.weight * measured_divergence(rendering.aux.light, depth, trust)

    return depth_loss


def _add_penalty(rendering: Rendering, more: jax.Array) -> Rendering:
    """Add a penalty `[]` to that of each pixel `[N]`."""
    before = rendering.aux.penalty
    more = jnp.broadcast_to(more, rendering.alpha.shape) + (0 if before is None else before)
    return rendering._replace(aux=rendering.aux._replace(penalty=more))


def _with_light(traced: Traced) -> Rendering:
    aux = traced.rendering.aux._replace(light=traced.light)
    return traced.rendering._replace(aux=aux)


def photometric_loss(
    rendering: Rendering, target_rgb: jax.Array, weight: jax.Array, *, coarse_weight: float = 1.0
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Compute the weighted squared error of fine and coarse colors (NeRF, eq. 6), with penalties.

    Args:
      rendering: rendering of pixels `[...]` with a `VolumeAux`.
      target_rgb: `[..., 3]` true colors.
      weight: `[...]` non-negative; all zero gives a zero loss.
      coarse_weight: of the coarse colors, where there are any.

    Returns:
      The loss, and `{"psnr"}` of the fine colors, which is inf where no pixel has weight.
    """
    chex.assert_equal_shape([rendering.rgb, target_rgb])
    chex.assert_shape(weight, target_rgb.shape[:-1])

    def mean(values: jax.Array) -> jax.Array:
        return safe_divide(jnp.sum(weight * values), jnp.sum(weight))

    def error(rgb: jax.Array) -> jax.Array:
        return mean(jnp.mean((rgb - target_rgb) ** 2, axis=-1))

    aux, fine = rendering.aux, error(rendering.rgb)
    loss = fine
    if aux.coarse_rgb is not None:
        loss += coarse_weight * error(aux.coarse_rgb)
    if aux.penalty is not None:
        loss += mean(aux.penalty)
    return loss, {"psnr": -10 * jnp.log10(fine)}


def _to_field(extent: Extent, origins: jax.Array, directions: jax.Array, pixel: jax.Array) -> Rays:
    """Convert rays `[R, 3]` and widths of pixels `[R]` from world units to field units."""
    return Rays(
        origins=(origins - jnp.array([extent.center])) * extent.scale,
        directions=directions * extent.scale,
        length=safe_norm(directions),
        pixel=pixel * extent.scale,
    )


def _rays(camera: Camera, pixels: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return rays of one camera, or of stacked cameras `[N]`, one for each of `pixels[N, 2]`."""
    # A pixel that is not square has the width of a square one of its area.
    width = jax.lax.rsqrt(camera.intrinsics[..., 0] * camera.intrinsics[..., 1])
    if camera.intrinsics.ndim == 1:
        return *pixels_to_rays(camera, pixels), jnp.broadcast_to(width, pixels.shape[:-1])
    chex.assert_shape(pixels, (camera.intrinsics.shape[0], 2))
    return *jax.vmap(pixels_to_rays)(camera, pixels), width


def _map_chunks(
    fn: Callable[[Any], Any],
    key: jax.Array | None,
    rays: tuple[jax.Array, jax.Array, jax.Array],
    chunk: int | None,
) -> Any:
    """Map `fn((key, *rays))` over chunks of the rays' leading axis `[R]`, in fixed memory.

    A backward pass computes each chunk again: remembering all of them takes as long, and gigabytes.
    """
    (num_rays,) = {x.shape[0] for x in rays}
    if chunk is None or num_rays <= chunk:
        return fn((key, *rays))
    num_chunks = -(-num_rays // chunk)
    pad = num_chunks * chunk - num_rays
    padded = [
        jnp.pad(x, ((0, pad), *((0, 0),) * (x.ndim - 1)), mode="edge").reshape(
            num_chunks, chunk, *x.shape[1:]
        )
        for x in rays
    ]
    keys = None if key is None else jax.random.split(key, num_chunks)
    out = jax.lax.map(jax.checkpoint(fn), (keys, *padded))
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:]))[:num_rays], out)
