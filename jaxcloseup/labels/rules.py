"""Label rules: which depth labels are made from, and how their loss joins the photographs'.

`PAPER` follows the paper's text, `RELEASED` its public script where the two differ, `POOLED` takes
the paper's depth and the script's loss. A step looks its rule up by name in `LABEL_RULES`.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import Rendering
from jaxcloseup.photos.views import Batch


Loss = tuple[jax.Array, dict[str, jax.Array]]


@jax.jit
def label_depth(
    rendering: Rendering, *, near: float = 0.0, far: float = math.inf, min_alpha: float = 0.5
) -> jax.Array:
    """Return the z-depth `[...]` of a rendering where labels can use it, 0 elsewhere.

    Labels cannot use depth where alpha is below `min_alpha`, nor depth outside [near, far]. It is
    compiled here, so that callers that are not compiled themselves get the same digits.
    """
    defined = rendering.alpha >= min_alpha
    defined &= (rendering.depth >= near) & (rendering.depth <= far)
    return jnp.where(defined, rendering.depth, 0)


def undivided_label_depth(rendering: Rendering, **limits: float) -> jax.Array:
    """Return `label_depth` of the sum of weighted depths, not divided by alpha, as released."""
    return label_depth(rendering._replace(depth=rendering.depth * rendering.alpha), **limits)


def add_label_loss(
    loss_of: Callable[[Batch, jax.Array], Loss],
    photographs: tuple[Batch, jax.Array],
    labels: tuple[Batch, jax.Array],
    weight: jax.Array,
) -> Loss:
    """Return (1 - w) L_c + w L_pl, each a mean over its own pixels; w = 1/2 in the paper.

    Args:
      loss_of: `(batch, key) -> (loss, metrics)`; the loss may be a tree, such as of a loss and its
        gradients.
      photographs: pixels of photographs, and a key.
      labels: labeled pixels, and a key.
      weight: `[]` w.

    Returns:
      The loss, and the metrics of both; those of labels as `label_<name>`.
    """
    photograph_loss, metrics = loss_of(*photographs)
    label_loss, label_metrics = loss_of(*labels)
    named = {f"label_{name}": value for name, value in label_metrics.items()}
    return _mix(weight, photograph_loss, label_loss), metrics | named


@jax.jit
def _mix(weight: jax.Array, photograph_loss: Any, label_loss: Any) -> Any:
    return jax.tree.map(lambda a, b: (1 - weight) * a + weight * b, photograph_loss, label_loss)


def pool_label_loss(
    loss_of: Callable[[Batch, jax.Array], Loss],
    photographs: tuple[Batch, jax.Array],
    labels: tuple[Batch, jax.Array],
    weight: jax.Array,
) -> Loss:
    """Return one mean over the pixels of both, as released. Arguments as in `add_label_loss`.

    Any `weight` above 0 counts as 1.
    """
    (batch, key), (labeled, _) = photographs, labels
    counts = (weight > 0).astype(labeled.weight.dtype)
    return loss_of(_pool(batch, labeled._replace(weight=counts * labeled.weight)), key)


def _pool(batch: Batch, labeled: Batch) -> Batch:
    """Return one batch with the pixels of both; `labeled` has one camera for all its pixels.

    Pixels alone do not need the size of their camera's image, which may differ. Labels have no
    measured depth.
    """
    count = labeled.weight.size
    size = {"height": batch.cameras.height, "width": batch.cameras.width}
    cameras = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), labeled.cameras.replace(**size)
    )
    unknown = jax.tree.map(
        lambda leaf: jnp.zeros((count, *leaf.shape[1:]), leaf.dtype), batch.measured
    )
    labeled = labeled._replace(cameras=cameras, measured=unknown)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), batch, labeled)


class LabelRule(NamedTuple):
    """Functions by which a step makes and weighs labels of single pixels.

    Attributes:
      depth: `(rendering, near=, far=) -> [...]`, the z-depth of labels, 0 where undefined.
      depth_key: `key -> key | None`, the random key with which virtual pixels are rendered for
        their depth; None renders without sampling noise. Photographs' depths never have it.
      loss: joins the losses of photographs and labels, as `add_label_loss` does.
    """

    depth: Callable[..., jax.Array] = label_depth
    depth_key: Callable[[Any], Any] = lambda key: None
    loss: Callable[..., Loss] = add_label_loss


PAPER = LabelRule()
POOLED = LabelRule(loss=pool_label_loss)
RELEASED = LabelRule(undivided_label_depth, lambda key: key, pool_label_loss)
LABEL_RULES = {"paper": PAPER, "pooled": POOLED, "released": RELEASED}
