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
from jaxcloseup.splats.ellipsoids import bounded_slopes
from jaxcloseup.splats.filters import DILATION, LOW_PASS, PIXEL_VARIANCE
from jaxcloseup.splats.kernel import ALPHA_MIN
from jaxcloseup.splats.projection import MAX_LOG_SCALE
from jaxcloseup.splats.surfels import Surfels


_MANY = 2**14  # fewer items are not worth compiling everything twice
_PART = 4  # one of so many items is few


def may_show(
    surfels: Surfels, opacity: jax.Array, camera: Camera, *, near: float, antialias: bool
) -> jax.Array:
    """Whether an image may show each surfel, `[N]` bool; never wrongly no.

    A disc is bounded by a sphere about its center. With `antialias` (see `project_discs`), a pixel
    displaces the point that its ray meets on the disc's plane by at most z / f (1 + 1 / c), where c
    is the cosine between the ray and the normal: that widens the sphere. A volumetric Gaussian is
    bounded by a rectangle about its center's image, for its ellipse is not that of an ellipsoid.

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
    if surfels.log_scales.shape[1] == 3:
        seen = _ellipses_in_view(camera, center, cutoff, scale, near)
        return seen & (opacity >= ALPHA_MIN)
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


def _ellipses_in_view(camera, center, cutoff, scale, near):
    """Whether ellipses of `project_ellipsoids` may meet the image, with either filter."""
    x, y, depth = jnp.moveaxis(center, -1, 0)
    seen = depth > near
    inverse_depth = 1 / jnp.where(seen, depth, 1)
    slopes = [x * inverse_depth, y * inverse_depth]
    sides = zip(slopes, bounded_slopes(slopes, camera), (camera.width, camera.height), strict=True)
    for i, (slope, bounded, size) in enumerate(sides):
        focal, principal = camera.intrinsics[i], camera.intrinsics[2 + i]
        largest = focal * inverse_depth * scale
        variance = largest**2 * (1 + bounded**2) + DILATION
        half, at = 1.01 * cutoff * jnp.sqrt(variance) + 0.1, focal * slope + principal
        seen &= (at + half >= 0) & (at - half <= size)
    return seen


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def map_shown(
    function: Callable[[Any, Any], Any], items: Any, shared: Any, shown: jax.Array
) -> Any:
    """`function(items, shared)` of all items or, where few of many are shown, of those alone.

    The derivative computes everything anew, so that nothing is kept for it.

    Args:
      function: maps arrays with a leading axis of items to others with the same axis, item by item.
      items: arrays `[N, ...]`.
      shared: what all items need, such as a camera.
      shown: `[N]` bool.

    Returns:
      The results, arrays with `N` rows: of all items; or of the shown items, in their order, and
      then zeros. Differentiable in items and `shared`.
    """
    count = shown.size

    def of_few(index, there):
        found = _only(there, function(_pick(items, index), shared))
        return jax.tree.map(lambda leaf: _pad(leaf, count), found)

    def of_none():
        return _zeros(jax.eval_shape(function, items, shared))

    return _choose(shown, of_none, of_few, lambda: function(items, shared))


def _map_shown_forward(function, items, shared, shown):
    return map_shown(function, items, shared, shown), (items, shared, shown)


def _map_shown_backward(function, residuals, cotangents):
    items, shared, shown = residuals

    def of_few(index, there):
        _, pull_back = jax.vjp(function, _pick(items, index), shared)
        first = jax.tree.map(lambda leaf: leaf[: index.size], cotangents)
        picked_bar, shared_bar = pull_back(_only(there, first))
        place = lambda all_, new: all_.at[index].set(new, mode="drop")  # noqa: E731
        return jax.tree.map(place, _zeros(items), picked_bar), shared_bar

    def of_all():
        return jax.vjp(function, items, shared)[1](cotangents)

    return *_choose(shown, lambda: _zeros((items, shared)), of_few, of_all), None


map_shown.defvjp(_map_shown_forward, _map_shown_backward)


def _choose(shown, of_none, of_few, of_all):
    """`of_few(index, there)` with room for a part of the items, if that suffices; or `of_all()`."""
    # XLA computes what a conditional returns once; without one it computes most of the projection
    # anew for each column of what is made from it. So there is one for small numbers too.
    count, number = shown.size, jnp.sum(shown, dtype=jnp.int32)
    if count < _MANY:
        return lax.cond(number > 0, of_all, of_none)
    few = count // _PART

    def picked():
        index = jnp.nonzero(shown, size=few, fill_value=count)[0].astype(jnp.int32)
        return of_few(index, jnp.arange(few, dtype=jnp.int32) < number)

    return lax.cond(number <= few, picked, of_all)


def _pick(items, index):
    return jax.tree.map(lambda leaf: leaf.at[index].get(mode="clip"), items)


def _only(there, values):
    def one(leaf):
        return jnp.where(there.reshape(-1, *(1,) * (leaf.ndim - 1)), leaf, 0)

    return jax.tree.map(one, values)


def _zeros(shapes):
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


def _pad(leaf, count):
    return jnp.zeros((count, *leaf.shape[1:]), leaf.dtype).at[: leaf.shape[0]].set(leaf)
