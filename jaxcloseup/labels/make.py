"""Pseudo-labels for virtual close-up views: pose, depth, two warps, mask; the same for every field.

Labels are read from the training photographs (`LabelSources`). No gradient flows through labels,
depths or poses.
"""

import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.masks import depth_consistent, in_bounds, rgb_consistent
from jaxcloseup.geometry.numerics import safe_divide, safe_norm
from jaxcloseup.geometry.poses import PoseSettings, four_anchors, sample_closeup_camera
from jaxcloseup.geometry.union_warp import SourceBlocks, block_sources, union_warp
from jaxcloseup.geometry.visibility import sample_where_visible
from jaxcloseup.geometry.warp import backward_warp
from jaxcloseup.photos.views import Views, camera_at, to_float


# Photographs to blend are ranked on so many of the virtual pixels, or up to twice as many.
_RANKING_PIXELS = 256
_RANKING_TOLERANCE = 0.05
_SOURCE_TOLERANCE = 0.05
_ROUNDING = 1e-6  # of a cosine in float32


def _by_default(value: float) -> jax.Array:
    return struct.field(default_factory=functools.partial(jnp.float32, value))


class LabelSources(struct.PyTreeNode):
    """The training photographs with what labels need to read them, V views.

    Attributes:
      views: the photographs.
      depths: `[V, H, W]` their z-depth, rendered by the field after its first training and kept;
        0 is undefined.
      blocks: their pixels with a depth, in blocks, for forward warps.
    """

    views: Views
    depths: jax.Array
    blocks: SourceBlocks


def label_sources(views: Views, depths: jax.Array) -> LabelSources:
    """Join photographs with their rendered z-depths `[V, H, W]`, once for many labels."""
    return LabelSources(views, depths, block_sources(views.cameras, depths, views.weight))


class PseudoSettings(struct.PyTreeNode):
    """What makes a pseudo-label; every leaf is traced, so settings stack into the arms of a sweep.

    Attributes:
      pose: how virtual cameras are drawn.
      use_mask: `[]` 1 keeps labels where both warps agree in color, 0 keeps every defined label.
      rgb_tolerance: `[]` epsilon of the mask, the largest difference of a channel.
      depth_tolerance: `[]` relative; the source view's depth must confirm the label's; inf: off.
      fixed_anchors: `[]` 1 draws only the four fixed anchors of the paper's ablation.
      forward_label: `[]` 1 takes the color from the forward warps (released), 0 the backward one.
      leave_out_source: `[]` 1 keeps the source view out of the union that checks its label.
      label_loss_weight: `[]` weight of the labels' loss in a step, 1/2 in the paper; the
        photographs' loss has the rest. 0 turns labels off. A label rule that pools both losses
        treats all other weights alike.
      max_ray_angle: `[]` largest angle in radians between the rays of a virtual pixel and of its
        source; inf: off.
      num_sources: `[]` photographs whose colors are averaged: the source view, and those that see
        most of the virtual pixels under small angles. 1 in the paper.
      source_tolerance: `[]` relative depth tolerance for choosing a target view's source; inf
        ignores occlusion, as published.
      lr_scale: `[]` factor on the optimizer's updates in steps with labels.
    """

    pose: PoseSettings
    use_mask: jax.Array
    rgb_tolerance: jax.Array
    depth_tolerance: jax.Array
    fixed_anchors: jax.Array = _by_default(0)
    forward_label: jax.Array = _by_default(0)
    leave_out_source: jax.Array = _by_default(0)
    label_loss_weight: jax.Array = _by_default(0.5)
    max_ray_angle: jax.Array = _by_default(jnp.inf)
    num_sources: jax.Array = _by_default(1)
    source_tolerance: jax.Array = _by_default(_SOURCE_TOLERANCE)
    lr_scale: jax.Array = _by_default(1)


class PseudoLabel(NamedTuple):
    """Colors for virtual pixels, and how far to trust them.

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
    key: jax.Array, sources: LabelSources, settings: PseudoSettings
) -> tuple[Camera, jax.Array]:
    """Draw a virtual close-up camera and the index `[]` of its training view; `key` is consumed."""
    views, depths = sources.views, sources.depths
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
) -> PseudoLabel:
    """Label pixels of a virtual view from photographs `views` with z-depths `depths[V, H, W]`.

    The same as `label_pixels`, for callers that label once: blocks of sources are made anew.
    """
    return label_pixels(camera, pixels, depth, source_index, label_sources(views, depths), settings)


@jax.jit
def label_pixels(
    camera: Camera,
    pixels: jax.Array,
    depth: jax.Array,
    source_index: jax.Array | int,
    sources: LabelSources,
    settings: PseudoSettings,
) -> PseudoLabel:
    """Label pixels of a virtual view from the training photographs.

    It is compiled, because a run's steps, gate, audit and pictures all call it.

    Args:
      camera: the virtual camera.
      pixels: `[..., 2]` its pixel centers.
      depth: `[...]` their rendered z-depth D'; 0 where undefined.
      source_index: the training view n that the backward warp reads.
      sources: the training photographs.
      settings: tolerances and switches.

    Returns:
      A `PseudoLabel` over `[...]`.
    """
    chex.assert_equal_shape_prefix([pixels, depth], depth.ndim)
    views = sources.views
    # Backward: lift with D', read the source photographs where the points project.
    points = pixels_to_points(camera, pixels, depth)
    defined = depth > 0
    some = points.reshape(-1, 3)[:: max(1, depth.size // _RANKING_PIXELS)]
    ranked = _rank_sources(camera, some, source_index, sources, settings)

    def add_source(rank, sums):
        index = ranked[rank]
        color, weight = _read_source(camera, points, index, sources, settings)
        weight = jnp.where(defined, weight, 0)
        known = (weight > 0).astype(color.dtype)
        new = known[..., None] * color, weight, known
        return jax.tree.map(jnp.add, sums, new)

    none = jnp.zeros(depth.shape, points.dtype)
    count = jnp.clip(settings.num_sources.astype(jnp.int32), 1, len(views))
    colors, weight, known = jax.lax.fori_loop(
        0, count, add_source, (jnp.zeros((*depth.shape, 3), points.dtype), none, none)
    )
    defined = known > 0
    weight = safe_divide(weight, known)
    backward = safe_divide(colors, known[..., None])
    # Forward: every training pixel, the nearest on each virtual pixel.
    exclude = jnp.where(settings.leave_out_source > 0, source_index, -1)
    union = union_warp(sources.blocks, views.cameras, views.rgb, camera, pixels, exclude=exclude)
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


def _read_source(camera, points, index, sources, settings):
    """Colors of view `index` at points `[..., 3]`, and their weight: 0 where there is no label."""
    views, depths = sources.views, sources.depths
    source = camera_at(views.cameras, index)
    maps = depths[index], views.weight[index]
    landed, _, weight = sample_where_visible(source, *maps, points, settings.depth_tolerance)
    near_enough = _cosine_between(camera, source, points) >= _least_cosine(settings)
    known = (weight > 0) & near_enough
    color = backward_warp(to_float(views.rgb[index]), landed)
    return jnp.where(known[..., None], color, 0), jnp.where(known, weight, 0)


def _rank_sources(camera, points, first, sources, settings):
    """Indices `[V]` of the views: `first`, then those that see most of points `[N, 3]` best."""
    views = sources.views

    def score(view):
        source, depth, weight = view
        tolerance = jnp.minimum(settings.depth_tolerance, _RANKING_TOLERANCE)
        _, _, weight = sample_where_visible(source, depth, weight, points, tolerance)
        cosine = _cosine_between(camera, source, points)
        sees = (weight > 0) & (cosine >= _least_cosine(settings))
        return jnp.sum(jnp.where(sees, cosine, 0))

    scores = jax.lax.map(score, (views.cameras, sources.depths, views.weight))
    return jnp.argsort(-scores.at[first].set(jnp.inf), stable=True)


def _cosine_between(camera, source, points):
    """Cosine `[...]` of the angle between the rays of two cameras to points `[..., 3]`."""
    around = (1,) * (points.ndim - 1) + (3,)
    ours, theirs = (points - one.position.reshape(around) for one in (camera, source))
    norms = safe_norm(ours) * safe_norm(theirs)
    return safe_divide(jnp.sum(ours * theirs, axis=-1), norms)


def _least_cosine(settings):
    return jnp.cos(jnp.minimum(settings.max_ray_angle, jnp.pi)) - _ROUNDING


def label_views(
    cameras: Camera, target_depths: jax.Array, sources: LabelSources, settings: PseudoSettings
) -> Views:
    """Label whole views at known poses, for target views: pixels without a label weigh 0.

    Args:
      cameras: stacked `[Q]`.
      target_depths: `[Q, H, W]` rendered z-depth of these views; 0 where undefined.
      sources: the training photographs.
      settings: tolerances and switches.
    """
    pixels = pixel_grid(cameras.height, cameras.width)

    def one_view(target):
        camera, depth = target
        source = best_source(
            camera,
            sources.views,
            sources.depths,
            depth=depth,
            tolerance=settings.source_tolerance,
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
    tolerance: jax.Array | float = _SOURCE_TOLERANCE,
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
