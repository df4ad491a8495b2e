"""NeRF: a coarse and a fine network, volume rendered (Mildenhall et al., ECCV 2020)."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.volume.config import NerfConfig
from jaxcloseup.fields.volume.depth_supervision import DepthSupervision
from jaxcloseup.fields.volume.encodings import positional_encoding
from jaxcloseup.fields.volume.networks import Params, apply_network, init_network, rays_in_cache
from jaxcloseup.fields.volume.rays import Extent
from jaxcloseup.fields.volume.renderer import Samples, VolumeConfig, volume_field


def nerf_field(
    config: NerfConfig, extent: Extent, *, supervision: DepthSupervision | None = None
) -> RadianceField:
    """Return a NeRF, whose network sees the extent's coordinates, roughly within [-1, 1].

    Parameters are `{"coarse": ..., "fine": ...}`; there are no buffers. `supervision` adds a loss
    on depth, see `ray_field`.

    Raises:
      ValueError: `config.compute_dtype` is unknown.
    """
    if config.compute_dtype not in ("float32", "bfloat16"):
        raise ValueError(
            f'compute_dtype must be "float32" or "bfloat16", not "{config.compute_dtype}"'
        )

    def init(key: jax.Array, points: jax.Array, rgb: jax.Array) -> tuple[Any, tuple[()]]:
        del points, rgb  # a NeRF does not start from points
        key_coarse, key_fine = jax.random.split(key)
        return {"coarse": _init(key_coarse, config), "fine": _init(key_fine, config)}, ()

    def query(
        params: Params,
        buffers: Any,
        stage: str,
        key: jax.Array | None,
        positions: jax.Array,
        directions: jax.Array,
    ) -> Samples:
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
        chunk=config.chunk or rays_in_cache(config.num_coarse + config.num_fine, config.width),
    )
    return volume_field(volume, extent, init=init, query=query, supervision=supervision)


def _init(key: jax.Array, config: NerfConfig) -> Params:
    return init_network(
        key,
        depth=config.depth,
        width=config.width,
        skip_after=config.skip_after,
        position_features=3 + 6 * config.position_octaves,
        direction_features=3 + 6 * config.direction_octaves,
        direction_width=config.direction_width,
    )
