"""Training steps, pure, for any field: on photographs alone, and with pseudo-labels beside them.

`field`, `optimizer` and `config` are static: bind them with `functools.partial` before `jax.jit`.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxcloseup.field import RadianceField, Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.geometry.union_warp import SourceBlocks
from jaxcloseup.numerics import take_turns
from jaxcloseup.photographs import Batch, Views, sample_image, sample_pixels
from jaxcloseup.pseudo import PseudoSettings, make_label, sample_virtual_camera
from jaxcloseup.rendered_loss import rendered_loss


Metrics = dict[str, jax.Array]


@struct.dataclass
class TrainState:
    """Everything a step changes. Steps draw from `fold_in(key, step)`, so a resumed run repeats.

    Attributes:
      step: `[]` int32 steps taken.
      params: what the optimizer trains.
      buffers: what the field keeps besides.
      opt_state: the optimizer's state.
      key: the run's key, never changed.
    """

    step: jax.Array
    params: Any
    buffers: Any
    opt_state: Any
    key: jax.Array


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How much one step looks at.

    Attributes:
      num_rays: training pixels of a step; None takes one whole photograph.
      num_label_rays: pseudo-labeled pixels of a step; None takes the whole virtual image.
      perturbed_depth: render virtual depth with sampling noise, as released, not without (paper).
      undivided_depth: use depth not divided by alpha, as released, for labels.
      pooled_loss: one mean over all valid pixels, as released, not half of each mean (paper);
        for fields that render single pixels.
      gradient_chunk: pixels differentiated at once, see `rendered_loss`; None for all. With chunks,
        every leaf of the field's `aux` is per pixel.
    """

    num_rays: int | None = 1024
    num_label_rays: int | None = 1024
    perturbed_depth: bool = False
    undivided_depth: bool = False
    pooled_loss: bool = False
    gradient_chunk: int | None = None


def init_state(
    key: jax.Array,
    points: jax.Array,
    rgb: jax.Array,
    *,
    field: RadianceField,
    optimizer: optax.GradientTransformation,
) -> TrainState:
    """The state before the first step; `key` is consumed.

    Args:
      key: random key.
      points: `[P, 3]` initial points, for fields that start from them.
      rgb: `[P, 3]` their colors.
      field: what is trained.
      optimizer: how.
    """
    key_init, key_steps = jax.random.split(key)
    params, buffers = field.init(key_init, points, rgb)
    return TrainState(jnp.zeros((), jnp.int32), params, buffers, optimizer.init(params), key_steps)


def train_step(
    state: TrainState,
    views: Views,
    *,
    field: RadianceField,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
) -> tuple[TrainState, Metrics]:
    """One step on training photographs alone.

    Returns:
      The next state, and metrics: `loss`, `skipped` and those of the field. A step whose loss or
      gradient is not finite changes nothing but the count of steps; then `skipped` is 1, else 0.
    """
    key_step = jax.random.fold_in(state.key, state.step)
    key_batch, key_render, key_adapt, _ = jax.random.split(key_step, 4)
    batch = _sample_batch(key_batch, views, config)
    loss_of = functools.partial(rendered_loss, field=field, chunk=config.gradient_chunk)

    def loss(params):
        return loss_of(params, state.buffers, batch, key_render)

    return _update(state, loss, key_adapt, field, optimizer)


def pseudo_step(
    state: TrainState,
    views: Views,
    depths: jax.Array,
    settings: PseudoSettings,
    *,
    field: RadianceField,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
    sources: SourceBlocks | None = None,
) -> tuple[TrainState, Metrics]:
    """One step on training photographs and on one pseudo-labeled virtual close-up.

    L = (1 - s) L_c + s L_pl with `settings.label_loss_weight` s, 1/2 in the paper, where L_pl is the mean
    over labeled pixels only, and 0 without any. The photographs' draw is that of `train_step` at
    the same step, so that a control is paired.

    Args:
      state: what is trained.
      views: training photographs.
      depths: `[V, H, W]` their z-depth, from `render_depths`.
      settings: virtual poses and masks.
      field: static; what is trained.
      optimizer: static.
      config: static.
      sources: `block_sources(views.cameras, depths, views.weight)`; recomputed here if absent.

    Returns:
      The next state, and metrics with `label_coverage`, the share of labeled virtual pixels; where
      the two means are not pooled, the field's metrics of the labeled pixels as `label_<name>`.
    """
    key_step = jax.random.fold_in(state.key, state.step)
    key_batch, key_render, key_adapt, key_label = jax.random.split(key_step, 4)
    key_virtual, key_pixels, key_depth, key_virtual_render = jax.random.split(key_label, 4)
    batch = _sample_batch(key_batch, views, config)

    camera, source_index = sample_virtual_camera(key_virtual, views, depths, settings)
    pixels = _sample_virtual_pixels(key_pixels, camera, config.num_label_rays)
    label_pixels = pixel_grid(camera.height, camera.width) if pixels is None else pixels

    key_depth = key_depth if config.perturbed_depth else None

    def render(params, buffers, camera, pixels, key):
        return field.render(params, buffers, camera, pixels, key)

    def label_of(seen):
        depth = label_depth(seen, divided=not config.undivided_depth)
        data = source_index, views, depths, settings
        return make_label(camera, label_pixels, depth, *data, sources=sources)

    of_virtual = state.buffers, camera, pixels, key_depth

    loss_of = functools.partial(rendered_loss, field=field, chunk=config.gradient_chunk)
    if pixels is not None:
        label = label_of(take_turns(render)(jax.lax.stop_gradient(state.params), *of_virtual))

    def loss(params):
        if pixels is None:
            # The image that depth is taken from is the one that is judged.
            seen = render(params, *of_virtual)
            of_image = label_of(jax.lax.stop_gradient(seen))
            coverage = jnp.mean(of_image.weight)
            virtual_loss, virtual_metrics = field.loss(seen, of_image.rgb, of_image.weight)
        else:
            coverage = jnp.mean(label.weight)
            virtual = Batch(camera, pixels, label.rgb, label.weight)
            if config.pooled_loss:
                some = (settings.label_loss_weight > 0).astype(label.weight.dtype)
                pooled = _pool(batch, virtual._replace(weight=some * label.weight))
                value, metrics = loss_of(params, state.buffers, pooled, key_render)
                return value, metrics | {"label_coverage": coverage}
            virtual_loss, virtual_metrics = loss_of(
                params, state.buffers, virtual, key_virtual_render
            )
        batch_loss, metrics = loss_of(params, state.buffers, batch, key_render)
        metrics = metrics | {f"label_{name}": value for name, value in virtual_metrics.items()}
        share = settings.label_loss_weight
        value = (1 - share) * batch_loss + share * virtual_loss
        return value, metrics | {"label_coverage": coverage}

    return _update(state, loss, key_adapt, field, optimizer, settings.rate)


def labeled_step(
    state: TrainState,
    views: Views,
    labels: Views,
    settings: PseudoSettings,
    *,
    field: RadianceField,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
) -> tuple[TrainState, Metrics]:
    """One step on training photographs and on views labeled once, for test-time fine-tuning.

    The loss is that of `pseudo_step`, never pooled; the photographs' draw is that of `train_step`.

    Args:
      state: what is trained.
      views: training photographs.
      labels: of `label_views`.
      settings: of which `label_loss_weight` and `rate` count.
      field: static.
      optimizer: static.
      config: static.
    """
    key_step = jax.random.fold_in(state.key, state.step)
    key_batch, key_render, key_adapt, key_label = jax.random.split(key_step, 4)
    key_label_batch, key_label_render = jax.random.split(key_label)
    batch = _sample_batch(key_batch, views, config)
    if config.num_label_rays is None:
        labeled = sample_image(key_label_batch, labels)
    else:
        labeled = sample_pixels(key_label_batch, labels, config.num_label_rays)
    loss_of = functools.partial(rendered_loss, field=field, chunk=config.gradient_chunk)

    def loss(params):
        batch_loss, metrics = loss_of(params, state.buffers, batch, key_render)
        label_loss, label_metrics = loss_of(params, state.buffers, labeled, key_label_render)
        share = settings.label_loss_weight
        value = (1 - share) * batch_loss + share * label_loss
        return value, metrics | {f"label_{name}": value for name, value in label_metrics.items()}

    return _update(state, loss, key_adapt, field, optimizer, settings.rate)


def run_steps(
    step: Callable[..., tuple[TrainState, Metrics]],
    state: TrainState,
    *data: Any,
    count: jax.Array | int,
) -> tuple[TrainState, Metrics]:
    """Take `count` steps `step(state, *data)` in one loop; metrics are their means.

    `count` may be traced, so one compiled program serves any number of steps.
    """
    _, shapes = jax.eval_shape(step, state, *data)
    total = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def body(_, carry):
        state, total = carry
        state, metrics = step(state, *data)
        return state, jax.tree.map(jnp.add, total, metrics)

    state, total = jax.lax.fori_loop(0, count, body, (state, total))
    return state, jax.tree.map(lambda leaf: leaf / jnp.asarray(count, leaf.dtype), total)


def render_depths(
    field: RadianceField,
    params: Any,
    buffers: Any,
    cameras: Camera,
    *,
    near: float,
    far: float,
    min_alpha: float = 0.5,
    key: jax.Array | None = None,
    divided: bool = True,
) -> jax.Array:
    """Z-depths `[V, H, W]` of whole views, one after the other, for labels and anchors.

    Depth is 0, undefined, where alpha is under `min_alpha` or depth outside [near, far]. The
    released script renders with sampling noise (`key`) and does not divide by alpha (`divided`).
    Of surfels, `overflow` goes unseen here: render one by one where pairs may not fit.
    """

    def one_view(view):
        camera, key = view
        seen = field.render(params, buffers, camera, None, key)
        return label_depth(seen, near=near, far=far, min_alpha=min_alpha, divided=divided)

    keys = None if key is None else jax.random.split(key, cameras.intrinsics.shape[0])
    return jax.lax.map(one_view, (cameras, keys))


def label_depth(
    rendering: Rendering,
    *,
    near: float = 0.0,
    far: float = math.inf,
    min_alpha: float = 0.5,
    divided: bool = True,
) -> jax.Array:
    """Z-depth `[...]` of a rendering where it is fit for labels, else 0: see `render_depths`."""
    depth = rendering.depth if divided else rendering.depth * rendering.alpha
    defined = (rendering.alpha >= min_alpha) & (depth >= near) & (depth <= far)
    return jnp.where(defined, depth, 0)


def _sample_batch(key, views, config):
    if config.num_rays is None:
        return sample_image(key, views)
    return sample_pixels(key, views, config.num_rays)


def _sample_virtual_pixels(key, camera, count):
    """Pixel centers `[count, 2]`, drawn with replacement, or None for all."""
    if count is None:
        return None
    size = jnp.array([[camera.width, camera.height]])
    return jax.random.randint(key, (count, 2), 0, size).astype(jnp.float32) + 0.5


def _pool(batch, virtual):
    """One batch of the pixels of both; the second has one camera for all of its."""
    cameras = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (len(virtual.pixels), *leaf.shape)), virtual.cameras
    )
    return jax.tree.map(
        lambda *leaves: jnp.concatenate(leaves), batch, virtual._replace(cameras=cameras)
    )


def _update(state, loss, key_adapt, field, optimizer, rate=None):
    (value, metrics), gradients = jax.value_and_grad(loss, has_aux=True)(state.params)
    updates, opt_state = optimizer.update(gradients, state.opt_state, state.params)
    if rate is not None:
        updates = jax.tree.map(lambda leaf: rate.astype(leaf.dtype) * leaf, updates)
    after = state.replace(
        step=state.step + 1,
        params=optax.apply_updates(state.params, updates),
        opt_state=opt_state,
    )
    after = field.adapt(key_adapt, after)
    # One bad step must not spoil the run: it is skipped, whole, and counted.
    finite = jnp.isfinite(value)
    for leaf in jax.tree.leaves(gradients):
        finite &= jnp.all(jnp.isfinite(leaf))

    def kept(new, old):
        return jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, old)

    after = after.replace(
        params=kept(after.params, state.params),
        buffers=kept(after.buffers, state.buffers),
        opt_state=kept(after.opt_state, state.opt_state),
    )
    return after, {"loss": value, "skipped": 1 - finite.astype(jnp.float32)} | metrics
