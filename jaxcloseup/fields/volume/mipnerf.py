"""mip-NeRF: a NeRF that sees cones, by one network in both passes (Barron et al., ICCV 2021)."""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.volume.cones import frustum_gaussians, integrated_encoding
from jaxcloseup.fields.volume.config import MipNerfConfig
from jaxcloseup.fields.volume.depth_supervision import DepthSupervision
from jaxcloseup.fields.volume.encodings import positional_encoding
from jaxcloseup.fields.volume.intervals import IntervalConfig, Round, interval_field
from jaxcloseup.fields.volume.networks import Params, apply_network, init_network, rays_in_cache
from jaxcloseup.fields.volume.rays import Extent, Rays, photometric_loss
from jaxcloseup.fields.volume.renderer import Samples
from jaxcloseup.fields.volume.samplers import widen


_PADDING = 0.001  # colors reach this far beyond [0, 1], so that the loss can reach 0 and 1


def mipnerf_field(
    config: MipNerfConfig, extent: Extent, *, supervision: DepthSupervision | None = None
) -> RadianceField:
    """Return a mip-NeRF, whose network sees the extent's coordinates, roughly within [-1, 1].

    Parameters are those of the network; there are no buffers. `supervision` adds a loss on depth,
    see `ray_field`.
    """

    def init(key: jax.Array, points: jax.Array, rgb: jax.Array) -> tuple[Any, tuple[()]]:
        del points, rgb
        network = init_network(
            key,
            depth=config.depth,
            width=config.width,
            skip_after=config.skip_after,
            position_features=6 * config.position_octaves,
            direction_features=3 + 6 * config.direction_octaves,
            direction_width=config.direction_width,
        )
        return network, ()

    def query(
        params: Params, buffers: Any, key: jax.Array | None, rays: Rays, edges: jax.Array
    ) -> Samples:
        del buffers, key
        shape = edges.shape[0], edges.shape[1] - 1
        mean, variance = (x.reshape(3, -1) for x in frustum_gaussians(rays, edges))
        encoded = integrated_encoding(mean, variance, config.position_octaves)
        looking = positional_encoding(rays.unit, config.direction_octaves)
        raw = apply_network(params, encoded, looking)
        rgb = (1 + 2 * _PADDING) * jax.nn.sigmoid(raw.rgb) - _PADDING
        density = extent.scale * jax.nn.softplus(raw.density - 1)
        return Samples(density.reshape(shape), jnp.moveaxis(rgb.reshape(3, *shape), 0, -1))

    chunk = config.chunk or rays_in_cache(config.num_coarse + config.num_fine, config.width)
    return interval_field(
        IntervalConfig(spacing=config.spacing, background=config.background, chunk=chunk),
        extent,
        init=init,
        rounds=[Round(config.num_coarse, query), Round(config.num_fine, query)],
        blur=widen,
        loss=functools.partial(photometric_loss, coarse_weight=config.coarse_weight),
        supervision=supervision,
    )
