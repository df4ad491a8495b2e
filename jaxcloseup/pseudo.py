"""Pseudo-labels for virtual close-up views: pose, depth, two warps, mask; the same for every field.

`depths` are the z-depths `[V, H, W]` of the training views, rendered by the field after its first
training and kept; 0 is undefined. No gradient flows through labels, depths or poses.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.batch import Views, camera_at, to_float
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.masks import depth_consistent, in_bounds, rgb_consistent
from jaxcloseup.geometry.poses import PoseSettings, four_anchors, sample_closeup_camera
from jaxcloseup.geometry.union_warp import SourceBlocks, block_sources, union_warp
from jaxcloseup.geometry.warp import backward_warp


@struct.dataclass
class PseudoSettings:
    """What makes a pseudo-label; every leaf is traced, so settings stack into the arms of a sweep.

    Attributes:
      pose: how virtual cameras are drawn.
      use_mask: `[]` 1 keeps labels where both warps agree in colour, 0 keeps every defined label.
      rgb_tolerance: `[]` epsilon of the mask, largest difference of a channel.
      depth_tolerance: `[]` relative; the source view's depth must confirm the label's; inf: off.
      fixed_anchors: `[]` 1 draws only the four fixed anchors of the paper's ablation.
      forward_label: `[]` 1 takes the colour from the forward warps (released), 0 the backward one.
      leave_out_source: `[]` 1 keeps the source view out of the union that checks its label.
      label_share: `[]` share of the labels' loss in a step's, 1/2 in the paper; 0: no labels. Where
        both losses are pooled, any other share is as good.
    """

    pose: PoseSettings
    use_mask: jax.Array
    rgb_tolerance: jax.Array
    depth_tolerance: jax.Array
    fixed_anchors: jax.Array
    forward_label: jax.Array
    leave_out_source: jax.Array
    label_share: jax.Array


class PseudoLabel(NamedTuple):
    """Colours for virtual pixels, and how far to trust them.

    Attributes:
      rgb: `[..., 3]` the label.
      weight: `[...]` 1 where the label holds, 0 elsewhere.
      backward: `[..., 3]` I', read from the source view; 0 where undefined.
      forward: `[..., 3]` the z-buffered union of all views; 0 where nothing arrived.
    """

    rgb: jax.Array
    weight: jax.Array
    backward: jax.Array
    forward: jax.Array


def sample_virtual_camera(
    key: jax.Array, views: Views, depths: jax.Array, settings: PseudoSettings
) -> tuple[Camera, jax.Array]:
    """Draw a virtual close-up camera and the index `[]` of its training view; `key` is consumed."""
    key_view, key_pose = jax.random.split(key)
    index = jax.random.randint(key_view, (), 0, len(views))
    weight = views.weight[index]
    anchors = jnp.where(weight > 0, four_anchors(*weight.shape), 0)
    weight = jnp.where(settings.fixed_anchors > 0, anchors, weight)
    camera = camera_at(views.cameras, index)
    return sample_closeup_camera(key_pose, camera, depths[index], settings.pose, weight), index


def make_label(
    camera: Camera,
    pixels: jax.Array,
    depth: jax.Array,
    source_index: jax.Array | int,
    views: Views,
    depths: jax.Array,
    settings: PseudoSettings,
    *,
    sources: SourceBlocks | None = None,
) -> PseudoLabel:
    """Label pixels of a virtual view from the training photographs.

    Args:
      camera: the virtual camera.
      pixels: `[..., 2]` pixel centres of it.
      depth: `[...]` their rendered z-depth D'; 0 where undefined.
      source_index: the training view n that the backward warp reads.
      views: the training photographs.
      depths: `[V, H, W]` their rendered z-depth.
      settings: tolerances and switches.
      sources: `block_sources(views.cameras, depths, views.weight)`, if the caller labels often.

    Returns:
      A `PseudoLabel` over `[...]`.
    """
    chex.assert_equal_shape_prefix([pixels, depth], depth.ndim)
    if sources is None:
        sources = block_sources(views.cameras, depths, views.weight)
    # Backward: lift with D', read the source photograph where the point projects.
    source = camera_at(views.cameras, source_index)
    points = pixels_to_points(camera, pixels, depth)
    landed, landed_depth = points_to_pixels(source, points)
    image = to_float(views.rgb[source_index])
    maps = jnp.stack([depths[source_index], views.weight[source_index]], axis=-1)
    observed, weight = jnp.moveaxis(backward_warp(maps, landed, order=0), -1, 0)
    defined = (
        (depth > 0)
        & (landed_depth > 0)
        & in_bounds(landed, source.height, source.width)
        & (weight > 0)
        & depth_consistent(observed, landed_depth, settings.depth_tolerance)
    )
    backward = jnp.where(defined[..., None], backward_warp(image, landed), 0)
    # Forward: every training pixel, the nearest on each virtual pixel.
    exclude = jnp.where(settings.leave_out_source > 0, source_index, -1)
    union = union_warp(sources, views.cameras, views.rgb, camera, pixels, exclude=exclude)
    forward = to_float(union.values)
    agree = union.hit & rgb_consistent(backward, forward, settings.rgb_tolerance)
    from_forward = settings.forward_label > 0
    keep = jnp.where(settings.use_mask > 0, agree, union.hit | ~from_forward)
    label = PseudoLabel(
        rgb=jnp.where(from_forward, forward, backward),
        weight=jnp.where(defined & keep, weight, 0),
        backward=backward,
        forward=forward,
    )
    return jax.lax.stop_gradient(label)


def label_views(
    cameras: Camera,
    target_depths: jax.Array,
    views: Views,
    depths: jax.Array,
    settings: PseudoSettings,
    *,
    sources: SourceBlocks | None = None,
) -> Views:
    """Label whole views at known poses, for test-time fine-tuning: pixels without label weigh 0.

    Args:
      cameras: stacked `[Q]`.
      target_depths: `[Q, H, W]` rendered z-depth of these views; 0 where undefined.
      views: the training photographs.
      depths: `[V, H, W]` their rendered z-depth.
      settings: tolerances and switches.
      sources: as for `make_label`.
    """
    if sources is None:
        sources = block_sources(views.cameras, depths, views.weight)
    pixels = pixel_grid(cameras.height, cameras.width)

    def one_view(target):
        camera, depth = target
        source = best_source(camera, views, depths, depth=depth)
        data = source, views, depths, settings
        label = make_label(camera, pixels, depth, *data, sources=sources)
        return label.rgb, label.weight

    rgb, weight = jax.lax.map(one_view, (cameras, target_depths))
    return Views(cameras, rgb, weight)


def best_source(
    camera: Camera,
    views: Views,
    depths: jax.Array,
    *,
    depth: jax.Array | None = None,
    tolerance: float = 0.05,
) -> jax.Array:
    """The training view `[]` with most pixels landing in `camera` with their own depth.

    The paper's tau for test-time fine-tuning. As published it ignores occlusion, and may choose a
    photograph of the other side; given `depth`, only pixels that `camera` sees are counted. Ties go
    to the lowest index.

    Args:
      camera: the virtual or target camera.
      views: training photographs.
      depths: `[V, H, W]` their rendered z-depth.
      depth: `[H, W]` rendered z-depth of `camera`, or None to count as published.
      tolerance: relative, within which a pixel's depth in `camera` must be that of `depth`.
    """
    pixels = pixel_grid(*depths.shape[1:])

    def count(view):
        source, own_depth, weight = view
        landed, landed_depth = points_to_pixels(camera, pixels_to_points(source, pixels, own_depth))
        lands = in_bounds(landed, camera.height, camera.width) & (landed_depth > 0)
        if depth is not None:
            observed = backward_warp(depth[..., None], landed, order=0)[..., 0]
            lands &= depth_consistent(observed, landed_depth, tolerance)
        return jnp.sum(lands & (own_depth > 0) & (weight > 0))

    return jnp.argmax(jax.lax.map(count, (views.cameras, depths, views.weight)))


def count_seen(
    camera: Camera,
    pixels: jax.Array,
    depth: jax.Array,
    views: Views,
    depths: jax.Array,
    *,
    tolerance: float = 0.02,
) -> jax.Array:
    """How many training photographs saw the surface behind each pixel, `[...]` int32.

    A view saw a point that lands on a pixel of its photograph at a depth confirmed by its own depth
    map to a relative `tolerance`. Arguments as for `make_label`; pixels without depth count 0.
    """
    points = pixels_to_points(camera, pixels, depth)

    def add_view(count, view):
        source, view_depth, weight = view
        landed, landed_depth = points_to_pixels(source, points)
        maps = jnp.stack([view_depth, weight], axis=-1)
        observed, weight = jnp.moveaxis(backward_warp(maps, landed, order=0), -1, 0)
        confirmed = depth_consistent(observed, landed_depth, tolerance)
        saw = (depth > 0) & (weight > 0) & confirmed
        return count + saw.astype(jnp.int32), None

    count = jnp.zeros(depth.shape, jnp.int32)
    return jax.lax.scan(add_view, count, (views.cameras, depths, views.weight))[0]
