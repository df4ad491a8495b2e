"""Pseudo-labels of virtual close-up pixels: pose, depth, two warps, mask; the same for any field.

This is the one place where a label is made (section 3 of the paper's method):

    I'  backward warp: lift a virtual pixel with its rendered depth D', project it into the source
        view n, read the photograph I_n there.
    I*  union of forward warps: every pixel of every photograph, lifted with its own depth D_j and
        projected into the virtual view; the nearest wins.
    M   = |I' - I*| < epsilon in every channel, where both are defined.

Labels read the training photographs (`LabelSources`). No gradient flows through labels, depths or
poses.
"""

import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.geometry.cameras import Camera, pixels_to_points
from jaxcloseup.geometry.masks import rgb_consistent
from jaxcloseup.geometry.numerics import safe_divide, safe_norm
from jaxcloseup.geometry.poses import PoseSettings, four_anchors, sample_closeup_camera
from jaxcloseup.geometry.union_warp import SourceBlocks, block_sources, union_warp
from jaxcloseup.geometry.visibility import sample_where_visible
from jaxcloseup.geometry.warp import backward_warp, reads_unmixed
from jaxcloseup.photos.views import Views, camera_at, to_float


_RANKING_PIXELS = 256  # at least so many virtual pixels, and fewer than twice, rank photographs
_RANKING_TOLERANCE = 0.05  # largest relative depth error of a pixel that a photograph sees
SOURCE_TOLERANCE = 0.05
_ROUNDING = 1e-6  # of a cosine in float32


def _by_default(value: float) -> jax.Array:
    """Return a field whose default is an array that is made with each instance."""
    return struct.field(default_factory=functools.partial(jnp.float32, value))


class LabelSources(struct.PyTreeNode):
    """Training photographs as labels read them, V views.

    Attributes:
      views: the photographs.
      depths: `[V, H, W]` their z-depth D_j, rendered by the field after its first training and
        kept; 0 is undefined.
      blocks: their pixels with a depth, in blocks, for forward warps.
    """

    views: Views
    depths: jax.Array
    blocks: SourceBlocks


def label_sources(views: Views, depths: jax.Array) -> LabelSources:
    """Join photographs with their rendered z-depths `[V, H, W]`, once for many labels."""
    return LabelSources(views, depths, block_sources(views.cameras, depths, views.weight))


class PseudoSettings(struct.PyTreeNode):
    """Switches and tolerances of pseudo-labels; all are traced, so they stack into a sweep's arms.

    Attributes:
      pose: ranges that virtual cameras are drawn from.
      use_mask: `[]` 1 keeps labels where both warps agree in color, 0 keeps every defined label.
      rgb_tolerance: `[]` epsilon of the mask, the largest difference of a channel.
      depth_tolerance: `[]` relative; the source view's depth must confirm the label's; inf: off.
      fixed_anchors: `[]` 1 draws only the four fixed anchors of the paper's ablation.
      forward_label: `[]` 1 takes the color from the forward warps (released), 0 the backward one.
      leave_out_source: `[]` 1 keeps the source view out of the union that checks its label.
      label_loss_weight: `[]` weight of the labels' loss in a step, 1/2 in the paper; the
        photographs' loss has the rest. 0 turns labels off. A label rule that pools both losses
        treats every weight above 0 as 1.
      max_ray_angle: `[]` largest angle in radians between the rays of a virtual pixel and of its
        source; inf: off.
      num_sources: `[]` photographs whose colors are averaged: the source view, and the views that
        see most of the virtual pixels under small angles. 1 in the paper.
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
    source_tolerance: jax.Array = _by_default(SOURCE_TOLERANCE)
    lr_scale: jax.Array = _by_default(1)


class PseudoLabel(NamedTuple):
    """Colors of virtual pixels, and their weights.

    Attributes:
      rgb: `[..., 3]` the label.
      weight: `[...]` M times the photograph's weight: 0 where there is no label.
      backward: `[..., 3]` I', read from the source view; 0 where undefined.
      forward: `[..., 3]` I*, the z-buffered union of all views; 0 where nothing landed.
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


def sample_closeups(
    key: jax.Array, sources: LabelSources, settings: PseudoSettings, count: int
) -> Camera:
    """Draw `count` virtual close-up cameras, stacked; `key` is consumed."""

    def draw(key: jax.Array) -> Camera:
        return sample_virtual_camera(key, sources, settings)[0]

    return jax.vmap(draw)(jax.random.split(key, count))


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

    Equals `label_pixels` with `label_sources(views, depths)`, which costs as much as a label: make
    them once for many labels.
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

    Compiled here, so that steps, gate, audit and pictures of a run share a program and its digits.

    Args:
      camera: the virtual camera.
      pixels: `[..., 2]` its pixel centers.
      depth: `[...]` their rendered z-depth D'; 0 where undefined.
      source_index: index of the training view n that the backward warp reads.
      sources: the training photographs.
      settings: switches and tolerances.

    Returns:
      A `PseudoLabel` over `[...]`.
    """
    chex.assert_equal_shape_prefix([pixels, depth], depth.ndim)
    # Loops of traced length have no derivative; nothing may try to take one.
    given = camera, pixels, depth, sources, settings
    camera, pixels, depth, sources, settings = jax.lax.stop_gradient(given)
    views = sources.views
    # I': lift with D', read where points project, one photograph at a time: how many is traced.
    points = pixels_to_points(camera, pixels, depth)
    defined = depth > 0
    sample = points.reshape(-1, 3)[:: max(1, depth.size // _RANKING_PIXELS)]
    ranked = _rank_sources(camera, sample, source_index, sources, settings)

    def add_source(rank: jax.Array, sums: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        color, weight = _read_source(camera, points, ranked[rank], sources, settings)
        weight = jnp.where(defined, weight, 0).astype(points.dtype)
        known = (weight > 0).astype(color.dtype)
        new = known[..., None] * color, weight, known
        return jax.tree.map(jnp.add, sums, new)

    none = jnp.zeros(depth.shape, points.dtype)
    start = jnp.zeros((*depth.shape, 3), points.dtype), none, none
    count = jnp.clip(settings.num_sources.astype(jnp.int32), 1, len(views))
    colors, weight, known = jax.lax.fori_loop(0, count, add_source, start)
    defined = known > 0
    weight = safe_divide(weight, known)
    backward = safe_divide(colors, known[..., None])
    # I*: every training pixel, the nearest on each virtual pixel; 8-bit until it is compared.
    exclude = jnp.where(settings.leave_out_source > 0, source_index, -1)
    union = union_warp(sources.blocks, views.cameras, views.rgb, camera, pixels, exclude=exclude)
    forward = to_float(union.values)
    # M, or without the mask every pixel whose color is defined.
    agree = union.hit & rgb_consistent(backward, forward, settings.rgb_tolerance)
    from_forward = settings.forward_label > 0
    keep = jnp.where(settings.use_mask > 0, agree, union.hit | ~from_forward)
    rgb = jnp.where(from_forward, forward, backward)
    weight = jnp.where(defined & keep, weight, 0)
    return PseudoLabel(rgb, weight, backward, forward)


def _read_source(
    camera: Camera,
    points: jax.Array,
    index: jax.Array,
    sources: LabelSources,
    settings: PseudoSettings,
) -> tuple[jax.Array, jax.Array]:
    """Return colors of one view at points `[..., 3]`, and weights: 0 where it gives no label."""
    views = sources.views
    source, depth = camera_at(views.cameras, index), sources.depths[index]
    seen = sample_where_visible(
        source, depth, views.weight[index], points, settings.depth_tolerance
    )
    near_enough = _cosine_between(camera, source, points) >= _least_cosine(settings)
    known = (seen.weight > 0) & near_enough & reads_unmixed(views.weight[index], seen.pixels)
    color = backward_warp(to_float(views.rgb[index]), seen.pixels)
    return jnp.where(known[..., None], color, 0), jnp.where(known, seen.weight, 0)


def _rank_sources(
    camera: Camera,
    points: jax.Array,
    first: jax.Array | int,
    sources: LabelSources,
    settings: PseudoSettings,
) -> jax.Array:
    """Return the views' indices `[V]`: `first`, then by how well they see points `[N, 3]`.

    A view's score is the sum of cosines between its rays and the camera's, over the points that it
    sees.
    """
    views = sources.views

    def score(view: tuple[Camera, jax.Array, jax.Array]) -> jax.Array:
        source, depth, weight = view
        tolerance = jnp.minimum(settings.depth_tolerance, _RANKING_TOLERANCE)
        seen = sample_where_visible(source, depth, weight, points, tolerance)
        cosine = _cosine_between(camera, source, points)
        sees = (seen.weight > 0) & (cosine >= _least_cosine(settings))
        return jnp.sum(jnp.where(sees, cosine, 0))

    scores = jax.lax.map(score, (views.cameras, sources.depths, views.weight))
    return jnp.argsort(-scores.at[first].set(jnp.inf), stable=True)


def _cosine_between(camera: Camera, source: Camera, points: jax.Array) -> jax.Array:
    """Return the cosine `[...]` of the angle between two cameras' rays to points `[..., 3]`."""
    shape = (1,) * (points.ndim - 1) + (3,)
    ray, source_ray = (points - c.position.reshape(shape) for c in (camera, source))
    norms = safe_norm(ray) * safe_norm(source_ray)
    return safe_divide(jnp.sum(ray * source_ray, axis=-1), norms)


def _least_cosine(settings: PseudoSettings) -> jax.Array:
    return jnp.cos(jnp.minimum(settings.max_ray_angle, jnp.pi)) - _ROUNDING
