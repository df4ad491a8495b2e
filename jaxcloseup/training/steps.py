"""Training steps, pure, for any field: on photographs alone, and with pseudo-labels beside them.

`field`, `optimizer`, `config`, `spread` and `sequential` are static: bind them with
`functools.partial` before `jax.jit`. Without it, a step of a field that renders whole images runs a
few compiled parts, and all kinds of steps share them.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxcloseup.fields.contract import RadianceField, Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.labels.make import LabelSources, PseudoSettings, label_pixels, label_sources
from jaxcloseup.labels.rules import LABEL_RULES, add_label_loss
from jaxcloseup.photos.views import Batch, Views
from jaxcloseup.photos.windows import Windows
from jaxcloseup.training.config import TrainConfig
from jaxcloseup.training.loss import Loss, bind_gradient, rendered_gradient
from jaxcloseup.training.parallel import Spread, in_a_loop
from jaxcloseup.training.sampling import DrawKeys, sample_batch, sample_closeup, sample_labels
from jaxcloseup.training.state import DrawLoss, Metrics, TrainState, update_state


def train_step(
    state: TrainState,
    views: Views | Windows,
    lr_scale: jax.Array | None = None,
    *,
    field: RadianceField,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
    spread: Spread = in_a_loop,
    sequential: bool = False,
    local: bool = False,
) -> tuple[TrainState, Metrics]:
    """Take one step on training photographs alone.

    Args:
      state: training state.
      views: training photographs.
      lr_scale: `[]` factor on the optimizer's updates; None: 1.
      field: static; field to train.
      optimizer: static.
      config: static.
      spread: how several draws are taken.
      sequential: static; see `rendered_loss`.
      local: static; touch only what the step sees, see `update_state`.

    Returns:
      The next state, and metrics: `loss`, `skipped` and those of the field. A step whose loss or
      gradient is not finite changes nothing but the count of steps; then `skipped` is 1, else 0.
    """
    return update_state(
        state,
        _photograph_loss(field, config, sequential),
        views,
        field=field,
        optimizer=optimizer,
        draws=config.num_windows,
        spread=spread,
        lr_scale=lr_scale,
        local=local,
    )


def _photograph_loss(field: RadianceField, config: TrainConfig, sequential: bool) -> DrawLoss:
    """Return the loss of one draw of `train_step`."""
    gradient_of = functools.partial(
        rendered_gradient, field=field, chunk=field.gradient_chunk, sequential=sequential
    )

    def draw(keys: DrawKeys, views: Views | Windows) -> Any:
        return sample_batch(keys.batch, views, config.num_rays), keys.render

    def gradient(params: Any, buffers: Any, drawn: Any) -> tuple[Loss, Any]:
        return gradient_of(params, buffers, *drawn)

    return DrawLoss(draw, gradient, lambda drawn: (drawn[0].cameras,))


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
    """Take a `closeup_step` on photographs `views` with z-depths `depths[V, H, W]`.

    Every step makes `label_sources` anew: make them once in a long training.
    """
    sources = label_sources(views, depths)
    return closeup_step(
        state, views, sources, settings, field=field, optimizer=optimizer, config=config
    )


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
    sequential: bool = False,
    local: bool = False,
) -> tuple[TrainState, Metrics]:
    """Take one step on training photographs and on one pseudo-labeled random close-up.

    L = (1 - w) L_c + w L_pl with w = `settings.label_loss_weight`, 1/2 in the paper, where L_pl is
    the mean over labeled pixels only, and 0 without any. The step draws the same photographs as
    `train_step` at the same count of steps, so that a control is paired.

    Args:
      state: training state.
      views: training photographs.
      sources: the training photographs, from `label_sources`.
      settings: virtual poses and masks.
      field: static; field to train.
      optimizer: static.
      config: static.
      spread, sequential, local: static; as in `train_step`.

    Returns:
      The next state, and metrics with `label_coverage`, the share of labeled virtual pixels; unless
      the rule pools both losses, also the field's metrics of the labeled pixels as `label_<name>`.
    """
    return update_state(
        state,
        _closeup_loss(field, config, sequential),
        (views, sources, settings),
        field=field,
        optimizer=optimizer,
        draws=config.num_windows,
        spread=spread,
        lr_scale=settings.lr_scale,
        local=local,
    )


def _closeup_loss(field: RadianceField, config: TrainConfig, sequential: bool) -> DrawLoss:
    """Return the loss of one draw of `closeup_step`."""
    rule, whole = LABEL_RULES[config.label_rule], config.num_label_rays is None
    gradient_of = bind_gradient(field, sequential=sequential)
    render = _render_pixels(field, sequential=sequential and not whole)

    def draw(keys: DrawKeys, data: Any) -> Any:
        views, sources, settings = data
        batch = sample_batch(keys.batch, views, config.num_rays)
        virtual = sample_closeup(keys.label, sources, settings, config.num_label_rays)
        return batch, keys.render, virtual, sources, settings

    def gradient(params: Any, buffers: Any, drawn: Any) -> tuple[Loss, Any]:
        batch, key_render, virtual, sources, settings = drawn
        camera = virtual.camera
        key_depth = rule.depth_key(virtual.key_depth)
        rendering = render(params, buffers, camera, virtual.pixels, key_depth)
        depth, pixels = _depth(rendering, depth=rule.depth), virtual.pixels
        if pixels is None:
            pixels = pixel_grid(camera.height, camera.width)
        label = label_pixels(camera, pixels, depth, virtual.source_index, sources, settings)
        labeled = Batch(camera, virtual.pixels, label.rgb, label.weight)
        add = add_label_loss if whole else rule.loss
        (value, gradients), metrics = add(
            functools.partial(gradient_of, params, buffers),
            (batch, key_render),
            (labeled, virtual.key_render),
            settings.label_loss_weight,
        )
        return (value, metrics | {"label_coverage": jnp.mean(label.weight)}), gradients

    return DrawLoss(draw, gradient, lambda drawn: (drawn[0].cameras, drawn[2].camera))


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
    sequential: bool = False,
    local: bool = False,
) -> tuple[TrainState, Metrics]:
    """Take one step on training photographs and on views labeled once, such as target views.

    The losses are added as in the paper; the photographs are those of `train_step`.

    Args:
      state: training state.
      views: training photographs.
      labels: from `label_views`, or windows of them.
      settings: `label_loss_weight` and `lr_scale` count.
      field: static.
      optimizer: static.
      config: static.
      spread: how several draws are taken.
      sequential, local: static; as in `train_step`.

    Returns:
      The next state and metrics; the field's metrics of the labeled pixels as `label_<name>`.
    """
    return update_state(
        state,
        _labeled_loss(field, config, sequential),
        (views, labels, settings),
        field=field,
        optimizer=optimizer,
        draws=config.num_windows,
        spread=spread,
        lr_scale=settings.lr_scale,
        local=local,
    )


def _labeled_loss(field: RadianceField, config: TrainConfig, sequential: bool) -> DrawLoss:
    """Return the loss of one draw of `labeled_step`."""
    gradient_of = bind_gradient(field, sequential=sequential)

    def draw(keys: DrawKeys, data: Any) -> Any:
        views, labels, settings = data
        photographs = sample_batch(keys.batch, views, config.num_rays), keys.render
        return photographs, sample_labels(keys.label, labels, config.num_label_rays), settings

    def gradient(params: Any, buffers: Any, drawn: Any) -> tuple[Loss, Any]:
        photographs, labeled, settings = drawn
        (loss, gradients), metrics = add_label_loss(
            functools.partial(gradient_of, params, buffers),
            photographs,
            labeled,
            settings.label_loss_weight,
        )
        return (loss, metrics), gradients

    return DrawLoss(draw, gradient, lambda drawn: (drawn[0][0].cameras, drawn[1][0].cameras))


def run_steps(
    step: Callable[[TrainState], tuple[TrainState, Metrics]],
    state: TrainState,
    *,
    count: jax.Array | int,
) -> tuple[TrainState, Metrics]:
    """Take `count` steps in one compiled loop; metrics are their means.

    `count` may be traced, so one compiled program serves any number of steps.

    Args:
      step: a step with everything but the state bound, such as
        `lambda state: train_step(state, views, field=field, optimizer=optimizer, config=config)`.
      state: training state.
      count: how many steps.
    """
    step = jax.jit(step)  # is traced once, though called twice
    _, shapes = jax.eval_shape(step, state)
    total = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def body(_: jax.Array, carry: tuple[TrainState, Metrics]) -> tuple[TrainState, Metrics]:
        state, total = carry
        state, metrics = step(state)
        return state, jax.tree.map(jnp.add, total, metrics)

    state, total = jax.lax.fori_loop(0, count, body, (state, total))
    return state, jax.tree.map(lambda leaf: leaf / jnp.asarray(count, leaf.dtype), total)


def _render_pixels(field: RadianceField, *, sequential: bool) -> Callable[..., Rendering]:
    def render(
        params: Any, buffers: Any, camera: Camera, pixels: jax.Array | None, key: jax.Array | None
    ) -> Rendering:
        return field.render(params, buffers, camera, pixels, key)

    return jax.custom_batching.sequential_vmap(render) if sequential else render


@functools.partial(jax.jit, static_argnames="depth")
def _depth(rendering: Rendering, *, depth: Callable[..., jax.Array]) -> jax.Array:
    return depth(rendering)
