"""Whether a view with a depth map sees points."""

import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, points_to_pixels
from jaxcloseup.geometry.masks import depth_consistent
from jaxcloseup.geometry.warp import backward_warp


def sample_where_visible(
    camera: Camera,
    depth: jax.Array,
    weight: jax.Array,
    points: jax.Array,
    tolerance: jax.Array | float,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where one photograph would show points, and what they weigh there if it does.

    Args:
      camera: of the photograph.
      depth: `[H, W]` its z-depth.
      weight: `[H, W]` of its pixels.
      points: `[..., 3]` in the world.
      tolerance: relative, within which its depth must confirm a point's.

    Returns:
      Pixels `[..., 2]`, z-depths `[...]`, and weights `[...]`: 0 outside of the photograph, behind
      its camera, and where its depth tells of another surface.
    """
    landed, landed_depth = points_to_pixels(camera, points)
    observed, found = (
        backward_warp(array[..., None], landed, order=0)[..., 0] for array in (depth, weight)
    )
    confirmed = depth_consistent(observed, landed_depth, tolerance)
    return landed, landed_depth, jnp.where(confirmed, found, 0)
