"""Training steps, pure, for any field: on photographs alone, and with pseudo-labels beside them.

`field`, `optimizer` and `config` are static: bind them with `functools.partial` before `jax.jit`.
Without it, a step whose field compiles its rendering itself, as that of surfels does, runs a few
compiled parts, and all kinds of steps share them.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.geometry.numerics import take_turns
from jaxcloseup.labels.make import (
    LabelSources,
    PseudoSettings,
    label_pixels,
    label_sources,
)
from jaxcloseup.labels.rules import LABEL_RULES, add_label_loss, label_depth
from jaxcloseup.photos.views import Batch, Views
from jaxcloseup.photos.windows import Windows
from jaxcloseup.training.config import TrainConfig
from jaxcloseup.training.loss import rendered_loss
from jaxcloseup.training.sampling import (
    Spread,
    draw_keys,
    in_a_loop,
    sample_batch,
    sample_closeup,
    sample_labels,
)


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
    views: Views | Windows,
    lr_scale: jax.Array | None = None,
    *,
    field: RadianceField,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
    spread: Spread = in_a_loop,
) -> tuple[TrainState, Metrics]:
    """One step on training photographs alone.

    Args:
      state: what is trained.
      views: training photographs.
      lr_scale: `[]` factor on the optimizer's updates; None: 1.
      field: static; what is trained.
      optimizer: static.
      config: static.
      spread: how several draws are taken.

    Returns:
      The next state, and metrics: `loss`, `skipped` and those of the field. A step whose loss or
      gradient is not finite changes nothing but the count of steps; then `skipped` is 1, else 0.
    """
    loss_of = functools.partial(rendered_loss, field=field, chunk=field.gradient_chunk)

    def loss(params, buffers, keys, views):
        batch = sample_batch(keys.batch, views, config.num_rays)
        return loss_of(params, buffers, batch, keys.render)

    return _update(state, loss, (views,), field, optimizer, config, spread, lr_scale)


def pseudo_step(
    state: TrainState,
    views: Views,
    depths: jax.Array,
    settings: PseudoSettings,
    *,
    field: RadianceField,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
) -> tuple[TrainState, Metrics]:
    """`closeup_step` on photographs `views` with z-depths `depths[V, H, W]`.

    The blocks of `label_sources` are made anew in every step: make them once in a long training.
    """
    sources = label_sources(views, depths)
    bound = {"field": field, "optimizer": optimizer, "config": config}
    return closeup_step(state, views, sources, settings, **bound)


def closeup_step(
    state: TrainState,
    views: Views | Windows,
    sources: LabelSources,
    settings: PseudoSettings,
    *,
    field: RadianceField,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
    spread: Spread = in_a_loop,
) -> tuple[TrainState, Metrics]:
    """One step on training photographs and on one pseudo-labeled random close-up.

    L = (1 - w) L_c + w L_pl with w = `settings.label_loss_weight`, 1/2 in the paper, where L_pl is
    the mean over labeled pixels only, and 0 without any. The step draws the same photographs as
    `train_step` at the same count of steps, so that a control is paired.

    Args:
      state: what is trained.
      sources: the training photographs, from `label_sources`.
      settings: virtual poses and masks.
      field: static; what is trained.
      optimizer: static.
      config: static.
      spread: how several draws are taken.

    Returns:
      The next state, and metrics with `label_coverage`, the share of labeled virtual pixels; unless
      the rule pools both losses, also the field's metrics of the labeled pixels as `label_<name>`.
    """
    rule = LABEL_RULES[config.label_rule]
    loss_of = functools.partial(rendered_loss, field=field, chunk=field.gradient_chunk)

    def render_pixels(params, buffers, camera, pixels, key):
        return field.render(params, buffers, camera, pixels, key)

    whole = config.num_label_rays is None
    render = render_pixels if whole else take_turns(render_pixels)

    def loss(params, buffers, keys, views, sources, settings):
        batch = sample_batch(keys.batch, views, config.num_rays)
        virtual = sample_closeup(keys.label, sources, settings, config.num_label_rays)
        camera = virtual.camera
        key_depth = rule.depth_key(virtual.key_depth)
        fixed = jax.lax.stop_gradient(params)
        rendering = render(fixed, buffers, camera, virtual.pixels, key_depth)
        depth, pixels = _depth(rendering, depth=rule.depth), virtual.pixels
        if pixels is None:
            pixels = pixel_grid(camera.height, camera.width)
        label = label_pixels(camera, pixels, depth, virtual.source_index, sources, settings)
        labeled = Batch(camera, virtual.pixels, label.rgb, label.weight)
        add = add_label_loss if whole else rule.loss
        value, metrics = add(
            lambda batch, key: loss_of(params, buffers, batch, key),
            (batch, keys.render),
            (labeled, virtual.key_render),
            settings.label_loss_weight,
        )
        return value, metrics | {"label_coverage": jnp.mean(label.weight)}

    data = views, sources, settings
    return _update(state, loss, data, field, optimizer, config, spread, settings.lr_scale)


def labeled_step(
    state: TrainState,
    views: Views | Windows,
    labels: Views | Windows,
    settings: PseudoSettings,
    *,
    field: RadianceField,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
    spread: Spread = in_a_loop,
) -> tuple[TrainState, Metrics]:
    """One step on training photographs and on views that were labeled once, such as target views.

    The losses are added as in the paper, never pooled. The step draws the same photographs as
    `train_step`.

    Args:
      state: what is trained.
      views: training photographs.
      labels: from `label_views`, or windows of such views.
      settings: `label_loss_weight` and `lr_scale` count.
      field: static.
      optimizer: static.
      config: static.
      spread: how several draws are taken.
    """
    loss_of = functools.partial(rendered_loss, field=field, chunk=field.gradient_chunk)

    def loss(params, buffers, keys, views, labels, settings):
        return add_label_loss(
            lambda batch, key: loss_of(params, buffers, batch, key),
            (sample_batch(keys.batch, views, config.num_rays), keys.render),
            sample_labels(keys.label, labels, config.num_label_rays),
            settings.label_loss_weight,
        )

    data = views, labels, settings
    return _update(state, loss, data, field, optimizer, config, spread, settings.lr_scale)


def run_steps(
    step: Callable[..., tuple[TrainState, Metrics]],
    state: TrainState,
    *data: Any,
    count: jax.Array | int,
) -> tuple[TrainState, Metrics]:
    """Take `count` steps `step(state, *data)` in one loop; metrics are their means.

    `count` may be traced, so one compiled program serves any number of steps.
    """
    step = jax.jit(step)  # is traced once, though called twice
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
    key: jax.Array | None = None,
    depth: Callable[..., jax.Array] = label_depth,
) -> jax.Array:
    """Z-depths `[V, H, W]` of whole views, one after the other, for labels and anchors.

    Nothing here tells whether a rendering overflowed: render views one by one where that can be.

    Args:
      field: what renders.
      params: its parameters.
      buffers: its buffers.
      cameras: stacked `[V]`.
      near: smallest depth that labels can use, world units.
      far: largest one.
      key: consumed by the renderings; None renders deterministically.
      depth: that of a `LabelRule`.
    """

    def one_view(view):
        camera, key = view
        return depth(field.render(params, buffers, camera, None, key), near=near, far=far)

    keys = None if key is None else jax.random.split(key, cameras.intrinsics.shape[0])
    return jax.lax.map(one_view, (cameras, keys))


@functools.partial(jax.jit, static_argnames="depth")
def _depth(rendering, *, depth):
    return depth(rendering)


def _update(state, loss, data, field, optimizer, config, spread, lr_scale=None):
    """The state after a step whose draws have `loss(params, buffers, keys, *data)`, and metrics."""
    keys, key_adapt = draw_keys(state.key, state.step, config.num_windows)

    def gradient(keys, params, buffers, *data):
        def of_params(params):
            return loss(params, buffers, keys, *data)

        return jax.value_and_grad(of_params, has_aux=True)(params)

    take = spread if config.num_windows > 1 else lambda give, *arguments: give(*arguments)
    (value, metrics), gradients = take(gradient, keys, state.params, state.buffers, *data)
    if lr_scale is None:
        lr_scale = jnp.ones(())
    arguments = state, key_adapt, value, gradients, lr_scale
    after, skipped = _advance(*arguments, update=optimizer.update, adapt=field.adapt)
    return after, {"loss": value, "skipped": skipped} | metrics


@functools.partial(jax.jit, static_argnames=("update", "adapt"))
def _advance(state, key, value, gradients, lr_scale, *, update, adapt):
    """The state after a step, and whether it was skipped, 0 or 1.

    A step whose loss or gradient is not finite must not spoil the run: it is skipped, whole, and
    counted.
    """
    finite = jnp.isfinite(value)
    for leaf in jax.tree.leaves(gradients):
        finite &= jnp.all(jnp.isfinite(leaf))

    updates, opt_state = update(gradients, state.opt_state, state.params)
    updates = jax.tree.map(lambda leaf: lr_scale.astype(leaf.dtype) * leaf, updates)
    new = optax.apply_updates(state.params, updates), opt_state
    # Selected, not in a branch of a conditional, which would copy everything once more.
    params, opt_state = jax.tree.map(
        lambda new, old: jnp.where(finite, new, old), new, (state.params, state.opt_state)
    )
    moved = state.replace(step=state.step + 1, params=params, opt_state=opt_state)

    def changed(state):
        return state.params, state.buffers, state.opt_state

    params, buffers, opt_state = jax.lax.cond(
        finite, lambda: changed(adapt(key, moved)), lambda: changed(moved)
    )
    after = moved.replace(params=params, buffers=buffers, opt_state=opt_state)
    return after, 1 - finite.astype(jnp.float32)
