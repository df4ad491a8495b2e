"""Which depths other photographs confirm, there and back: the two-warp idea of the paper's mask."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.masks import depth_consistent, in_bounds
from jaxcloseup.geometry.numerics import matmul, safe_divide, safe_norm
from jaxcloseup.geometry.warp import backward_warp
from jaxcloseup.photos.views import camera_at
from jaxcloseup.stereo.config import StereoConfig
from jaxcloseup.stereo.planes import relative_transforms


class Confirmed(NamedTuple):
    """What the neighbors of a photograph say of its depths.

    Attributes:
      count: `[H, W]` int32, how many of them confirm the depth.
      inverse_depth: `[H, W]` mean of the photograph's and of theirs that confirm it.
    """

    count: jax.Array  # type: ignore[assignment]  # hides a method of tuples
    inverse_depth: jax.Array


def count_consistent(
    cameras: Camera,
    planes: jax.Array,
    reference: jax.Array,
    neighbors: jax.Array,
    config: StereoConfig,
) -> Confirmed:
    """Count the neighbors whose planes confirm each depth of a photograph.

    A pixel's point is projected into the neighbor, lifted there onto the plane of the pixel that it
    falls on, and projected back. It is confirmed where it comes back to within
    `config.pixel_tolerance` pixels, and where the neighbor's plane crosses the pixel's own ray
    within `config.depth_tolerance` of its depth.

    Args:
      cameras: stacked cameras `[V]`, of size `H, W`.
      planes: `[V, 3, H, W]` planes of all photographs; an inverse depth of 0 is undefined.
      reference: `[]` int32, index of the photograph.
      neighbors: `[N]` int32, indices of others; -1 is none.
      config: tolerances.
    """
    camera, inverse = camera_at(cameras, reference), planes[reference, 0]
    pixels = pixel_grid(camera.height, camera.width)
    defined = inverse > 0
    depth = 1 / jnp.where(defined, inverse, 1)
    points = pixels_to_points(camera, pixels, depth)
    transforms = relative_transforms(camera, camera_at(cameras, jnp.maximum(neighbors, 0)))
    ends = jnp.concatenate([pixels, jnp.ones_like(pixels[..., :1])], axis=-1)

    def confirm(item: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        neighbor, matrix, offset = item
        other = camera_at(cameras, neighbor)
        landed, ahead = points_to_pixels(other, points)
        seen = defined & (ahead > 0) & in_bounds(landed, other.height, other.width)
        plane = backward_warp(jnp.moveaxis(planes[neighbor], 0, -1), landed, order=0)
        apart = landed - jnp.floor(landed) - 0.5
        observed = plane[..., 0] + jnp.sum(plane[..., 1:] * apart, axis=-1)
        seen &= (plane[..., 0] > 0) & (observed > 0) & (neighbor >= 0)
        back, _ = points_to_pixels(
            camera, pixels_to_points(other, landed, 1 / jnp.where(seen, observed, 1))
        )
        agrees = seen & (safe_norm(back - pixels) < config.pixel_tolerance)
        # The neighbor's inverse depth is slope . (x, y, 1), so the ray crosses its plane where
        # w = slope . (A p + b w).
        corner = jnp.floor(landed) + 0.5
        constant = plane[..., 0] - jnp.sum(plane[..., 1:] * corner, axis=-1)
        slope = jnp.concatenate([plane[..., 1:], constant[..., None]], axis=-1)
        there = jnp.sum(slope * matmul(ends, matrix.T), axis=-1)
        crossed = safe_divide(there, 1 - jnp.sum(slope * offset[None, None], axis=-1))
        return agrees & depth_consistent(crossed, inverse, config.depth_tolerance), crossed

    agree, crossed = jax.lax.map(confirm, (neighbors, *transforms))
    total = inverse + jnp.sum(jnp.where(agree, crossed, 0), axis=0)
    count = jnp.sum(agree, axis=0, dtype=jnp.int32)
    return Confirmed(count, total / (1 + count).astype(inverse.dtype))
