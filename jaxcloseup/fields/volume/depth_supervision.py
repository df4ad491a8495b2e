"""Depth supervision by what photographs share (Deng et al., "Depth-supervised NeRF", 2022).

Structure from motion leaves points whose depths in photographs are known up to their reprojection
errors. A ray through such a point should end there: what absorbs its light should be distributed
like the point's depth. The loss draws its own rays, beside those of a step's pixels; where depth of
whole photographs is measured, the pixels themselves know theirs.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr

from jaxcloseup.geometry.cameras import Camera


_SMALL = 1e-5  # added to weights, as in the authors' code
# Standard deviation of measured depth, as a share of it: on drawn scenes, 95 in 100 pixels that
# stereo confirms are within twice that.
_DEVIATION = 0.005


class Sightings(NamedTuple):
    """Points in photographs of V cameras.

    Attributes:
      cameras: stacked `[V]`.
      view: `[N]` int32, the photograph of each sighting.
      pixels: `[N, 2]` where it shows the point.
      depth: `[N]` z-depth of the point there, world units.
      deviation: `[N]` standard deviation of that depth, world units.
    """

    cameras: Camera
    view: Any
    pixels: Any
    depth: Any
    deviation: Any


class PointSupervision(NamedTuple):
    """A loss on the depth of rays through known points, which each step draws.

    Attributes:
      sightings: the points, at least one.
      weight: weight of the loss.
      share: rays through points in a step, as a share of its pixels.
    """

    sightings: Sightings
    weight: float
    share: float


class PixelSupervision(NamedTuple):
    """A loss on the depth of a step's own pixels, where it is measured.

    Attributes:
      weight: weight of the loss.
    """

    weight: float


DepthSupervision = PointSupervision | PixelSupervision


def depth_divergence(
    edges: jax.Array, weights: jax.Array, depth: jax.Array, deviation: jax.Array
) -> jax.Array:
    """Compute the KL divergence of a ray's light from a normal depth (DS-NeRF, eq. 5).

    The light has the constant density `weights / widths` in each interval, so the integral over
    normally distributed depths is a sum over intervals with their shares of the normal
    distribution, which the paper approximates by its value at each sample.

    Args:
      edges: `[..., S + 1]` ascending z-depths.
      weights: `[..., S]` shares of the ray's light.
      depth: `[...]` mean of the normal distribution.
      deviation: `[...]` its standard deviation, positive.

    Returns:
      `[...]`.
    """
    chex.assert_axis_dimension(edges, -1, weights.shape[-1] + 1)
    below = ndtr((edges - depth[..., None]) / deviation[..., None])
    widths = jnp.maximum(jnp.diff(edges, axis=-1), jnp.finfo(edges.dtype).tiny)
    log_density = jnp.log(weights + _SMALL) - jnp.log(widths)
    entropy = 0.5 + jnp.log(deviation * (2 * jnp.pi) ** 0.5)
    return -entropy - jnp.sum(jnp.diff(below, axis=-1) * log_density, axis=-1)


def mean_divergence(
    supervision: PointSupervision,
    key: jax.Array,
    num_pixels: int,
    see: Callable[..., list[tuple[jax.Array, jax.Array]]],
) -> jax.Array:
    """Return the weighted loss `[]` of rays through points drawn at random.

    Args:
      supervision: what to draw from.
      key: consumed.
      num_pixels: pixels of the step.
      see: `(cameras [K], pixels [K, 2], key) -> [(edges, weights), ...]`, what each of a field's
        passes sees; all of them are supervised.
    """
    key_draw, key_see = jax.random.split(key)
    points = supervision.sightings
    count = max(1, round(supervision.share * num_pixels))
    drawn = jax.random.randint(key_draw, (count,), 0, len(points.view))
    view, pixels, depth, deviation = (jnp.asarray(x)[drawn] for x in points[1:])
    cameras = jax.tree.map(lambda leaf: leaf[view], points.cameras)
    passes = see(cameras, pixels, key_see)
    each = [depth_divergence(*seen, depth, deviation) for seen in passes]
    return supervision.weight * jnp.asarray(sum(jnp.mean(divergence) for divergence in each))


def measured_divergence(
    light: list[tuple[jax.Array, jax.Array]], depth: jax.Array, trust: jax.Array
) -> jax.Array:
    """Return the mean divergence `[]` of pixels from their measured depth, weighted by trust.

    Args:
      light: `[(edges [..., S + 1], weights [..., S]), ...]`, what each of a field's passes sees.
      depth: `[...]` z-depth in world units; 0 where it is unknown.
      trust: `[...]` in [0, 1]; 0 where it is unknown.
    """
    chex.assert_equal_shape([depth, trust])
    mean = jnp.where(trust > 0, depth, 1)
    each = [depth_divergence(*seen, mean, _DEVIATION * mean) for seen in light]
    return jnp.asarray(sum(jnp.mean(jnp.where(trust > 0, trust * kl, 0)) for kl in each))
