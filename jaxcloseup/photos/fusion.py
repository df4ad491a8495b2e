"""Fuse depth maps into the one surface that many views agree on.

Fusion makes truncated signed distances of depth maps.

B. Curless and M. Levoy, "A Volumetric Method for Building Complex Models from Range Images", 1996:
the weighted mean over views of a point's signed distance to the surface that each sees, positive
before it, is 0 on the surface. Distances are cut at a truncation distance, and a view says nothing
about points farther behind its surface than that. Here each distance is that to the plane tangent
to the view's depth map, which is exact on planes whatever the angle; along the ray it is not.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.geometry.cameras import Camera, pixel_grid, points_to_pixels
from jaxcloseup.geometry.masks import in_bounds
from jaxcloseup.geometry.numerics import matmul, safe_divide
from jaxcloseup.geometry.visibility import sphere_in_view
from jaxcloseup.geometry.warp import backward_warp
from jaxcloseup.photos.depth_maps import gather_sources
from jaxcloseup.photos.views import camera_at, to_float


_BLOCK = 32  # voxels along each side of what is projected, or culled, as one
_GRAZING = 0.05  # cosine below which a surface seen so flatly is placed no more precisely


@struct.dataclass
class DepthMaps:
    """Depth maps of V views, with the planes tangent to them.

    Attributes:
      cameras: stacked cameras of the maps.
      values: `[V, H, W, 3]` of each pixel 1 / z-depth, the distance from the camera to the tangent
        plane in world units, and the weight of what it says; all 0 where it says nothing.
    """

    cameras: Camera
    values: jax.Array


class Fused(NamedTuple):
    """The surface that views show, seen from points `[...]`.

    Attributes:
      distance: `[...]` mean signed distance to the surface in truncation distances, from -1 to 1,
        positive before the surface; NaN where no view shows a surface.
      values: `[..., C]` mean of the values at the surface; 0 where no surface is within reach.
    """

    distance: jax.Array
    values: jax.Array


def prepare_depth_maps(cameras: Camera, depths: jax.Array, weight: jax.Array) -> DepthMaps:
    """Prepare depth maps for fusion.

    In a view, inverse depth is linear over a plane n . x = d: 1 / z = (n_x x' + n_y y' + n_z) / d
    at (x', y') = (x / z, y / z), so its gradient has the plane. Pixels weigh as much as they face
    the camera, and nothing beside the edges of the map, see `gather_sources`.

    Args:
      cameras: stacked cameras `[V]` of the maps.
      depths: `[V, H, W]` z-depths; 0 is undefined.
      weight: `[V, H, W]` weights in [0, 1].
    """
    chex.assert_equal_shape([depths, weight])
    sources = gather_sources(cameras, depths, weight)

    def tangents(camera: Camera, inverse: jax.Array) -> tuple[jax.Array, jax.Array]:
        center, focal = camera.intrinsics[2:], camera.intrinsics[:2]
        ray = (pixel_grid(*inverse.shape) - center[None, None]) / focal[None, None]
        down, right = jnp.gradient(inverse)
        x, y = right * focal[0], down * focal[1]
        z = inverse - ray[..., 0] * x - ray[..., 1] * y
        plane = safe_divide(jnp.ones_like(inverse), jnp.sqrt(x * x + y * y + z * z))
        length = jnp.sqrt(1 + jnp.sum(ray * ray, axis=-1))
        cosine = jnp.clip(plane * inverse / length, _GRAZING, 1)
        depth = safe_divide(jnp.ones_like(inverse), inverse)
        return jnp.maximum(plane, _GRAZING * length * depth), cosine

    plane, cosine = jax.vmap(tangents)(cameras, sources.inverse_depth)
    values = jnp.stack([sources.inverse_depth, plane, sources.trust * cosine], axis=-1)
    return DepthMaps(cameras, values)


def fuse(
    points: jax.Array, maps: DepthMaps, truncation: jax.Array | float, values: jax.Array
) -> Fused:
    """Fuse the surfaces that views show, at points.

    Args:
      points: `[N, 3]` in world units; neighbors in the list should be neighbors in the world,
        because neighbors in the list are culled together.
      maps: of V views.
      truncation: largest distance that counts, world units.
      values: `[V, H, W, C]`, such as colors, uint8 or float. A point gets the mean over the views
        whose surface is within reach; the nearer it is, the more it counts. C may be 0.
    """
    chex.assert_shape(points, (None, 3))
    count = len(points)
    chunk = max(1, min(_BLOCK**3, count))
    padded = jnp.pad(points, ((0, -count % chunk), (0, 0)), mode="edge").reshape(-1, chunk, 3)
    found = jax.lax.map(lambda some: _fuse_block(some, maps, truncation, values), padded)
    return jax.tree.map(lambda array: array.reshape(-1, *array.shape[2:])[:count], found)


def fuse_grid(
    corner: jax.Array,
    voxel: jax.Array | float,
    shape: tuple[int, int, int],
    maps: DepthMaps,
    truncation: jax.Array | float,
) -> jax.Array:
    """Compute distances `[X, Y, Z]` as `fuse` does, at the points of a grid, block by block.

    Args:
      corner: `[3]` the grid's first point; the others are at larger coordinates.
      voxel: distance between neighbors in world units.
      shape: number of points along each axis; static.
      maps: of V views.
      truncation: largest distance that counts, world units.

    Returns:
      Distances in truncation distances; NaN where no view shows a surface. Apart from them, memory
      holds only what one block needs.
    """
    blocks = [-(-side // _BLOCK) for side in shape]
    steps = jnp.stack(jnp.meshgrid(*3 * [jnp.arange(_BLOCK)], indexing="ij"), -1).reshape(-1, 3)
    nothing = jnp.zeros((*maps.values.shape[:3], 0), jnp.uint8)

    def distances(block: jax.Array) -> jax.Array:
        first = _BLOCK * jnp.stack(jnp.unravel_index(block, blocks))
        points = corner[None] + voxel * (first[None] + steps).astype(corner.dtype)
        return _fuse_block(points, maps, truncation, nothing).distance

    found = jax.lax.map(distances, jnp.arange(blocks[0] * blocks[1] * blocks[2]))
    found = found.reshape(*blocks, *3 * [_BLOCK]).transpose(0, 3, 1, 4, 2, 5)
    found = found.reshape(*(_BLOCK * count for count in blocks))
    return found[: shape[0], : shape[1], : shape[2]]


def _fuse_block(
    points: jax.Array, maps: DepthMaps, truncation: jax.Array | float, values: jax.Array
) -> Fused:
    """Fuse points that are culled together; see `fuse`."""
    center = jnp.mean(points, axis=0)
    radius = jnp.max(jnp.linalg.norm(points - center[None], axis=-1))

    def add(sums: _Sums, view: jax.Array) -> tuple[_Sums, None]:
        camera = camera_at(maps.cameras, view)
        visible = sphere_in_view(camera, matmul(center - camera.position, camera.rotation), radius)
        return jax.lax.cond(
            visible, lambda: _add_view(sums, points, maps, truncation, values, view), lambda: sums
        ), None

    none = jnp.zeros(len(points), points.dtype)
    nothing = jnp.zeros((len(points), values.shape[-1]), points.dtype)
    start = _Sums(none, none, none, nothing)
    sums, _ = jax.lax.scan(add, start, jnp.arange(len(maps.values)))
    return Fused(
        safe_divide(sums.distance, sums.weight, fill=jnp.nan),
        sums.values / jnp.where(sums.near > 0, sums.near, 1)[:, None],
    )


class _Sums(NamedTuple):
    """Sums over views at points `[N]`."""

    distance: jax.Array  # `[N]` weighted distances
    weight: jax.Array  # `[N]` weights of the distances
    near: jax.Array  # `[N]` weights of the values, which fall with the distance from the surface
    values: jax.Array  # `[N, C]` weighted values


def _add_view(
    sums: _Sums,
    points: jax.Array,
    maps: DepthMaps,
    truncation: jax.Array | float,
    values: jax.Array,
    view: jax.Array,
) -> _Sums:
    camera = camera_at(maps.cameras, view)
    landed, depth = points_to_pixels(camera, points)
    inverse, plane, weight = jnp.moveaxis(backward_warp(maps.values[view], landed), -1, 0)
    # With n . x = d for the plane and z for the point: (d - n . x) / |n| = (1 - z / depth) d / |n|.
    ahead = 1 - depth * inverse
    distance = ahead * plane / truncation
    # The image ends at the centers of its outermost pixels, beyond which nothing is interpolated.
    inside = in_bounds(landed - 0.5, camera.height - 1, camera.width - 1)
    reached = ahead >= -truncation * inverse
    weight = jnp.where(inside & (depth > 0) & reached, weight, 0)
    distance = jnp.clip(distance, -1, 1)
    share = weight * (1 - distance * distance) ** 2
    near, shown = sums.near, sums.values
    if values.shape[-1]:
        read = backward_warp(to_float(values[view]), landed)
        near, shown = near + share, shown + share[:, None] * read
    new = _Sums(sums.distance + weight * distance, sums.weight + weight, near, shown)
    return jax.tree.map(lambda total, before: total.astype(before.dtype), new, sums)
