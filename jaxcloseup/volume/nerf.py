"""NeRF: a coarse and a fine network, volume rendered (Mildenhall et al., ECCV 2020).

Rays are `[R]`, their samples `[R, S]`. Rays go through in chunks, one after another, in training as
for whole images: the working set stays in the cache, and memory does not grow with their number.
"""

import dataclasses
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.field import RadianceField, Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_rays
from jaxcloseup.numerics import safe_divide, safe_norm
from jaxcloseup.volume.compositing import Composite, composite
from jaxcloseup.volume.encodings import positional_encoding
from jaxcloseup.volume.networks import apply_network, init_network
from jaxcloseup.volume.samplers import importance, stratified


@dataclasses.dataclass(frozen=True)
class NerfConfig:
    """The network and its sampling; the defaults are the original's.

    Attributes:
      depth: layers of the trunk.
      width: their width.
      skip_after: the encoded position enters again after the trunk's layer of this index.
      position_octaves: of the positional encoding of positions.
      direction_octaves: of view directions.
      direction_width: width of the layer that sees the view direction.
      num_coarse: stratified samples of the coarse network.
      num_fine: importance samples; the fine network sees these and the coarse ones.
      density_noise: standard deviation of noise on raw densities, where a key is given.
      background: gray level in [0, 1] behind the scene; None adds nothing, which is black.
      chunk: rays rendered at once; None for as many as `rays_at_once` says.
      compute_dtype: "float32" or "bfloat16" for the operands of the network's products.
    """

    depth: int = 8
    width: int = 256
    skip_after: int = 4
    position_octaves: int = 10
    direction_octaves: int = 4
    direction_width: int = 128
    num_coarse: int = 64
    num_fine: int = 64
    density_noise: float = 1.0
    background: float | None = None
    chunk: int | None = None
    compute_dtype: str = "float32"

    @property
    def rays_at_once(self) -> int:
        """Rays to render, or to differentiate, at once: what keeps one layer's activations small.

        Small is 2 MB on a CPU, the size of a core's cache, and 512 MB elsewhere. The rest follows:
        whole images need about 4 times as much memory, training `2 depth + 4` times.
        """
        if self.chunk is not None:
            return self.chunk
        activations = 2**19 if jax.default_backend() == "cpu" else 2**27
        return max(1, activations // ((self.num_coarse + self.num_fine) * self.width))


class NerfAux(NamedTuple):
    """What else a NeRF renders.

    Attributes:
      coarse_rgb: `[..., 3]` colors by the coarse network, for the loss.
      median_depth: `[...]` z-depth at which half of the light is absorbed, 0 where none is.
      expected_depth: `[...]` weighted sum of z-depths, not divided by alpha.
    """

    coarse_rgb: jax.Array
    median_depth: jax.Array
    expected_depth: jax.Array


def nerf(
    config: NerfConfig,
    *,
    near: float,
    far: float,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
) -> RadianceField:
    """A NeRF that samples rays between z-depths `near` and `far`, in world units.

    The network sees `(position - center) * scale`, which should lie roughly within [-1, 1].
    Parameters are `{"coarse": ..., "fine": ...}`; there are no buffers.

    Raises:
      ValueError: the depth range is empty or a setting is out of range.
    """
    if not 0 < near < far:
        raise ValueError(f"near and far must satisfy 0 < near < far, not {near} and {far}")
    if config.compute_dtype not in ("float32", "bfloat16"):
        raise ValueError(
            f'NerfConfig.compute_dtype is "float32" or "bfloat16", not "{config.compute_dtype}"'
        )

    def init(key: jax.Array, points: jax.Array, rgb: jax.Array) -> tuple[Any, tuple[()]]:
        del points, rgb  # a NeRF starts from nothing
        key_coarse, key_fine = jax.random.split(key)
        return {"coarse": _init(key_coarse, config), "fine": _init(key_fine, config)}, ()

    def render(
        params: Any,
        buffers: Any,
        camera: Camera,
        pixels: jax.Array | None,
        key: jax.Array | None,
    ) -> Rendering:
        del buffers
        if pixels is None:
            pixels = pixel_grid(camera.height, camera.width)
        origins, directions = _rays(camera, pixels)

        def render_rays(rays):
            key, origins, directions = rays
            return _render_rays(
                params,
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
        rendering = _map_chunks(render_rays, key, rays, config.rays_at_once)
        return jax.tree.map(lambda x: x.reshape((*shape, *x.shape[1:])), rendering)

    return RadianceField(init=init, render=render, loss=loss)


def loss(
    rendering: Rendering, target_rgb: jax.Array, weight: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Weighted mean squared error of the fine and of the coarse colors, summed.

    Args:
      rendering: of pixels `[...]`.
      target_rgb: `[..., 3]` the colors they should have.
      weight: `[...]` non-negative; all zero gives a zero loss.

    Returns:
      The loss, and `{"psnr"}` of the fine colors (inf where nothing weighs).
    """
    chex.assert_equal_shape([rendering.rgb, rendering.aux.coarse_rgb, target_rgb])
    chex.assert_shape(weight, target_rgb.shape[:-1])

    def error(rgb):
        squared = jnp.mean((rgb - target_rgb) ** 2, axis=-1)
        return safe_divide(jnp.sum(weight * squared), jnp.sum(weight))

    fine, coarse = error(rendering.rgb), error(rendering.aux.coarse_rgb)
    return fine + coarse, {"psnr": -10 * jnp.log10(fine)}


def _init(key: jax.Array, config: NerfConfig) -> Any:
    return init_network(
        key,
        depth=config.depth,
        width=config.width,
        skip_after=config.skip_after,
        position_features=3 + 6 * config.position_octaves,
        direction_features=3 + 6 * config.direction_octaves,
        direction_width=config.direction_width,
    )


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
    if num_rays <= chunk:
        return fn((key, *rays))
    num_chunks = -(-num_rays // chunk)
    pad = num_chunks * chunk - num_rays
    rays = [jnp.pad(x, ((0, pad), (0, 0)), mode="edge").reshape(num_chunks, chunk, 3) for x in rays]
    keys = None if key is None else jax.random.split(key, num_chunks)
    out = jax.lax.map(jax.checkpoint(fn), (keys, *rays))
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:]))[:num_rays], out)


def _render_rays(params, key, origins, directions, ray_length, near, far, config):
    """Coarse pass, importance samples, fine pass, on rays `[R]` in the network's coordinates."""
    keys = (None,) * 4 if key is None else jax.random.split(key, 4)
    key_coarse, key_fine, key_coarse_noise, key_fine_noise = keys
    unit = directions / safe_norm(directions, keepdims=True)
    encoded_directions = positional_encoding(unit.T, config.direction_octaves)

    def evaluate(network, key, depth) -> Composite:
        positions = origins.T[..., None] + directions.T[..., None] * depth[None]  # [3, R, S]
        encoded = positional_encoding(positions.reshape(3, -1), config.position_octaves)
        dtype = jnp.bfloat16 if config.compute_dtype == "bfloat16" else encoded.dtype
        raw = apply_network(network, encoded.astype(dtype), encoded_directions.astype(dtype))
        density = raw.density.reshape(depth.shape)
        if key is not None and config.density_noise:
            density += config.density_noise * jax.random.normal(key, depth.shape, density.dtype)
        rgb = jnp.moveaxis(jax.nn.sigmoid(raw.rgb).reshape(3, *depth.shape), 0, -1)
        return composite(rgb, jax.nn.relu(density), depth, ray_length)

    depth = stratified(key_coarse, near, far, config.num_coarse, origins.shape[:1])
    coarse = evaluate(params["coarse"], key_coarse_noise, depth)
    middles = 0.5 * (depth[..., 1:] + depth[..., :-1])
    more = importance(key_fine, middles, coarse.weights[..., 1:-1], config.num_fine)
    depth = jnp.sort(jnp.concatenate([depth, more], axis=-1), axis=-1)
    fine = evaluate(params["fine"], key_fine_noise, depth)

    def behind(seen: Composite) -> jax.Array:
        if config.background is None:
            return seen.rgb
        return seen.rgb + (1 - seen.alpha[..., None]) * config.background

    aux = NerfAux(behind(coarse), fine.median_depth, fine.expected_depth)
    return Rendering(behind(fine), fine.depth, fine.alpha, aux)
