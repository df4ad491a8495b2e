"""Smooth the depth of splats, as wide as these are, but not across edges.

Where splats lie loosely around a surface, the depth of a view jumps from splat to splat. From near
that tears what photographs show along the outlines of splats.
"""

import jax
import jax.numpy as jnp


_LEVELS = 7  # passes at most, which reach over 52 pixels (one standard deviation)
_SAMPLES = 4096  # pixels, about, that tell how rough a depth map is
# Range that is smoothed over, in units of the roughness. Steps between splats are inside; edges of
# objects are not, unless the splats' own steps are as high.
_RANGE = 20.0


def smooth_depth(depth: jax.Array, radius: jax.Array | float) -> jax.Array:
    """Smooth a depth map by an edge-avoiding wavelet transform.

    Each pass averages 3 x 3 pixels that lie twice as far apart as those of the pass before; pixels
    weigh less the more their depth differs (Dammertz et al. 2010, equation 5, of log depth). The
    range in which they count is a multiple of how far depth departs from its surroundings in half
    of the map.

    Args:
      depth: `[H, W]` z-depth; 0 is undefined, and stays so.
      radius: `[]` standard deviation of the smoothing in pixels; below 0.4 nothing changes.
    """
    # The passes' variances add up: 1/2 (1 + 4 + 16 + ...).
    variance = jnp.square(jnp.asarray(radius, depth.dtype))
    levels = jnp.round(jnp.log(6 * variance + 1) / jnp.log(4.0))
    levels = jnp.clip(levels, 0, _LEVELS).astype(jnp.int32)
    known = depth > 0
    log_depth = jnp.log(jnp.where(known, depth, 1))
    scale = _RANGE * _roughness(log_depth, known, jnp.left_shift(1, levels) // 2)

    def smooth(level: jax.Array, log_depth: jax.Array) -> jax.Array:
        return _pass(log_depth, known, jnp.left_shift(1, level), scale)

    smoothed = jnp.exp(jax.lax.fori_loop(0, levels, smooth, log_depth))
    return jnp.where(known & (levels > 0), smoothed, depth)


def _pass(log_depth: jax.Array, known: jax.Array, gap: jax.Array, scale: jax.Array) -> jax.Array:
    """Average 3 x 3 pixels `gap` apart, whose weights fall with their difference over `scale`."""
    height, width = log_depth.shape
    pad = 2 ** (_LEVELS - 1)
    values = jnp.pad(log_depth, pad, mode="edge")
    weights = jnp.pad(known.astype(log_depth.dtype), pad)
    total = jnp.zeros_like(log_depth)
    weight = jnp.zeros_like(log_depth)
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            start = pad + row * gap, pad + column * gap
            value = jax.lax.dynamic_slice(values, start, (height, width))
            near = jax.lax.dynamic_slice(weights, start, (height, width))
            far = jnp.square((value - log_depth) / scale)
            near = near * (2 - abs(row)) * (2 - abs(column)) * jnp.exp(-0.5 * far)
            total, weight = total + near * value, weight + near
    return jnp.where(weight > 0, total / jnp.where(weight > 0, weight, 1), log_depth)


def _roughness(log_depth: jax.Array, known: jax.Array, gap: jax.Array) -> jax.Array:
    """Return the median difference of a pixel's log depth and the mean of four around it, `[]`."""
    height, width = log_depth.shape
    every = max(1, round((log_depth.size / _SAMPLES) ** 0.5))
    rows, columns = jnp.meshgrid(
        jnp.arange(0, height, every), jnp.arange(0, width, every), indexing="ij"
    )
    shifts = [(rows, columns)]
    shifts += [(rows + sign * gap, columns) for sign in (-1, 1)]
    shifts += [(rows, columns + sign * gap) for sign in (-1, 1)]
    inside = [(jnp.clip(y, 0, height - 1), jnp.clip(x, 0, width - 1)) for y, x in shifts]
    center, *around = (log_depth[place] for place in inside)
    counted = jnp.all(jnp.stack([known[place] for place in inside]), axis=0)
    departure = jnp.abs(center - sum(around) / 4)
    rough = jnp.nanmedian(jnp.where(counted, departure, jnp.nan))
    return jnp.maximum(jnp.nan_to_num(rough), 1e-6)
