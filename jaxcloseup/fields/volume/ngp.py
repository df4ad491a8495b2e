"""Instant-NGP: a hash encoding and small networks (Müller et al., SIGGRAPH 2022).

Where the paper skips empty space by an occupancy grid, rays are cut by proposals (mip-NeRF 360),
whose shapes are static. Where it takes spherical harmonics of directions, these are encoded as a
NeRF's.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.volume.config import HashGridConfig, NgpConfig
from jaxcloseup.fields.volume.coordinates import contract
from jaxcloseup.fields.volume.depth_supervision import DepthSupervision
from jaxcloseup.fields.volume.encodings import positional_encoding
from jaxcloseup.fields.volume.hash_grid import hash_features, init_hash_grid
from jaxcloseup.fields.volume.intervals import IntervalConfig, Round, interval_field
from jaxcloseup.fields.volume.networks import apply_mlp, exponential_density, init_mlp
from jaxcloseup.fields.volume.rays import Rays
from jaxcloseup.fields.volume.regularizers import distortion, proposal_penalty
from jaxcloseup.fields.volume.renderer import Samples


_GEOMETRY = 16  # outputs of the density network; the first is the logarithm of density


def ngp_field(
    config: NgpConfig,
    *,
    near: float,
    far: float,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
    supervision: DepthSupervision | None = None,
) -> RadianceField:
    """Instant-NGP between z-depths `near` and `far`, in world units.

    The field's coordinates are `(position - center) * scale`; what matters should lie within the
    unit cube or, with `contracted`, the unit ball. Parameters are `{"fine": ..., "proposal": ...}`;
    there are no buffers. `supervision` adds a loss on depth, see `ray_field`.

    Raises:
      ValueError: the depth range is empty.
    """

    def init(key: jax.Array, points: jax.Array, rgb: jax.Array) -> tuple[Any, tuple[()]]:
        del points, rgb
        keys = jax.random.split(key, 5)
        fine = {
            "grid": init_hash_grid(keys[0], config.grid),
            "density": init_mlp(keys[1], (config.grid.size, config.width, _GEOMETRY)),
            "color": init_mlp(
                keys[2],
                (_GEOMETRY, *(config.width,) * config.color_layers, 3),
                ray_features=3 + 6 * config.direction_octaves,
            ),
        }
        proposal = {
            "grid": init_hash_grid(keys[3], config.proposal),
            "density": init_mlp(keys[4], (config.proposal.size, config.proposal_width, 1)),
        }
        return {"fine": fine, "proposal": proposal}, ()

    def geometry(part: Any, grid: HashGridConfig, rays: Rays, edges: jax.Array) -> jax.Array:
        """The density network's outputs at the middles of intervals, `[O, R * S]`."""
        positions = rays.at(0.5 * (edges[..., 1:] + edges[..., :-1])).reshape(3, -1)
        if config.contracted:
            positions = 0.5 * contract(positions)
        features = hash_features(part["grid"], grid, 0.5 * positions + 0.5)
        return apply_mlp(part["density"], features.reshape(grid.size, -1))

    def density(raw: jax.Array, edges: jax.Array) -> jax.Array:
        return scale * exponential_density(raw[0]).reshape(edges.shape[0], -1)

    def propose(params, buffers, key, rays, edges) -> Samples:
        del buffers, key
        return Samples(
            density(geometry(params["proposal"], config.proposal, rays, edges), edges), None
        )

    def render(params, buffers, key, rays, edges) -> Samples:
        del buffers, key
        raw = geometry(params["fine"], config.grid, rays, edges)
        looking = positional_encoding(rays.unit, config.direction_octaves)
        rgb = jax.nn.sigmoid(apply_mlp(params["fine"]["color"], raw, looking))
        shape = edges.shape[0], edges.shape[1] - 1
        return Samples(density(raw, edges), jnp.moveaxis(rgb.reshape(3, *shape), 0, -1))

    def penalty(params, buffers, histograms):
        del params, buffers
        *proposals, last = histograms
        total = sum(proposal_penalty(*last, *proposed) for proposed in proposals)
        if config.distortion_weight:
            total += config.distortion_weight * distortion(*last)
        return total

    counts = [count for count in (config.num_coarse, config.num_middle) if count]
    volume = IntervalConfig(near, far, config.spacing, config.background, config.chunk)
    return interval_field(
        volume,
        init=init,
        rounds=[*(Round(count, propose) for count in counts), Round(config.num_fine, render)],
        penalty=penalty,
        center=center,
        scale=scale,
        supervision=supervision,
    )
