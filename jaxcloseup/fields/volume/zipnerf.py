"""Zip-NeRF: hash features of cones, over mip-NeRF 360's rounds of proposals (Barron et al., 2023).

A frustum's features are the mean over Gaussians in it, and a level whose cells are small against a
Gaussian counts less. The paper also hands the networks how much each level counted,
which is not done here; densities are exponential as in Instant-NGP, which learns faster at first.
"""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.volume.cones import frustum_samples
from jaxcloseup.fields.volume.config import HashGridConfig, ZipNerfConfig
from jaxcloseup.fields.volume.coordinates import contract, contraction_scale
from jaxcloseup.fields.volume.depth_supervision import DepthSupervision
from jaxcloseup.fields.volume.hash_fields import (
    GEOMETRY,
    hash_field,
    init_color_network,
    init_part,
    proposal_counts,
)
from jaxcloseup.fields.volume.hash_grid import hash_features
from jaxcloseup.fields.volume.intervals import Histogram
from jaxcloseup.fields.volume.networks import Params
from jaxcloseup.fields.volume.rays import Extent, Rays
from jaxcloseup.fields.volume.regularizers import antialiased_proposal_penalty, distortion


# Half widths of the pulses that blur the last round for each proposal (section 3). The wider one
# lets the first, coarser proposal learn of light that lies intervals away.
_PULSES = (0.03, 0.003)


def zipnerf_field(
    config: ZipNerfConfig, extent: Extent, *, supervision: DepthSupervision | None = None
) -> RadianceField:
    """Return a Zip-NeRF of the unit ball, or without `contracted` the unit cube, of coordinates.

    Parameters are `{"fine": ..., "proposal": [...]}`: each proposal has a grid. There are no
    buffers. `supervision` adds a loss on depth, see `ray_field`.
    """

    def init(key: jax.Array, points: jax.Array, rgb: jax.Array) -> tuple[Params, tuple[()]]:
        del points, rgb
        key_color, key_fine, *keys = jax.random.split(key, 2 + len(proposal_counts(config)))
        key_grid, key_density = jax.random.split(key_fine)
        fine = init_part(key_grid, key_density, config.grid, config.width, GEOMETRY)
        fine["color"] = init_color_network(key_color, config)
        pairs = [jax.random.split(key) for key in keys]
        proposals = [init_part(k[0], k[1], config.proposal, config.width) for k in pairs]
        return {"fine": fine, "proposal": proposals}, ()

    def encode(
        table: jax.Array, rendered: bool, key: jax.Array | None, rays: Rays, edges: jax.Array
    ) -> jax.Array:
        """Return mean features of Gaussians in frustums (eq. 1 to 5)."""
        grid, count = config.proposal, config.proposal_points
        if rendered:
            grid, count = config.grid, config.points
        positions, deviation = frustum_samples(key, rays, edges, count)
        shape, half = deviation.shape, 1.0  # half of the side of the cube that grids fill
        if config.contracted:
            deviation = deviation * contraction_scale(positions)
            positions, half = contract(positions), 2.0
        positions = (positions / half).reshape(3, -1)
        features = downweighted_features(
            table, grid, 0.5 * positions + 0.5, (0.5 / half * deviation).reshape(-1)
        )
        return jnp.mean(features.reshape(grid.size, -1, shape[-1]), axis=-1)

    def penalty(params: Params, buffers: Any, histograms: list[Histogram]) -> jax.Array:
        del buffers
        *proposals, last = histograms
        total = config.distortion_weight * distortion(*last)
        for proposed, pulse in zip(proposals, _PULSES[-len(proposals) :], strict=True):
            total += config.proposal_weight * antialiased_proposal_penalty(*last, *proposed, pulse)
        decay = mean_squares(params["fine"]["grid"], config.grid)
        decay += sum(mean_squares(part["grid"], config.proposal) for part in params["proposal"])
        return total + config.decay_weight * decay

    return hash_field(
        config,
        extent,
        init=init,
        encode=encode,
        proposal=lambda params, index: params["proposal"][index],
        penalty=penalty,
        supervision=supervision,
    )


def downweighted_features(
    table: jax.Array, grid: HashGridConfig, positions: jax.Array, deviation: jax.Array
) -> jax.Array:
    """Compute hash features of isotropic Gaussians (Zip-NeRF, eq. 4).

    Each level counts `erf(1 / sqrt(8 deviation^2 n^2))`, n being its cells along each side.

    Args:
      table: from `init_hash_grid`.
      grid: sizes.
      positions: `[3, M]` means in [0, 1].
      deviation: `[M]` in the same units.

    Returns:
      `[levels, features, M]`.
    """
    cells = jnp.asarray(np.array(grid.resolutions)[:, None], deviation.dtype)
    counts = jax.lax.erf(1 / (8**0.5 * jnp.maximum(deviation, 1e-12)[None] * cells))
    return hash_features(table, grid, positions) * counts[:, None]


def mean_squares(table: jax.Array, grid: HashGridConfig) -> jax.Array:
    """Sum the mean square of each level's features over levels (Zip-NeRF, section 2)."""
    starts = np.cumsum([0, *grid.entries])
    squares = [jnp.mean(jnp.square(table[i:j])) for i, j in itertools.pairwise(starts)]
    return jnp.asarray(sum(squares))
