"""The volume renderer: it samples rays, asks a field for densities and colors, and composites them.

A volumetric field brings its parameters and a *query function*; sampling, the coarse and the fine
pass, compositing and chunking are the same for all of them. Rays are `[R]`, their samples `[R, S]`.
Rays go through in chunks, one after another, in training as for whole images: the working set stays
in the cache, and memory does not grow with the number of rays.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.field import RadianceField, Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_rays
from jaxcloseup.numerics import safe_divide, safe_norm
from jaxcloseup.volume.compositing import Composite, composite
from jaxcloseup.volume.samplers import importance, stratified


@dataclasses.dataclass(frozen=True)
class VolumeConfig:
    """How rays are sampled and rendered.

    Attributes:
      num_coarse: stratified samples per ray of the coarse pass.
      num_fine: importance samples per ray; the fine pass sees these and the coarse ones.
      background: gray level in [0, 1] behind the scene; None adds nothing, which is black.
      chunk: rays rendered, and in training differentiated, at once; None for all.
    """

    num_coarse: int = 64
    num_fine: int = 64
    background: float | None = None
    chunk: int | None = None


class Samples(NamedTuple):
    """A query function's answer for S samples on each of R rays.

    Attributes:
      density: `[R, S]` non-negative, per world unit, whatever the scale of the field's coordinates.
      rgb: `[R, S, 3]` colors in [0, 1].
    """

    density: jax.Array
    rgb: jax.Array


class VolumeAux(NamedTuple):
    """The `aux` of a volumetric field's rendering.

    Attributes:
      coarse_rgb: `[..., 3]` colors of the coarse pass, for the loss.
      median_depth: `[...]` z-depth at which half of the light is absorbed, 0 where it never is.
      expected_depth: `[...]` weighted sum of z-depths, not divided by alpha.
    """

    coarse_rgb: jax.Array
    median_depth: jax.Array
    expected_depth: jax.Array


Query = Callable[[Any, Any, str, jax.Array | None, jax.Array, jax.Array], Samples]


def volume_field(
    config: VolumeConfig,
    *,
    init: Callable[[jax.Array, jax.Array, jax.Array], tuple[Any, Any]],
    query: Query,
    near: float,
    far: float,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
) -> RadianceField:
    """A radiance field that renders by sampling rays between z-depths `near` and `far`.

    The field's own coordinates are `(world position - center) * scale`. A field that keeps
    `buffers` up to date adds its own `adapt` with `_replace`.

    Args:
      config: sampling and chunking.
      init: `(key, points [P, 3], rgb [P, 3]) -> (params, buffers)`.
      query: `(params, buffers, stage, key, positions [3, R, S], directions [3, R]) -> Samples`.
        `stage` is "coarse" or "fine"; a field with one set of parameters ignores it. `key` is None
        in a deterministic rendering, else the query may use it, to add noise for instance.
        Positions are in the field's coordinates, directions are unit vectors; both have their
        coordinates first.
      near: z-depth of the first samples, world units.
      far: z-depth of the last samples, world units.
      center: world position that becomes the origin of the field's coordinates.
      scale: field units per world unit.

    Returns:
      A field whose `render` takes single pixels, also with stacked cameras, whose `loss` is
      `photometric_loss` and whose `aux` is a `VolumeAux`.

    Raises:
      ValueError: the depth range is empty.
    """
    if not 0 < near < far:
        raise ValueError(f"near and far must satisfy 0 < near < far, not {near} and {far}")

    def render(
        params: Any,
        buffers: Any,
        camera: Camera,
        pixels: jax.Array | None,
        key: jax.Array | None,
    ) -> Rendering:
        if pixels is None:
            pixels = pixel_grid(camera.height, camera.width)
        origins, directions = _rays(camera, pixels)

        def render_rays(rays):
            key, origins, directions = rays
            return _render_rays(
                lambda *args: query(params, buffers, *args),
                key,
                (origins - jnp.array([center])) * scale,
                directions * scale,
                safe_norm(directions),
                near,
                far,
                config,
            )

        shape = pixels.shape[:-1]
        rays = origins.reshape(-1, 3), directions.reshape(-1, 3)
        rendering = _map_chunks(render_rays, key, rays, config.chunk)
        return jax.tree.map(lambda x: x.reshape((*shape, *x.shape[1:])), rendering)

    return RadianceField(
        init=init, render=render, loss=photometric_loss, gradient_chunk=config.chunk
    )


def photometric_loss(
    rendering: Rendering, target_rgb: jax.Array, weight: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Weighted mean squared error of the fine and of the coarse colors, summed (NeRF, eq. 6).

    Args:
      rendering: rendering of pixels `[...]` with a `VolumeAux`.
      target_rgb: `[..., 3]` true colors.
      weight: `[...]` non-negative; all zero gives a zero loss.

    Returns:
      The loss, and `{"psnr"}` of the fine colors, which is inf where no pixel has weight.
    """
    chex.assert_equal_shape([rendering.rgb, rendering.aux.coarse_rgb, target_rgb])
    chex.assert_shape(weight, target_rgb.shape[:-1])

    def error(rgb):
        squared = jnp.mean((rgb - target_rgb) ** 2, axis=-1)
        return safe_divide(jnp.sum(weight * squared), jnp.sum(weight))

    fine, coarse = error(rendering.rgb), error(rendering.aux.coarse_rgb)
    return fine + coarse, {"psnr": -10 * jnp.log10(fine)}


def _rays(camera: Camera, pixels: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rays of one camera, or of stacked cameras `[N]`, one for each of `pixels[N, 2]`."""
    if camera.intrinsics.ndim == 1:
        return pixels_to_rays(camera, pixels)
    chex.assert_shape(pixels, (camera.intrinsics.shape[0], 2))
    return jax.vmap(pixels_to_rays)(camera, pixels)


def _map_chunks(fn, key, rays, chunk):
    """`fn((key, *rays))` on chunks of the rays' leading axis `[R]`, in fixed memory.

    A backward pass computes each chunk again: remembering all of them takes as long, and gigabytes.
    """
    (num_rays,) = {x.shape[0] for x in rays}
    if chunk is None or num_rays <= chunk:
        return fn((key, *rays))
    num_chunks = -(-num_rays // chunk)
    pad = num_chunks * chunk - num_rays
    rays = [jnp.pad(x, ((0, pad), (0, 0)), mode="edge").reshape(num_chunks, chunk, 3) for x in rays]
    keys = None if key is None else jax.random.split(key, num_chunks)
    out = jax.lax.map(jax.checkpoint(fn), (keys, *rays))
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:]))[:num_rays], out)


def _render_rays(query, key, origins, directions, ray_length, near, far, config):
    """Coarse pass, importance samples, fine pass, on rays `[R]` in the field's coordinates."""
    keys = (None,) * 4 if key is None else jax.random.split(key, 4)
    key_coarse, key_fine, key_coarse_query, key_fine_query = keys
    unit = directions / safe_norm(directions, keepdims=True)

    def see(stage, key, depth) -> Composite:
        positions = origins.T[..., None] + directions.T[..., None] * depth[None]  # [3, R, S]
        samples = query(stage, key, positions, unit.T)
        chex.assert_shape(samples.density, depth.shape)
        return composite(samples.rgb, samples.density, depth, ray_length)

    depth = stratified(key_coarse, near, far, config.num_coarse, origins.shape[:1])
    coarse = see("coarse", key_coarse_query, depth)
    middles = 0.5 * (depth[..., 1:] + depth[..., :-1])
    more = importance(key_fine, middles, coarse.weights[..., 1:-1], config.num_fine)
    depth = jnp.sort(jnp.concatenate([depth, more], axis=-1), axis=-1)
    fine = see("fine", key_fine_query, depth)

    def add_background(seen: Composite) -> jax.Array:
        if config.background is None:
            return seen.rgb
        return seen.rgb + (1 - seen.alpha[..., None]) * config.background

    aux = VolumeAux(add_background(coarse), fine.median_depth, fine.expected_depth)
    return Rendering(add_background(fine), fine.depth, fine.alpha, aux)
