"""Surfels: oriented discs with a Gaussian profile, the parameters of 2-D Gaussian splatting.

With a third scale, along the normal, they are the volumetric Gaussians of 3-D Gaussian splatting.

Parameters are stored before their activations, as logarithms and logits, so any number is valid.
"""

import math

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import lax

from jaxcloseup.fields.splats.spherical_harmonics import rgb_to_sh
from jaxcloseup.geometry.cameras import Camera, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.masks import in_bounds


class Surfels(struct.PyTreeNode):
    """`N` discs, or volumetric Gaussians, in world units.

    Attributes:
      means: `[N, 3]` centers.
      log_scales: `[N, 2]` logarithms of the standard deviations along the two tangents; `[N, 3]`,
        with that along the normal, of volumetric Gaussians.
      quaternions: `[N, 4]` (w, x, y, z), any length; the rotation's columns are the two tangents
        and the normal, in the world frame.
      opacity_logits: `[N]` logits of the opacity.
      sh: `[N, (L + 1)^2, 3]` spherical harmonics of the color.
    """

    means: jax.Array
    log_scales: jax.Array
    quaternions: jax.Array
    opacity_logits: jax.Array
    sh: jax.Array


_Best = tuple[jax.Array, jax.Array, jax.Array]  # smallest, second and third smallest


def surfels_from_points(
    key: jax.Array,
    points: jax.Array,
    rgb: jax.Array,
    *,
    capacity: int,
    sh_degree: int,
    opacity: float = 0.1,
    num_scales: int = 2,
) -> tuple[Surfels, jax.Array]:
    """Return randomly oriented surfels at points, as large as the gaps between them.

    Args:
      key: random key for the rotations, and for the choice of points where `P` exceeds `capacity`;
        consumed.
      points: `[P, 3]` world points; points that are not finite are dropped.
      rgb: `[P, 3]` colors in [0, 1].
      capacity: number `N` of rows; rows without a point are dead.
      sh_degree: degree `L` of the color's harmonics, 0 to 3; view-dependent ones start at 0.
      opacity: initial opacity.
      num_scales: 2 of discs, 3 of volumetric Gaussians.

    Returns:
      The surfels, and `alive [N]` bool, True where a row has a point.
    """
    chex.assert_shape([points, rgb], (None, 3))
    chex.assert_equal_shape([points, rgb])
    key_choice, key_rotation = jax.random.split(key)
    finite = jnp.all(jnp.isfinite(points), axis=-1)
    # A random choice of finite points, in their order where all fit.
    chosen = jax.random.permutation(key_choice, points.shape[0])
    chosen = chosen[jnp.argsort(~finite[chosen], stable=True)][:capacity]
    if capacity >= points.shape[0]:
        chosen = jnp.sort(chosen)
    alive = finite[chosen]
    points = jnp.where(alive[:, None], points[chosen], 0)
    gaps = neighbor_distance(points, alive)  # as published: discs that just touch
    constant = rgb_to_sh(rgb[chosen])[:, None]
    higher = jnp.zeros((points.shape[0], (sh_degree + 1) ** 2 - 1, 3), points.dtype)
    surfels = Surfels(
        means=points,
        log_scales=jnp.stack([jnp.log(gaps)] * num_scales, axis=-1),
        # Normal components are uniform over rotations; uniform ones would not be.
        quaternions=jax.random.normal(key_rotation, (points.shape[0], 4), points.dtype),
        opacity_logits=jnp.full(points.shape[0], math.log(opacity / (1 - opacity)), points.dtype),
        sh=jnp.concatenate([constant, higher], axis=1),
    )
    return jax.tree.map(lambda leaf: pad_rows(leaf, capacity), (surfels, alive))


def random_points(
    key: jax.Array, cameras: Camera, *, near: float, far: float, count: int
) -> jax.Array:
    """Return random world points `[count, 3]` that many cameras see, for captures without points.

    Eight times as many points are drawn, along random pixels of random cameras and uniformly in
    inverse depth. The points that lie in the images of the most cameras are kept.

    Args:
      key: random key; consumed.
      cameras: stacked `[V]`.
      near: smallest z-depth in world units.
      far: largest z-depth in world units.
      count: number of points.
    """
    key_view, key_pixel, key_depth = jax.random.split(key, 3)
    view = jax.random.randint(key_view, (8 * count,), 0, cameras.intrinsics.shape[0])
    size = jnp.array([[cameras.width, cameras.height]], jnp.float32)
    pixels = size * jax.random.uniform(key_pixel, (8 * count, 2))
    depth = 1 / jax.random.uniform(key_depth, (8 * count,), minval=1 / far, maxval=1 / near)
    chosen = jax.tree.map(lambda leaf: leaf[view], cameras)
    points = jax.vmap(pixels_to_points)(chosen, pixels, depth)

    def add(total: jax.Array, camera: Camera) -> tuple[jax.Array, None]:
        landed, depth = points_to_pixels(camera, points)
        inside = in_bounds(landed, camera.height, camera.width)
        return total + (inside & (depth > near)).astype(jnp.int32), None

    seen, _ = lax.scan(add, jnp.zeros(8 * count, jnp.int32), cameras)
    return points[jnp.argsort(-seen, stable=True)[:count]]


def pad_rows(array: jax.Array, rows: int) -> jax.Array:
    """Return the array with rows of zeros appended, `rows` in all."""
    return jnp.pad(array, ((0, rows - array.shape[0]), *((0, 0) for _ in array.shape[1:])))


def neighbor_distance(points: jax.Array, valid: jax.Array, *, rows: int = 256) -> jax.Array:
    """Return the root mean square distance `[P]` of points to their three nearest valid neighbors.

    The search is exact and compares all pairs, which takes a few seconds for 100k points. The
    result is at least sqrt(1e-7), so that duplicates keep a size. A point with fewer than three
    neighbors uses the neighbors it has.

    Args:
      points: `[P, 3]` points.
      valid: `[P]` bool; other points are no neighbors.
      rows: number of points compared at once; static.
    """
    count = points.shape[0]
    padded = jnp.pad(points, ((0, -count % rows), (0, 0)))
    # Invalid points are infinitely far from everything.
    others = jnp.where(jnp.pad(valid, (0, -count % rows))[:, None], padded, jnp.inf)
    blocks = others.reshape(-1, rows, 3)

    def nearest(start: jax.Array) -> jax.Array:
        here = lax.dynamic_slice_in_dim(padded, start, rows)
        here_index = start + jnp.arange(rows)

        def update(best: _Best, block: tuple[jax.Array, jax.Array]) -> tuple[_Best, None]:
            index, other = block
            squared = sum((here[:, None, i] - other[None, :, i]) ** 2 for i in range(3))
            squared = jnp.where(here_index[:, None] == index[None], jnp.inf, squared)
            # Keep the three smallest in each of `rows` lanes; the lanes are merged at the end.
            first = jnp.minimum(best[0], squared)
            squared = jnp.maximum(best[0], squared)
            second = jnp.minimum(best[1], squared)
            squared = jnp.maximum(best[1], squared)
            return (first, second, jnp.minimum(best[2], squared)), None

        infinite = jnp.full((rows, rows), jnp.inf, points.dtype)
        indices = jnp.arange(padded.shape[0]).reshape(-1, rows)
        best, _ = lax.scan(update, (infinite,) * 3, (indices, blocks))
        return -lax.top_k(-jnp.concatenate(best, axis=-1), 3)[0]

    starts = jnp.arange(0, padded.shape[0], rows)
    squared = lax.map(nearest, starts).reshape(-1, 3)[:count]
    mean = jnp.mean(squared, axis=-1, where=jnp.isfinite(squared))
    return jnp.sqrt(jnp.maximum(jnp.where(jnp.isfinite(mean), mean, 0), 1e-7))
