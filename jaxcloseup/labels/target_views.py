"""Labels of whole target views: their depths, their source photographs, and their pixels."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import Rendering
from jaxcloseup.fields.padding import render_unpadded
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.masks import depth_consistent, in_bounds
from jaxcloseup.geometry.warp import backward_warp
from jaxcloseup.labels.make import SOURCE_TOLERANCE, LabelSources, PseudoSettings, label_pixels
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.views import Views, camera_at


def render_depths(
    render: Callable[[Camera, jax.Array | None], Rendering],
    cameras: Camera,
    *,
    near: float = 0.0,
    far: float = math.inf,
    key: jax.Array | None = None,
    depth: Callable[..., jax.Array] = label_depth,
    sizes: Sequence[tuple[int, int]] | None = None,
    each: Callable[[Callable[[int], Any], Sequence[int]], Iterable[Any]] = map,
) -> jax.Array:
    """Render the z-depths `[V, H, W]` of whole views, for labels and anchors.

    Args:
      render: `(camera, key) -> Rendering` of a whole image; it may render again with more room
        where an image overflows.
      cameras: stacked `[V]`.
      near: smallest depth that labels can use, world units; 0 for close-ups, which may be nearer
        to the surface than any photograph.
      far: largest one.
      key: consumed by the renderings; None renders deterministically.
      depth: that of a `LabelRule`.
      sizes: width and height of each view without padding, whose depth is 0; None: none is padded.
      each: like `map`; may show progress.
    """
    count = cameras.intrinsics.shape[0]
    keys = [None] * count if key is None else jax.random.split(key, count)

    def one_view(view: int) -> jax.Array:
        camera = camera_at(cameras, view)
        size = (camera.width, camera.height) if sizes is None else sizes[view]
        seen = render_unpadded(render, camera, size, keys[view])
        return depth(seen, near=near, far=far)

    return jnp.stack(list(each(one_view, range(count))))


def label_views(
    cameras: Camera, target_depths: jax.Array, sources: LabelSources, settings: PseudoSettings
) -> Views:
    """Label whole target views; pixels without a label weigh 0.

    Args:
      cameras: stacked `[Q]`.
      target_depths: `[Q, H, W]` rendered z-depth of these views; 0 where undefined.
      sources: the training photographs.
      settings: switches and tolerances.
    """
    pixels = pixel_grid(cameras.height, cameras.width)

    def one_view(target: tuple[Camera, jax.Array]) -> tuple[jax.Array, jax.Array]:
        camera, depth = target
        source = best_source(
            camera, sources.views, sources.depths, depth=depth, tolerance=settings.source_tolerance
        )
        label = label_pixels(camera, pixels, depth, source, sources, settings)
        return label.rgb, label.weight

    rgb, weight = jax.lax.map(one_view, (cameras, target_depths))
    return Views(cameras, rgb, weight)


def best_source(
    camera: Camera,
    views: Views,
    depths: jax.Array,
    *,
    depth: jax.Array | None = None,
    tolerance: jax.Array | float = SOURCE_TOLERANCE,
) -> jax.Array:
    """Return the index `[]` of the training view that has most pixels landing in a camera's view.

    This is argmax_j tau_j of the paper's test-time fine-tuning, which ignores occlusion and may
    choose a photograph of the other side. With `depth`, only pixels that are visible in the
    camera's view count. Ties go to the lowest index.

    Args:
      camera: the virtual or target camera.
      views: training photographs.
      depths: `[V, H, W]` their rendered z-depth.
      depth: `[H, W]` rendered z-depth of `camera`, or None to count as published.
      tolerance: relative; largest distance of a visible pixel's depth in `camera` from `depth`.
    """
    pixels = pixel_grid(*depths.shape[1:])

    def count(view: tuple[Camera, jax.Array, jax.Array]) -> jax.Array:
        source, source_depth, weight = view
        points = pixels_to_points(source, pixels, source_depth)
        landed, landed_depth = points_to_pixels(camera, points)
        lands = in_bounds(landed, camera.height, camera.width) & (landed_depth > 0)
        if depth is not None:
            observed = backward_warp(depth[..., None], landed, order=0)[..., 0]
            lands &= depth_consistent(observed, landed_depth, tolerance)
        return jnp.sum(lands & (source_depth > 0) & (weight > 0))

    return jnp.argmax(jax.lax.map(count, (views.cameras, depths, views.weight)))
