"""The surfels that an image may show, picked before they are projected.

A window or a close-up shows a small part of a scene, and should cost no more than that part.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.rotations import quaternion_to_matrix
from jaxcloseup.geometry.visibility import sphere_in_view
from jaxcloseup.numerics import matmul, safe_norm
from jaxcloseup.splats.kernel import ALPHA_MIN
from jaxcloseup.splats.projection import LOW_PASS, MAX_LOG_SCALE, PIXEL_VARIANCE
from jaxcloseup.splats.surfels import Surfels


# Items that are computed at once. XLA repeats work in loops over arrays of less than 16 KiB.
_BLOCK = 8192


def may_show(
    surfels: Surfels, opacity: jax.Array, camera: Camera, *, near: float, antialias: bool
) -> jax.Array:
    """Whether an image may show each surfel, `[N]` bool; never wrongly no.

    A surfel is bounded by a sphere about its center. With `antialias` (see `project_discs`), a
    pixel displaces the point that its ray meets on the surfel's plane by at most z / f (1 + 1 / c),
    where c is the cosine between the ray and the normal: that widens the sphere.

    Args:
      surfels: `N` surfels.
      opacity: `[N]` in [0, 1].
      camera: one camera.
      near: z-depth before which nothing is drawn.
      antialias: whether discs are convolved with the pixel.
    """
    surfels, opacity, camera = lax.stop_gradient((surfels, opacity, camera))
    offset = surfels.means - camera.position[None]
    center = matmul(offset, camera.rotation)
    scale = jnp.exp(jnp.clip(jnp.max(surfels.log_scales, axis=-1), -MAX_LOG_SCALE, MAX_LOG_SCALE))
    cutoff = jnp.sqrt(2 * jnp.log(jnp.maximum(opacity / ALPHA_MIN, 1)))
    if antialias:
        normal = quaternion_to_matrix(surfels.quaternions)[..., 2]
        distance = safe_norm(offset)
        facing = jnp.abs(jnp.sum(offset * normal, axis=-1))
        # A plane seen from its edge has no bound: it is kept.
        displaced = (1 + distance / jnp.maximum(facing, 1e-30)) * jnp.abs(center[:, 2])
        per_pixel = jnp.sqrt(jnp.sum(camera.intrinsics[:2] ** -2.0))
        scale = jnp.hypot(scale, jnp.sqrt(PIXEL_VARIANCE) * per_pixel * displaced)
        margin = jnp.zeros_like(cutoff)
    else:
        margin = cutoff / jnp.sqrt(LOW_PASS)
    # The margins of the exact boxes, and more.
    radius, margin = 1.01 * cutoff * scale, margin + 0.1
    seen = sphere_in_view(camera, center, radius, margin=margin, near=near)
    return seen & (opacity >= ALPHA_MIN)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def map_shown(
    function: Callable[[Any, Any], Any], items: Any, shared: Any, shown: jax.Array
) -> Any:
    """`function(items, shared)` of those items alone that are shown, block by block.

    The derivative computes each block anew, so that nothing is kept for it.

    Args:
      function: maps arrays with a leading axis of items to others with the same axis, item by item.
      items: arrays `[N, ...]`.
      shared: what all items need, such as a camera.
      shown: `[N]` bool.

    Returns:
      The results of the shown items, in their order, then zeros: arrays with `N` rows or a few
      more, to fill the last block. Differentiable in items and `shared`.
    """
    rows, number = _rows(shown)
    first = jax.tree.map(lambda leaf: leaf[:1], items)
    shapes = jax.eval_shape(function, first, shared)
    results = jax.tree.map(
        lambda shape: jnp.zeros((rows.size, *shape.shape[1:]), shape.dtype), shapes
    )

    def add(block, results):
        at, picked, there = _pick(block, rows, number, items)
        found = function(picked, shared)
        return jax.tree.map(
            lambda all_, new: lax.dynamic_update_slice_in_dim(all_, _only(there, new), at, 0),
            results,
            found,
        )

    return lax.fori_loop(0, -(-number // _BLOCK), add, results)


def _map_shown_forward(function, items, shared, shown):
    return map_shown(function, items, shared, shown), (items, shared, shown)


def _map_shown_backward(function, residuals, cotangents):
    items, shared, shown = residuals
    rows, number = _rows(shown)

    def add(block, bars):
        at, picked, there = _pick(block, rows, number, items)
        bar = jax.tree.map(
            lambda leaf: _only(there, lax.dynamic_slice_in_dim(leaf, at, _BLOCK)), cotangents
        )
        _, pull_back = jax.vjp(function, picked, shared)
        items_bar, shared_bar = pull_back(bar)
        index = lax.dynamic_slice_in_dim(rows, at, _BLOCK)
        place = lambda all_, new: all_.at[index].set(new, mode="drop")  # noqa: E731
        return jax.tree.map(place, bars[0], items_bar), jax.tree.map(jnp.add, bars[1], shared_bar)

    zeros = jax.tree.map(jnp.zeros_like, (items, shared))
    return *lax.fori_loop(0, -(-number // _BLOCK), add, zeros), None


map_shown.defvjp(_map_shown_forward, _map_shown_backward)


def _rows(shown):
    """Indices of the shown items, then of none, in whole blocks; and how many are shown."""
    count = shown.shape[0]
    size = -(-count // _BLOCK) * _BLOCK
    rows = jnp.nonzero(shown, size=size, fill_value=count)[0].astype(jnp.int32)
    return rows, jnp.sum(shown, dtype=jnp.int32)


def _pick(block, rows, number, items):
    """Where a block starts, its items, and which of them are there."""
    at = block * _BLOCK
    index = lax.dynamic_slice_in_dim(rows, at, _BLOCK)
    picked = jax.tree.map(lambda leaf: leaf.at[index].get(mode="clip"), items)
    return at, picked, at + jnp.arange(_BLOCK, dtype=jnp.int32) < number


def _only(there, values):
    return jnp.where(there.reshape(-1, *(1,) * (values.ndim - 1)), values, 0)
