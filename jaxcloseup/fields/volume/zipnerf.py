"""Zip-NeRF: hash features of cones, over mip-NeRF 360's rounds of proposals (Barron et al., 2023).

A frustum's features are the mean over Gaussians in it, and a level whose cells are small against a
Gaussian counts less. The paper also hands the networks how much each level counted,
which is not done here; densities are exponential as in Instant-NGP, which learns faster at first.
"""

import functools
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
from jaxcloseup.fields.volume.encodings import positional_encoding
from jaxcloseup.fields.volume.hash_grid import hash_features, init_hash_grid
from jaxcloseup.fields.volume.intervals import IntervalConfig, Round, interval_field
from jaxcloseup.fields.volume.networks import apply_mlp, exponential_density, init_mlp
from jaxcloseup.fields.volume.regularizers import antialiased_proposal_penalty, distortion
from jaxcloseup.fields.volume.renderer import Samples


_GEOMETRY = 16  # outputs of the density network; the first is the logarithm of density
_PULSES = (0.03, 0.003)  # half widths of the blur of the interlevel loss, of each proposal


def zipnerf_field(
    config: ZipNerfConfig,
    *,
    near: float,
    far: float,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
    supervision: DepthSupervision | None = None,
) -> RadianceField:
    """A Zip-NeRF between z-depths `near` and `far`, in world units.

    The field's coordinates are `(position - center) * scale`; what matters should lie within the
    unit ball or, without `contracted`, the unit cube. Parameters are `{"fine": ..., "proposal":
    [...]}`; there are no buffers. `supervision` adds a loss on depth, see `ray_field`.

    Raises:
      ValueError: the depth range is empty.
    """
    counts = [count for count in (config.num_coarse, config.num_middle) if count]

    def init(key: jax.Array, points: jax.Array, rgb: jax.Array) -> tuple[Any, tuple[()]]:
        del points, rgb
        key_color, *keys = jax.random.split(key, 2 + len(counts))

        def part(key, grid, outputs):
            key_grid, key_density = jax.random.split(key)
            density = init_mlp(key_density, (grid.size, config.width, outputs))
            return {"grid": init_hash_grid(key_grid, grid), "density": density}

        fine = part(keys[0], config.grid, _GEOMETRY)
        widths = (_GEOMETRY, *(config.width,) * config.color_layers, 3)
        fine["color"] = init_mlp(key_color, widths, ray_features=3 + 6 * config.direction_octaves)
        return {"fine": fine, "proposal": [part(k, config.proposal, 1) for k in keys[1:]]}, ()

    def geometry(part, grid, points, key, rays, edges) -> jax.Array:
        positions, deviation = frustum_samples(key, rays, edges, points)
        shape, half = deviation.shape, 1.0  # half of the side of the cube that grids fill
        if config.contracted:
            deviation = deviation * contraction_scale(positions)
            positions, half = contract(positions), 2.0
        positions = (positions / half).reshape(3, -1)
        features = downweighted_features(
            part["grid"], grid, 0.5 * positions + 0.5, (0.5 / half * deviation).reshape(-1)
        )
        mean = jnp.mean(features.reshape(grid.size, -1, shape[-1]), axis=-1)
        return apply_mlp(part["density"], mean)

    def density(raw: jax.Array, edges: jax.Array) -> jax.Array:
        return scale * exponential_density(raw[0]).reshape(edges.shape[0], -1)

    def propose(index, params, buffers, key, rays, edges) -> Samples:
        del buffers
        part, points = params["proposal"][index], config.proposal_points
        raw = geometry(part, config.proposal, points, key, rays, edges)
        return Samples(density(raw, edges), None)

    def render(params, buffers, key, rays, edges) -> Samples:
        del buffers
        raw = geometry(params["fine"], config.grid, config.points, key, rays, edges)
        looking = positional_encoding(rays.unit, config.direction_octaves)
        rgb = jax.nn.sigmoid(apply_mlp(params["fine"]["color"], raw, looking))
        shape = edges.shape[0], edges.shape[1] - 1
        return Samples(density(raw, edges), jnp.moveaxis(rgb.reshape(3, *shape), 0, -1))

    def penalty(params, buffers, histograms):
        del buffers
        *proposals, last = histograms
        total = config.distortion_weight * distortion(*last)
        for proposed, pulse in zip(proposals, _PULSES[-len(proposals) :], strict=True):
            total += config.proposal_weight * antialiased_proposal_penalty(*last, *proposed, pulse)
        decay = mean_squares(params["fine"]["grid"], config.grid)
        decay += sum(mean_squares(part["grid"], config.proposal) for part in params["proposal"])
        return total + config.decay_weight * decay

    rounds = [Round(n, functools.partial(propose, i)) for i, n in enumerate(counts)]
    return interval_field(
        IntervalConfig(near, far, config.spacing, config.background, config.chunk),
        init=init,
        rounds=[*rounds, Round(config.num_fine, render)],
        penalty=penalty,
        center=center,
        scale=scale,
        supervision=supervision,
    )


def downweighted_features(
    table: jax.Array, grid: HashGridConfig, positions: jax.Array, deviation: jax.Array
) -> jax.Array:
    """Hash features of isotropic Gaussians (Zip-NeRF, eq. 4).

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
    """The mean square of each level's features, summed over levels (Zip-NeRF, section 2)."""
    starts = np.cumsum([0, *grid.entries])
    return sum(jnp.mean(jnp.square(table[i:j])) for i, j in itertools.pairwise(starts))
