"""The common parts of fields on hash grids: proposals, densities and colors.

Densities come from a small network on a grid's features, colors from a second one on the outputs of
the first (Instant-NGP, section 5.4). Where Instant-NGP skips empty space by an occupancy grid,
*proposals* cut rays into intervals, round after round (mip-NeRF 360, section 3): they are smaller
grids that learn where the rendered grid absorbs light. Their shapes are static.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.volume.config import HashGridConfig, NgpConfig, ZipNerfConfig
from jaxcloseup.fields.volume.depth_supervision import DepthSupervision
from jaxcloseup.fields.volume.hash_grid import init_hash_grid
from jaxcloseup.fields.volume.intervals import Histogram, IntervalConfig, Round, interval_field
from jaxcloseup.fields.volume.networks import (
    Params,
    apply_colors,
    apply_mlp,
    exponential_density,
    init_colors,
    init_mlp,
)
from jaxcloseup.fields.volume.rays import Extent, Rays
from jaxcloseup.fields.volume.renderer import Samples


GEOMETRY = 16  # outputs of the rendered density network; the first is the logarithm of density


def init_part(
    key_grid: jax.Array, key_density: jax.Array, grid: HashGridConfig, width: int, outputs: int = 1
) -> dict[str, Params]:
    """Initialize a grid and its density network of one hidden layer; keys are consumed."""
    return {
        "grid": init_hash_grid(key_grid, grid),
        "density": init_mlp(key_density, (grid.size, width, outputs)),
    }


def init_color_network(key: jax.Array, config: NgpConfig | ZipNerfConfig) -> Params:
    """Initialize the color network on a density network's outputs; `key` is consumed."""
    widths = (GEOMETRY, *(config.width,) * config.color_layers)
    return init_colors(key, widths, config.direction_octaves)


def proposal_counts(config: NgpConfig | ZipNerfConfig) -> list[int]:
    """Return the intervals of each proposal."""
    return [count for count in (config.num_coarse, config.num_middle) if count]


def hash_field(
    config: NgpConfig | ZipNerfConfig,
    extent: Extent,
    *,
    init: Callable[[jax.Array, jax.Array, jax.Array], tuple[Any, Any]],
    encode: Callable[[jax.Array, bool, jax.Array | None, Rays, jax.Array], jax.Array],
    proposal: Callable[[Params, int], Params],
    penalty: Callable[[Params, Any, list[Histogram]], jax.Array],
    supervision: DepthSupervision | None,
) -> RadianceField:
    """Return a field that renders the part `"fine"` of its parameters after rounds of proposals.

    Args:
      config: numbers of intervals, spacing, and chunking.
      extent: depths, and the field's coordinates.
      init: `(key, points [P, 3], rgb [P, 3]) -> (params, buffers)`.
      encode: `(table, rendered, key, rays, edges [R, S + 1]) -> [features, R * S]`, the features of
        intervals; `rendered` is False for proposals.
      proposal: `(params, index) -> part`, the parameters of one proposal.
      penalty: see `interval_field`.
      supervision: see `ray_field`.
    """

    def densities(raw: jax.Array, edges: jax.Array) -> jax.Array:
        return extent.scale * exponential_density(raw[0]).reshape(edges.shape[0], -1)

    def propose(
        index: int,
        params: Params,
        buffers: Any,
        key: jax.Array | None,
        rays: Rays,
        edges: jax.Array,
    ) -> Samples:
        del buffers
        part = proposal(params, index)
        raw = apply_mlp(part["density"], encode(part["grid"], False, key, rays, edges))
        return Samples(density=densities(raw, edges), rgb=None)

    def render(
        params: Params, buffers: Any, key: jax.Array | None, rays: Rays, edges: jax.Array
    ) -> Samples:
        del buffers
        part = params["fine"]
        raw = apply_mlp(part["density"], encode(part["grid"], True, key, rays, edges))
        rgb = apply_colors(part["color"], raw, rays, config.direction_octaves)
        return Samples(density=densities(raw, edges), rgb=rgb)

    counts = enumerate(proposal_counts(config))
    rounds = [Round(count, functools.partial(propose, index)) for index, count in counts]
    return interval_field(
        IntervalConfig(config.spacing, config.background, config.chunk),
        extent,
        init=init,
        rounds=[*rounds, Round(config.num_fine, render)],
        penalty=penalty,
        supervision=supervision,
    )
