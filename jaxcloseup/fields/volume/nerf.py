"""NeRF: a coarse and a fine network, volume rendered (Mildenhall et al., ECCV 2020)."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.volume.depth_supervision import DepthSupervision
from jaxcloseup.fields.volume.encodings import positional_encoding
from jaxcloseup.fields.volume.networks import apply_network, init_network, rays_in_cache
from jaxcloseup.fields.volume.renderer import Samples, VolumeConfig, volume_field


@dataclasses.dataclass(frozen=True)
class NerfConfig:
    """The network and its sampling; the defaults are the original's.

    Attributes:
      depth: number of layers of the trunk.
      width: width of the trunk's layers.
      skip_after: index of the trunk's layer after which the encoded position enters again.
      position_octaves: octaves of the positional encoding of positions.
      direction_octaves: octaves of the positional encoding of view directions.
      direction_width: width of the layer that sees the view direction.
      num_coarse: stratified samples per ray of the coarse network.
      num_fine: importance samples per ray; the fine network sees these and the coarse ones.
      density_noise: standard deviation of noise on raw densities, if the rendering has a key.
      background: gray level in [0, 1] behind the scene; None adds nothing, which is black.
      chunk: rays rendered at once; None leaves the choice to `rays_at_once`.
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
        """Rays to render, or to differentiate, at once."""
        return self.chunk or rays_in_cache(self.num_coarse + self.num_fine, self.width)


def nerf(
    config: NerfConfig,
    *,
    near: float,
    far: float,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
    supervision: DepthSupervision | None = None,
) -> RadianceField:
    """A NeRF that samples rays between z-depths `near` and `far`, in world units.

    The network sees `(position - center) * scale`, which should lie roughly within [-1, 1].
    Parameters are `{"coarse": ..., "fine": ...}`; there are no buffers. `supervision` adds a loss
    on depth, see `ray_field`.

    Raises:
      ValueError: the depth range is empty, or `config.compute_dtype` is unknown.
    """
    if config.compute_dtype not in ("float32", "bfloat16"):
        raise ValueError(
            f'compute_dtype must be "float32" or "bfloat16", not "{config.compute_dtype}"'
        )

    def init(key: jax.Array, points: jax.Array, rgb: jax.Array) -> tuple[Any, tuple[()]]:
        del points, rgb  # a NeRF does not start from points
        key_coarse, key_fine = jax.random.split(key)
        return {"coarse": _init(key_coarse, config), "fine": _init(key_fine, config)}, ()

    def query(params, buffers, stage, key, positions, directions) -> Samples:
        del buffers
        shape = positions.shape[1:]
        encoded_directions = positional_encoding(directions, config.direction_octaves)
        encoded = positional_encoding(positions.reshape(3, -1), config.position_octaves)
        dtype = jnp.bfloat16 if config.compute_dtype == "bfloat16" else encoded.dtype
        raw = apply_network(params[stage], encoded.astype(dtype), encoded_directions.astype(dtype))
        density = raw.density.reshape(shape)
        if key is not None and config.density_noise:
            density += config.density_noise * jax.random.normal(key, shape, density.dtype)
        rgb = jnp.moveaxis(jax.nn.sigmoid(raw.rgb).reshape(3, *shape), 0, -1)
        return Samples(jax.nn.relu(density), rgb)

    volume = VolumeConfig(
        num_coarse=config.num_coarse,
        num_fine=config.num_fine,
        background=config.background,
        chunk=config.rays_at_once,
    )
    return volume_field(
        volume,
        init=init,
        query=query,
        near=near,
        far=far,
        center=center,
        scale=scale,
        supervision=supervision,
    )


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
