"""Instant-NGP: a hash encoding and small networks (Müller et al., SIGGRAPH 2022).

Where the paper skips empty space by an occupancy grid, proposals cut the rays, see `hash_fields`.
Where it encodes view directions by spherical harmonics, they are encoded as a NeRF's.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.volume.config import NgpConfig
from jaxcloseup.fields.volume.coordinates import contract
from jaxcloseup.fields.volume.depth_supervision import DepthSupervision
from jaxcloseup.fields.volume.hash_fields import GEOMETRY, hash_field, init_color_network, init_part
from jaxcloseup.fields.volume.hash_grid import hash_features
from jaxcloseup.fields.volume.intervals import Histogram
from jaxcloseup.fields.volume.networks import Params
from jaxcloseup.fields.volume.rays import Extent, Rays
from jaxcloseup.fields.volume.regularizers import distortion, proposal_penalty


def ngp_field(
    config: NgpConfig, extent: Extent, *, supervision: DepthSupervision | None = None
) -> RadianceField:
    """Return an Instant-NGP of the unit cube, or with `contracted` the unit ball, of coordinates.

    Parameters are `{"fine": ..., "proposal": ...}`: all proposals share one grid. There are no
    buffers. `supervision` adds a loss on depth, see `ray_field`.
    """

    def init(key: jax.Array, points: jax.Array, rgb: jax.Array) -> tuple[Params, tuple[()]]:
        del points, rgb
        keys = jax.random.split(key, 5)
        fine = init_part(keys[0], keys[1], config.grid, config.width, GEOMETRY)
        fine["color"] = init_color_network(keys[2], config)
        proposal = init_part(keys[3], keys[4], config.proposal, config.proposal_width)
        return {"fine": fine, "proposal": proposal}, ()

    def encode(
        table: jax.Array, rendered: bool, key: jax.Array | None, rays: Rays, edges: jax.Array
    ) -> jax.Array:
        """Return features at the middles of intervals."""
        del key
        grid = config.grid if rendered else config.proposal
        positions = rays.at_middles(edges)
        if config.contracted:
            positions = 0.5 * contract(positions)  # the ball of radius 2 fills the grid's cube
        return hash_features(table, grid, 0.5 * positions + 0.5).reshape(grid.size, -1)

    def penalty(params: Params, buffers: Any, histograms: list[Histogram]) -> jax.Array:
        del params, buffers
        *proposals, last = histograms
        total = jnp.asarray(sum(proposal_penalty(*last, *proposed) for proposed in proposals))
        if config.distortion_weight:
            total += config.distortion_weight * distortion(*last)
        return total

    return hash_field(
        config,
        extent,
        init=init,
        encode=encode,
        proposal=lambda params, index: params["proposal"],
        penalty=penalty,
        supervision=supervision,
    )
