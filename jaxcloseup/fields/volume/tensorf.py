"""TensoRF: a scene as sums of vector-matrix products (Chen et al., ECCV 2022).

Grids begin small and grow: arrays have the size of the last grid, and a grid of n vertices along
each side lies in their first n rows and columns, so nothing is compiled again. Where the paper
skips empty space by an alpha mask, a first round looks at densities alone, and a second one is cut
where the first saw something; both see the same factors.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.volume.config import TensorfConfig
from jaxcloseup.fields.volume.depth_supervision import DepthSupervision
from jaxcloseup.fields.volume.encodings import positional_encoding
from jaxcloseup.fields.volume.interpolation import weighted_rows
from jaxcloseup.fields.volume.intervals import Histogram, IntervalConfig, Round, interval_field
from jaxcloseup.fields.volume.networks import Params, apply_colors, apply_mlp, init_colors, init_mlp
from jaxcloseup.fields.volume.rays import Extent, Rays
from jaxcloseup.fields.volume.renderer import Samples


_PLANES = ((0, 1), (0, 2), (1, 2))  # axes of the matrix of each mode; its vector has the third
_LINES = (2, 1, 0)
_INITIAL = 0.1  # standard deviation of initial factors


class TensorfBuffers(struct.PyTreeNode):
    """Vertices along each side of the grid, `[]` int32."""

    vertices: jax.Array


def tensorf_field(
    config: TensorfConfig, extent: Extent, *, supervision: DepthSupervision | None = None
) -> RadianceField:
    """Return a TensoRF of the unit cube of the extent's coordinates.

    Positions outside the cube are moved to its surface. Parameters are factors `"density"` and
    `"color"`, each of planes `[3, N, N, C]` and lines `[3, N, C]`, a `"basis"` and a `"network"`;
    buffers are `TensorfBuffers`. `supervision` adds a loss on depth, see `ray_field`.
    """

    def init(key: jax.Array, points: jax.Array, rgb: jax.Array) -> tuple[Any, TensorfBuffers]:
        del points, rgb
        return _init_params(key, config), TensorfBuffers(jnp.asarray(config.sizes[0], jnp.int32))

    def density(
        params: Params, buffers: TensorfBuffers, rays: Rays, edges: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        positions = rays.at_middles(edges)
        total = jnp.sum(factor_products(params["density"], buffers.vertices, positions), (0, 1))
        per_field_unit = config.density_scale * jax.nn.softplus(total + config.density_shift)
        return positions, extent.scale * per_field_unit.reshape(edges.shape[0], -1)

    def look(
        params: Params, buffers: TensorfBuffers, key: jax.Array | None, rays: Rays, edges: jax.Array
    ) -> Samples:
        del key
        return Samples(density(params, buffers, rays, edges)[1], None)

    def render(
        params: Params, buffers: TensorfBuffers, key: jax.Array | None, rays: Rays, edges: jax.Array
    ) -> Samples:
        del key
        positions, absorbed = density(params, buffers, rays, edges)
        products = factor_products(params["color"], buffers.vertices, positions)
        features = apply_mlp(params["basis"], products.reshape(-1, positions.shape[1]))
        encoded = positional_encoding(features, config.octaves)
        return Samples(absorbed, apply_colors(params["network"], encoded, rays, config.octaves))

    def adapt(key: jax.Array, state: Any) -> Any:
        del key
        return _grow_when_due(state, config)

    field = interval_field(
        IntervalConfig(config.spacing, config.background, config.chunk),
        extent,
        init=init,
        rounds=[Round(config.num_coarse, look), Round(config.num_fine, render)],
        penalty=functools.partial(_penalty, config),
        supervision=supervision,
    )
    return field._replace(adapt=adapt)


def factor_products(factors: Any, vertices: jax.Array, positions: jax.Array) -> jax.Array:
    """Multiply matrices and vectors at positions (TensoRF, eq. 4), interpolated between vertices.

    Args:
      factors: planes `[3, N, N, C]`, of axes (x, y), (x, z) and (y, z), and lines `[3, N, C]`, of
        axes z, y and x.
      vertices: `[]` int32 vertices along each side; at most N.
      positions: `[3, M]` in [-1, 1]; others are taken to the nearest such position.

    Returns:
      `[3, C, M]`.
    """
    _, size, _, components = factors["planes"].shape
    last = (vertices - 1).astype(positions.dtype)
    scaled = jnp.clip(0.5 * positions + 0.5, 0, 1) * last
    low = jnp.clip(jnp.floor(scaled), 0, last - 1)
    share = jnp.stack([1 - (scaled - low), scaled - low])  # [2, 3, M] of the vertices around
    vertex = low.astype(jnp.int32)[None] + jnp.arange(2, dtype=jnp.int32)[:, None, None]
    first, second = (np.array(axes) for axes in zip(*_PLANES, strict=True))
    modes = jnp.arange(3, dtype=jnp.int32)[None, :, None]

    # [4, 3, M]: the corners of each plane's cell, and [2, 3, M]: the ends of each line's.
    rows = vertex[:, None, first] * size + vertex[None, :, second]
    rows = rows.reshape(4, 3, -1) + modes * size**2
    weights = (share[:, None, first] * share[None, :, second]).reshape(4, 3, -1)
    planes = weighted_rows(factors["planes"].reshape(-1, components), rows, weights)
    line = np.array(_LINES)
    rows, weights = vertex[:, line] + modes * size, share[:, line]
    return planes * weighted_rows(factors["lines"].reshape(-1, components), rows, weights)


def _init_params(key: jax.Array, config: TensorfConfig) -> Params:
    keys, size = jax.random.split(key, 4), max(config.sizes)
    inputs = config.appearance * (1 + 2 * config.octaves)
    return {
        "density": _init_factors(keys[0], size, config.density_components),
        "color": _init_factors(keys[1], size, config.color_components),
        "basis": init_mlp(keys[2], (3 * config.color_components, config.appearance)),
        "network": init_colors(keys[3], (inputs, config.width, config.width), config.octaves),
    }


def _penalty(
    config: TensorfConfig, params: Params, buffers: TensorfBuffers, histograms: list[Histogram]
) -> jax.Array:
    """Return the penalty of dense and rough factors, equal for all rays (TensoRF, section 4.3)."""
    vertices = buffers.vertices
    total = config.sparsity_weight * _mean_size(params["density"], vertices)
    for factors in (params["density"], params["color"]):
        total += config.smoothness_weight * _mean_step(factors, vertices)
    return jnp.broadcast_to(total, histograms[0].weights.shape[:1])


def _init_factors(key: jax.Array, size: int, components: int) -> dict[str, jax.Array]:
    keys = jax.random.split(key)
    planes = _INITIAL * jax.random.normal(keys[0], (3, size, size, components))
    return {"planes": planes, "lines": _INITIAL * jax.random.normal(keys[1], (3, size, components))}


def _mean_size(factors: dict[str, jax.Array], vertices: jax.Array) -> jax.Array:
    """Return the mean absolute factor, planes plus lines (TensoRF, eq. 11)."""
    inside = jnp.arange(factors["lines"].shape[1], dtype=jnp.int32) < vertices
    both = inside[:, None] & inside[None]
    lines = _mean(jnp.abs(factors["lines"]), inside[None, :, None])
    return lines + _mean(jnp.abs(factors["planes"]), both[None, :, :, None])


def _mean_step(factors: dict[str, jax.Array], vertices: jax.Array) -> jax.Array:
    """Return the mean squared step between neighbors in planes, on both axes (TensoRF, eq. 12)."""
    planes = factors["planes"]
    inside = jnp.arange(planes.shape[1], dtype=jnp.int32) < vertices
    both = (inside[:, None] & inside[None])[None, :, :, None]
    down = _mean(jnp.diff(planes, axis=1) ** 2, both[:, 1:])
    return down + _mean(jnp.diff(planes, axis=2) ** 2, both[:, :, 1:])


def _mean(values: jax.Array, inside: jax.Array) -> jax.Array:
    counted = jnp.broadcast_to(inside, values.shape)
    return jnp.sum(jnp.where(counted, values, 0)) / jnp.sum(counted).astype(values.dtype)


def _grow_when_due(state: Any, config: TensorfConfig) -> Any:
    # The step says how large the grid is, so that the next step makes up for a skipped one.
    growths = state.step // config.grow_every
    vertices = jnp.asarray(config.sizes, jnp.int32)[jnp.minimum(growths, config.growths)]

    def follow(state: Any) -> Any:
        due = state.buffers.vertices != vertices
        return jax.lax.cond(due, lambda s: _grown(s, vertices), lambda s: s, state)

    # In a batch of states, `follow` computes the growth in every step, due or not. The states share
    # their step, so that this ends when all have grown.
    return jax.lax.cond(growths <= config.growths, follow, lambda s: s, state)


def _grown(state: Any, vertices: jax.Array) -> Any:
    """Return the state with so many vertices, and with an Adam that begins anew."""
    size = state.params["density"]["lines"].shape[1]
    take = _resampling(size, state.buffers.vertices, vertices)

    def grow(factors: dict[str, jax.Array]) -> dict[str, jax.Array]:
        each = take.astype(factors["lines"].dtype)
        lines = jnp.einsum("ni,mic->mnc", each, factors["lines"], precision="highest")
        planes = jnp.einsum("ni,kj,mijc->mnkc", each, each, factors["planes"], precision="highest")
        return {"planes": planes, "lines": lines}

    def is_adam(part: Any) -> bool:
        return isinstance(part, optax.ScaleByAdamState)

    params = state.params | {name: grow(state.params[name]) for name in ("density", "color")}
    # Moments of other vertices say nothing of these. Adam's count, which corrects the bias of
    # moments that begin at 0, begins anew with them; that of the learning rate's decay goes on.
    opt_state = jax.tree.map(
        lambda part: jax.tree.map(jnp.zeros_like, part) if is_adam(part) else part,
        state.opt_state,
        is_leaf=is_adam,
    )
    return state.replace(params=params, buffers=TensorfBuffers(vertices), opt_state=opt_state)


def _resampling(size: int, old: jax.Array, new: jax.Array) -> jax.Array:
    """Return the matrix `[size, size]` that interpolates `old` vertices to `new`, same ends."""
    index = jnp.arange(size, dtype=jnp.int32)
    row, column = index[:, None], index[None]
    low, rest = jnp.divmod(row * (old - 1), new - 1)
    share = rest / (new - 1)
    matrix = jnp.where(column == low, 1 - share, jnp.where(column == low + 1, share, 0))
    return jnp.where(row < new, matrix, 0)
