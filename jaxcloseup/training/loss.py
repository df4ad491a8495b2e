"""The loss of a rendering, with its gradient taken in the same program, at once or in chunks."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import RadianceField, Rendering
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.photos.views import Batch


Loss = tuple[jax.Array, dict[str, jax.Array]]


def judge(
    field: RadianceField, rendering: Rendering, target_rgb: jax.Array, weight: jax.Array
) -> Loss:
    """Return `field.loss` of a rendering, with the rendering's overflow among the metrics.

    Args:
      field: field that rendered.
      rendering: rendering of pixels `[...]`.
      target_rgb: `[..., 3]` true colors.
      weight: `[...]` non-negative.

    Returns:
      The loss and its metrics, with `"overflow"`, float32, if the field has a static capacity.
    """
    loss, metrics = field.loss(rendering, target_rgb, weight)
    if rendering.overflow is not None:
        metrics = metrics | {"overflow": rendering.overflow.astype(jnp.float32)}
    return loss, metrics


def rendered_loss(
    params: Any,
    buffers: Any,
    batch: Batch,
    key: jax.Array | None,
    *,
    field: RadianceField,
    chunk: int | None = None,
    sequential: bool = False,
) -> Loss:
    """Return the loss of a batch's pixels as `field` renders them; only `params` get gradients.

    With `chunk`, differentiation renders that many pixels, takes their gradient and adds it to a
    sum, so nothing is kept for a backward pass and nothing is computed twice. The sum is exact,
    because a field's loss is a weighted mean over pixels. The chunks' renderings are then joined
    along the pixels and judged once, so every array of a rendering must be per pixel: an array that
    belongs to a whole rendering, such as `overflow`, could not be joined. Chunking changes the
    random draws. A field that renders only whole images gains nothing from it.

    Args:
      params: parameters of the field.
      buffers: buffers of the field.
      batch: pixels and their true colors.
      key: consumed by the rendering; None renders deterministically.
      field: static; renders, and defines the loss.
      chunk: static; pixels to differentiate at once, usually `field.gradient_chunk`; None for all.
      sequential: static; under `jax.vmap`, compute the chunks of one member after another. A chunk
        fills the cache of a CPU's core, which a whole batch of members would exceed.

    Returns:
      The loss and its metrics, from `judge`.
    """
    if chunk is None or _is_one_chunk(chunk, batch):
        return _at_once(field, params, buffers, batch, key)
    return _chunked(field, chunk, sequential, params, buffers, batch, key)


def rendered_gradient(
    params: Any,
    buffers: Any,
    batch: Batch,
    key: jax.Array | None,
    *,
    field: RadianceField,
    chunk: int | None = None,
    sequential: bool = False,
) -> tuple[Loss, Any]:
    """Return `rendered_loss` and its gradient by `params`, without another pass of JAX over it.

    Outside `jax.jit`, `jax.value_and_grad` would trace the loss in every step.
    """
    if chunk is None or _is_one_chunk(chunk, batch):
        return _at_once_forward(field, params, buffers, batch, key)
    return _chunked_forward(field, chunk, sequential, params, buffers, batch, key)


def bind_gradient(field: RadianceField, *, sequential: bool) -> Callable[..., Any]:
    """Return `(params, buffers, batch, key) -> (loss, gradients), metrics`, for rules of labels.

    Outside `jax.jit`, `jax.value_and_grad` of a sum of losses would trace them in every step.
    """

    def gradient_of(params: Any, buffers: Any, batch: Batch, key: jax.Array | None) -> Any:
        (loss, metrics), gradients = rendered_gradient(
            *(params, buffers, batch, key),
            field=field,
            chunk=field.gradient_chunk,
            sequential=sequential,
        )
        return (loss, gradients), metrics

    return gradient_of


def _is_one_chunk(chunk: int, batch: Batch) -> bool:
    return batch.pixels is None or len(batch.pixels) <= chunk


def _plain(
    field: RadianceField, params: Any, buffers: Any, batch: Batch, key: jax.Array | None
) -> Loss:
    rendering = field.render(params, buffers, batch.cameras, batch.pixels, key)
    loss, metrics = judge(field, rendering, batch.rgb, batch.weight)
    return loss + _depth_loss(field, rendering, batch), metrics


def _depth_loss(field: RadianceField, rendering: Rendering, batch: Batch) -> jax.Array:
    """Return what the field's loss on measured depth says, a mean over all pixels; 0 without."""
    if batch.measured is None or field.depth_loss is None:
        return jnp.zeros((), batch.rgb.dtype)
    return field.depth_loss(rendering, *batch.measured)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _at_once(
    field: RadianceField, params: Any, buffers: Any, batch: Batch, key: jax.Array | None
) -> Loss:
    return _plain(field, params, buffers, batch, key)


@functools.partial(jax.jit, static_argnums=0)
def _at_once_forward(
    field: RadianceField, params: Any, buffers: Any, batch: Batch, key: jax.Array | None
) -> tuple[Loss, Any]:
    # Outside `jax.jit`, JAX would compile what comes before and after the derivative apart, and
    # trace both in every step.
    of_params = jax.value_and_grad(functools.partial(_plain, field), has_aux=True)
    return of_params(params, buffers, batch, key)


def _scale_gradients(*arguments: Any) -> tuple[Any, None, None, None]:
    """Return the cotangents of a loss whose forward pass has taken the gradients already."""
    # The static arguments come first; then what the forward pass kept, and the cotangents.
    gradients, (cotangent, _) = arguments[-2:]
    return _times(cotangent, gradients), None, None, None


@jax.jit
def _times(factor: jax.Array, tree: Any) -> Any:
    return jax.tree.map(lambda leaf: factor * leaf, tree)


_at_once.defvjp(_at_once_forward, _scale_gradients)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def _chunked(
    field: RadianceField,
    chunk: int,
    sequential: bool,
    params: Any,
    buffers: Any,
    batch: Batch,
    key: jax.Array | None,
) -> Loss:
    del chunk, sequential
    return _plain(field, params, buffers, batch, key)


def _chunked_forward(
    field: RadianceField,
    chunk: int,
    sequential: bool,
    params: Any,
    buffers: Any,
    batch: Batch,
    key: jax.Array | None,
) -> tuple[Loss, Any]:
    add_up = functools.partial(_add_up, field, chunk)
    if sequential:
        add_up = jax.custom_batching.sequential_vmap(add_up)
    return add_up(params, buffers, batch, key)


def _add_up(
    field: RadianceField, chunk: int, params: Any, buffers: Any, batch: Batch, key: jax.Array | None
) -> tuple[Loss, Any]:
    """Return the loss and its gradients, one chunk of pixels after the other."""
    total, count = jnp.sum(batch.weight), batch.rgb.shape[0]

    def add_gradient(gradients: Any, piece: tuple[Batch, Any]) -> tuple[Any, Rendering]:
        pixels, key = piece

        def share_of_loss(params: Any) -> tuple[jax.Array, Rendering]:
            rendering = field.render(params, buffers, pixels.cameras, pixels.pixels, key)
            loss, _ = field.loss(rendering, pixels.rgb, pixels.weight)
            share = safe_divide(jnp.sum(pixels.weight), total)
            of_depth = _depth_loss(field, rendering, pixels) * (chunk / count)
            return loss * share + of_depth, rendering

        gradient, rendering = jax.grad(share_of_loss, has_aux=True)(params)
        return jax.tree.map(jnp.add, gradients, gradient), rendering

    pieces = _split(batch, chunk)
    keys = None if key is None else jax.random.split(key, pieces.rgb.shape[0])
    zeros = jax.tree.map(jnp.zeros_like, params)
    gradients, renderings = jax.lax.scan(add_gradient, zeros, (pieces, keys))
    rendering = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], renderings)
    loss, metrics = judge(field, rendering, batch.rgb, batch.weight)
    return (loss + _depth_loss(field, rendering, batch), metrics), gradients


_chunked.defvjp(_chunked_forward, _scale_gradients)


def _split(batch: Batch, chunk: int) -> Batch:
    """Split a batch into pieces of `chunk` pixels on a new leading axis.

    Pixels of weight 0, whose depth is not known, fill up the last piece.
    """
    count = batch.rgb.shape[0]
    fill = -count % chunk
    cameras = batch.cameras
    if cameras.intrinsics.ndim == 1:
        cameras = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), cameras)
    batch = batch._replace(cameras=cameras)
    padded = jax.tree.map(lambda x: jnp.concatenate([x, x[:1].repeat(fill, 0)]), batch)
    padded = padded._replace(weight=jnp.pad(batch.weight, (0, fill)))
    if batch.measured is not None:
        measured = jax.tree.map(lambda x: jnp.pad(x, (0, fill)), batch.measured)
        padded = padded._replace(measured=measured)
    return jax.tree.map(lambda x: x.reshape(-1, chunk, *x.shape[1:]), padded)
