"""The surfels that an image may show, picked before they are projected.

A window or a close-up shows a small part of a scene, and should cost no more than that part.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import CustomVJPPrimal, SymbolicZero, custom_vjp_primal_tree_values

from jaxcloseup.fields.splats.ellipsoids import bounded_slopes
from jaxcloseup.fields.splats.filters import DILATION, LOW_PASS, PIXEL_VARIANCE
from jaxcloseup.fields.splats.projection import MAX_LOG_SCALE, offsets, surfel_columns
from jaxcloseup.fields.splats.splat_math import ALPHA_MIN
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.fields.splats.vectors import dot
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.rotations import quaternion_rows
from jaxcloseup.geometry.visibility import sphere_in_view


_MANY = 2**14  # items of which the shown ones are worth picking
_PARTS = 8  # of the shown items, computed one after another: empty ones cost nothing

_Function = Callable[[Any, Any], Any]


def may_show(
    surfels: Surfels, opacity: jax.Array, camera: Camera, *, near: float, antialias: bool
) -> jax.Array:
    """Return whether an image may show each surfel, `[N]` bool; never wrongly no.

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
    columns = surfel_columns(surfels)
    offset = offsets(columns, camera)
    center = jnp.stack([dot(axis, offset) for axis in camera.rotation.T], axis=-1)
    log_scale = functools.reduce(jnp.maximum, columns.log_scales)
    scale = jnp.exp(jnp.clip(log_scale, -MAX_LOG_SCALE, MAX_LOG_SCALE))
    cutoff = jnp.sqrt(2 * jnp.log(jnp.maximum(opacity / ALPHA_MIN, 1)))
    if surfels.log_scales.shape[1] == 3:
        seen = _ellipses_in_view(camera, center, cutoff, scale, near)
        return seen & (opacity >= ALPHA_MIN)
    if antialias:
        x, y, z = (row[2] for row in quaternion_rows(*columns.quaternions))
        normal = x, y, z
        distance, facing = jnp.sqrt(dot(offset, offset)), jnp.abs(dot(offset, normal))
        # How far on the disc's plane one pixel moves the point that a ray meets.
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


def _ellipses_in_view(
    camera: Camera, center: jax.Array, cutoff: jax.Array, scale: jax.Array, near: float
) -> jax.Array:
    """Return whether ellipses of `project_ellipsoids` may meet the image, with either filter."""
    x, y, depth = jnp.moveaxis(center, -1, 0)
    seen = depth > near
    inverse_depth = 1 / jnp.where(seen, depth, 1)
    slopes = [x * inverse_depth, y * inverse_depth]
    sides = zip(slopes, bounded_slopes(slopes, camera), (camera.width, camera.height), strict=True)
    for i, (slope, bounded, size) in enumerate(sides):
        focal, principal = camera.intrinsics[i], camera.intrinsics[2 + i]
        # A row of J is at most f / z (1 + slope^2)^(1/2) long: a bound for any orientation.
        largest = focal * inverse_depth * scale
        variance = largest**2 * (1 + bounded**2) + DILATION
        half, at = 1.01 * cutoff * jnp.sqrt(variance) + 0.1, focal * slope + principal
        seen &= (at + half >= 0) & (at - half <= size)
    return seen


def map_shown(function: _Function, items: Any, shared: Any, shown: jax.Array) -> Any:
    """Return `function(items, shared)` of few items, or of the shown ones of many.

    Args:
      function: maps arrays with a leading axis of items to others with the same axis, item by item.
      items: arrays `[N, ...]`.
      shared: what all items need, such as a camera.
      shown: `[N]` bool.

    Returns:
      The results, arrays with `N` rows: of all items, in the first case; or of the shown items, in
      their order, and then zeros. All are zeros where nothing is shown. Differentiable in items and
      `shared`.
    """
    if shown.size >= _MANY:
        return _map_parts(function, items, shared, shown)
    return _if_any(jnp.any(shown), lambda: jax.checkpoint(function)(items, shared))


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _map_parts(function: _Function, items: Any, shared: Any, shown: jax.Array) -> Any:
    """Return `map_shown` of many items, a part of the shown ones at a time.

    The derivative computes everything anew, so that nothing is kept for it.
    """
    count = shown.size

    def compute(_: None, index: jax.Array) -> tuple[None, Any]:
        def some() -> Any:
            return _only(index < count, function(_pick(items, index), shared))

        return None, _if_any(index[0] < count, some)

    _, parts = lax.scan(compute, None, _parts(shown))
    return jax.tree.map(lambda leaf: _flat(leaf)[:count], parts)


def _map_parts_forward(
    function: _Function, items: Any, shared: Any, shown: Any
) -> tuple[Any, tuple[Any, ...]]:
    # A camera is rarely trained, and its derivative takes as long to compile as all others.
    trained = any(leaf.perturbed for leaf in jax.tree.leaves(shared, is_leaf=_is_primal))
    items, shared, shown = map(custom_vjp_primal_tree_values, (items, shared, shown))
    kept = (shared, None) if trained else (None, shared)
    return _map_parts(function, items, shared, shown), (items, *kept, shown)


def _map_parts_backward(
    function: _Function, residuals: tuple[Any, ...], cotangents: Any
) -> tuple[Any, Any, None]:
    items, trained, fixed, shown = residuals
    # Each part is projected again, so memory is that of one part.
    count, parts = shown.size, _parts(shown)

    def of_trained(items: Any, trained: Any) -> Any:
        return function(items, fixed if trained is None else trained)

    def pull_back(total: Any, part: tuple[jax.Array, Any]) -> tuple[Any, Any]:
        index, bars = part

        def some() -> Any:
            _, bar_of = jax.vjp(of_trained, _pick(items, index), trained)
            return bar_of(_only(index < count, bars))

        picked_bar, trained_bar = _if_any(index[0] < count, some)
        return jax.tree.map(jnp.add, total, trained_bar), picked_bar

    bars = jax.tree.map(lambda bar: _split(bar, parts.shape), cotangents)
    trained_bar, picked_bar = lax.scan(pull_back, _zeros(trained), (parts, bars))
    # Rank of each item among the visible ones.
    place = jnp.cumsum(shown, dtype=jnp.int32) - 1
    items_bar = _only(shown, _pick(jax.tree.map(_flat, picked_bar), place))
    return items_bar, trained_bar, None


_map_parts.defvjp(_map_parts_forward, _map_parts_backward, symbolic_zeros=True)


def _is_primal(leaf: Any) -> bool:
    return isinstance(leaf, CustomVJPPrimal)


def _parts(shown: jax.Array) -> jax.Array:
    """Return indices `[K, M]` of the shown items in order, in K parts, then the number of items."""
    count = shown.size
    size = -(-count // _PARTS)
    index = jnp.nonzero(shown, size=_PARTS * size, fill_value=count)[0]
    return index.astype(jnp.int32).reshape(_PARTS, size)


def _if_any(there: jax.Array, some: Callable[[], Any]) -> Any:
    """Return `some()` if anything is there, else zeros."""
    # XLA computes what a conditional returns once. Without one it computes most of the projection
    # anew for each column that depends on it.
    return lax.cond(there, some, lambda: _zeros(jax.eval_shape(some)))


def _pick(items: Any, index: jax.Array) -> Any:
    """Return the items at indices; those past the end are copies of the last item."""
    return jax.tree.map(lambda leaf: leaf.at[index].get(mode="clip"), items)


def _only(there: jax.Array, values: Any) -> Any:
    """Return the values, 0 where nothing is there."""

    def mask(leaf: jax.Array) -> jax.Array:
        return jnp.where(there.reshape(-1, *(1,) * (leaf.ndim - 1)), leaf, 0)

    return jax.tree.map(mask, values)


def _zeros(shapes: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


def _flat(leaf: jax.Array) -> jax.Array:
    """Return the rows of all parts, one after the other."""
    return leaf.reshape(-1, *leaf.shape[2:])


def _split(bar: Any, shape: tuple[int, ...]) -> jax.Array:
    """Return a cotangent `[N, ...]` in parts `[K, M, ...]`, filled up with zeros."""
    if isinstance(bar, SymbolicZero):
        bar = jnp.zeros(bar.shape, bar.dtype)
    missing = math.prod(shape) - bar.shape[0]
    padded = jnp.pad(bar, ((0, missing), *[(0, 0)] * (bar.ndim - 1)))
    return padded.reshape(*shape, *bar.shape[1:])
