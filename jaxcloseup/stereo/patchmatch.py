"""PatchMatch: good planes spread to their neighbors, and are refined by chance.

M. Bleyer, C. Rhemann and C. Rother, "PatchMatch Stereo", 2011; S. Galliani, K. Lasinger and K.
Schindler, "Massively Parallel Multiview Stereopsis by Surface Normal Diffusion", 2015; Q. Xu and W.
Tao, "Multi-Scale Geometric Consistency Guided Multi-View Stereo", 2019. Here every round tries one
batch of planes at all pixels at once, from coarse to fine.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.photos.views import camera_at
from jaxcloseup.stereo.config import StereoConfig
from jaxcloseup.stereo.matching import Photographs, match_planes
from jaxcloseup.stereo.planes import shift_planes


_STEEPEST = 4.0  # tangent of the largest tilt along one axis
_TILT = 20.0  # change of slopes that is tried, beside that of inverse depth
# Where each round looks for planes, in pixels along each of four directions: the cheapest of each
# group is tried.
_GROUPS = (1, 2, 3), (5, 9, 15)
_DIRECTIONS = (1, 0), (-1, 0), (0, 1), (0, -1)


class Matched(NamedTuple):
    """The best plane of each pixel so far.

    Attributes:
      planes: `[3, H, W]` inverse depth and its change per pixel along x and y.
      cost: `[H, W]` its cost, see `match_planes`.
    """

    planes: jax.Array
    cost: jax.Array


def sweep_planes(
    photographs: Photographs,
    reference: jax.Array,
    neighbors: jax.Array,
    near: jax.Array,
    far: jax.Array,
    config: StereoConfig,
) -> Matched:
    """Try planes parallel to the image at `config.sweep` depths, in equal ratios, everywhere."""
    shape = photographs.quads.shape[1:]
    share = jnp.linspace(0.0, 1.0, config.sweep)
    depths = jnp.exp((1 - share) * jnp.log(near) + share * jnp.log(far))
    flat = jnp.zeros((config.sweep, 3, *shape)).at[:, 0].set((1 / depths)[:, None, None])
    return _choose(flat, match_planes(photographs, reference, neighbors, flat, config))


def refine_planes(
    key: jax.Array,
    photographs: Photographs,
    reference: jax.Array,
    neighbors: jax.Array,
    matched: Matched,
    scale: jax.Array,
    config: StereoConfig,
) -> Matched:
    """Take one round: try the planes of pixels around, then changes of the best.

    Args:
      key: consumed.
      photographs: all photographs.
      reference: `[]` int32, index of the photograph.
      neighbors: `[N]` int32, see `match_planes`.
      matched: planes so far.
      scale: `[]` relative change of inverse depth that is tried.
      config: see there.
    """
    camera = camera_at(photographs.cameras, reference)

    def try_planes(matched: Matched, planes: jax.Array) -> Matched:
        costs = match_planes(photographs, reference, neighbors, planes, config)
        planes = jnp.concatenate([matched.planes[None], planes])
        return _choose(planes, jnp.concatenate([matched.cost[None], costs]))

    matched = try_planes(matched, _planes_around(matched))
    focal = camera.intrinsics[:2]
    return try_planes(matched, _changed(key, matched.planes, focal, scale))


def enlarge_planes(planes: jax.Array, height: int, width: int) -> jax.Array:
    """Return planes `[3, height, width]` at an image of about twice the size."""
    _, rows, columns = planes.shape
    ratio_y, ratio_x = rows / height, columns / width
    y, x = (jnp.arange(0.5, height) * ratio_y)[:, None], (jnp.arange(0.5, width) * ratio_x)[None]
    row, column = (jnp.floor(at).astype(jnp.int32) for at in (y, x))
    planes = planes[:, row, column]
    dx, dy = x - column.astype(x.dtype) - 0.5, y - row.astype(y.dtype) - 0.5
    planes = shift_planes(planes, dx, dy)
    return planes * jnp.array([1.0, ratio_x, ratio_y])[:, None, None]


def _choose(planes: jax.Array, costs: jax.Array) -> Matched:
    """Return the cheapest of planes `[K, 3, H, W]` at each pixel, the first of equals."""
    best = jnp.argmin(costs, axis=0)[None]
    cost = jnp.take_along_axis(costs, best, axis=0)[0]
    return Matched(jnp.take_along_axis(planes, best[:, None], axis=0)[0], cost)


def _planes_around(matched: Matched) -> jax.Array:
    """Return the cheapest planes of pixels in eight directions, continued to each pixel."""
    most = max(map(max, _GROUPS))
    padded = jnp.pad(matched.planes, ((0, 0), (most, most), (most, most)), mode="edge")
    padded_cost = jnp.pad(matched.cost, most, constant_values=2)
    shape = matched.planes.shape

    def best_of(steps: jax.Array) -> jax.Array:
        def look(step: jax.Array) -> Matched:
            dx, dy = step
            planes = jax.lax.dynamic_slice(padded, (0, most + dy, most + dx), shape)
            cost = jax.lax.dynamic_slice(padded_cost, (most + dy, most + dx), shape[1:])
            dx, dy = -step.astype(planes.dtype)
            return Matched(shift_planes(planes, dx, dy), cost)

        return _choose(*jax.lax.map(look, steps)).planes

    groups = np.array(_GROUPS)[:, None, :, None] * np.array(_DIRECTIONS)[None, :, None]
    return jax.lax.map(best_of, jnp.asarray(groups.reshape(-1, len(_GROUPS[0]), 2)))


def _changed(key: jax.Array, planes: jax.Array, focal: jax.Array, scale: jax.Array) -> jax.Array:
    """Return planes changed by chance: depth, slopes, and both, more and less."""
    shape = planes.shape[1:]
    draws = jax.random.uniform(key, (3, 2, *shape), minval=-1, maxval=1)
    inverse = planes[:1]
    slopes = planes[1:] * focal[:, None, None] / inverse  # tangents of the tilt

    def change(depth: jax.Array, tilt: jax.Array) -> jax.Array:
        changed = inverse * (1 + scale * depth[None])
        tilted = jnp.clip(slopes + scale * tilt, -_STEEPEST, _STEEPEST) * changed
        return jnp.concatenate([changed, tilted / focal[:, None, None]])

    return jnp.stack(
        [
            change(draws[0, 0], jnp.zeros_like(slopes)),
            change(jnp.zeros(shape), _TILT * draws[1]),
            change(0.3 * draws[0, 1], 0.3 * _TILT * draws[2]),
        ]
    )
