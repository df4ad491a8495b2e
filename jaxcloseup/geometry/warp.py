"""Warps between views: backward (read where a point projects) and forward (z-buffer).

Images are `[H, W, C]`; pixels are continuous (x, y) with the top-left center at (0.5, 0.5).
`backward_warp` and `forward_warp` take pixels that are already projected; `warp_to` and
`warp_forward_to` take two cameras and a depth map. Results share their field names: `values` is
what was carried over, `hit` says where anything was.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.masks import depth_consistent, in_bounds


_WHOLE = 0.999  # of the four shares of a bilinear read, up to rounding
NO_SOURCE = 2**31 - 1  # larger than any index, so that a minimum replaces it


class BackwardWarp(NamedTuple):
    """A source image as seen from a target camera.

    Attributes:
      values: `[H, W, C]` values read from the source, 0 where not hit.
      hit: `[H, W]` bool, whether the source shows the target's surface.
      pixels: `[H, W, 2]` source pixels (x, y); finite, but without meaning where not hit.
    """

    values: jax.Array
    hit: jax.Array
    pixels: jax.Array


class ForwardWarp(NamedTuple):
    """The nearest source at each target pixel.

    Attributes:
      values: `[H, W, C]` values of that source, 0 where no source landed.
      depth: `[H, W]` its z-depth in the target view, infinity where no source landed.
      hit: `[H, W]` bool, whether a source landed.
    """

    values: jax.Array
    depth: jax.Array
    hit: jax.Array


def reads_unmixed(weight: jax.Array, pixels: jax.Array) -> jax.Array:
    """Return whether `backward_warp` reads colors at pixels of weight alone, `[...]` bool.

    Beside a mask or padding it would mix them with what these leave out.

    Args:
      weight: `[H, W]` of the image that is read; 0 does not count.
      pixels: `[..., 2]` where it is read; False outside the image.
    """
    counts = (weight > 0).astype(pixels.dtype)[..., None]
    return backward_warp(counts, pixels)[..., 0] > _WHOLE


def backward_warp(
    image: jax.Array, pixels: jax.Array, *, order: int = 1, fill_value: float = 0.0
) -> jax.Array:
    """Read an image at continuous pixels: the paper's warp W of I_n to I', after projection.

    Args:
      image: `[H, W, C]` float.
      pixels: `[..., 2]` where to read; any value, NaN included.
      order: 0 for the nearest pixel, 1 for bilinear. The outermost half pixel repeats the border.
      fill_value: value of pixels outside the image.

    Returns:
      `[..., C]` values, differentiable in `image` and, for order 1, in `pixels`.
    """
    chex.assert_rank(image, 3)
    if order not in (0, 1):
        raise ValueError(f"order must be 0 (nearest) or 1 (bilinear), not {order}")
    height, width, _ = image.shape
    inside = in_bounds(pixels, height, width)[..., None]
    pixels = jnp.where(inside, pixels, 0.5)  # NaN must not reach the indices, nor the gradient
    if order == 0:
        x, y = _index(pixels[..., 0], width), _index(pixels[..., 1], height)
        return jnp.where(inside, image[y, x], fill_value)
    corner = jnp.floor(pixels - 0.5)
    fraction = pixels - 0.5 - corner
    (x0, x1), (y0, y1) = (
        (_index(corner[..., axis], size), _index(corner[..., axis] + 1, size))
        for axis, size in enumerate((width, height))
    )
    wx, wy = fraction[..., :1], fraction[..., 1:]
    top = (1 - wx) * image[y0, x0] + wx * image[y0, x1]
    bottom = (1 - wx) * image[y1, x0] + wx * image[y1, x1]
    return jnp.where(inside, (1 - wy) * top + wy * bottom, fill_value)


def forward_warp(
    values: jax.Array,
    pixels: jax.Array,
    depth: jax.Array,
    *,
    shape: tuple[int, int],
    valid: jax.Array | None = None,
    into: ForwardWarp | None = None,
) -> ForwardWarp:
    """Splat sources onto a target image through an exact z-buffer: the paper's union I*.

    Each source falls on the one pixel that holds its projection. The nearest source wins; among
    equal depths the lowest source index does, so the result does not depend on scheduling and,
    ties apart, not on the order of the sources.

    Args:
      values: `[..., C]` values of the sources.
      pixels: `[..., 2]` target pixels where they land.
      depth: `[...]` their z-depth in the target view; not positive or not finite is not drawn.
      shape: (height, width) of the target.
      valid: `[...]` bool, sources to draw; all by default.
      into: earlier result to draw onto, which wins ties; an empty target by default.

    Returns:
      A `ForwardWarp`, differentiable in `values` and `depth`.
    """
    height, width = shape
    channels = values.shape[-1]
    chex.assert_equal_shape_prefix([values, pixels, depth], depth.ndim)
    values, pixels, depth = values.reshape(-1, channels), pixels.reshape(-1, 2), depth.reshape(-1)
    usable = in_bounds(pixels, height, width) & (depth > 0) & jnp.isfinite(depth)
    if valid is not None:
        usable &= valid.reshape(-1)
    if into is None:
        into = ForwardWarp(
            values=jnp.zeros((height, width, channels), values.dtype),
            depth=jnp.full(shape, jnp.inf, depth.dtype),
            hit=jnp.zeros(shape, bool),
        )
    if not depth.size:
        return into
    pixels = jnp.where(usable[:, None], pixels, 0)
    target = _index(pixels[:, 1], height) * width + _index(pixels[:, 0], width)
    target = jnp.where(usable, target, height * width)
    # The earlier result counts as source -1, so that it wins ties.
    there = jnp.where(into.hit, -1, NO_SOURCE).reshape(-1)
    index = jnp.arange(depth.size, dtype=jnp.int32)
    buffer = into.depth.reshape(-1), there
    _, winner = draw_nearest(buffer, target, jax.lax.stop_gradient(depth), index)
    winner = winner.reshape(shape)
    arrived = (winner >= 0) & (winner < NO_SOURCE)
    winner = jnp.where(arrived, winner, 0)
    return ForwardWarp(
        values=jnp.where(arrived[..., None], values[winner], into.values),
        depth=jnp.where(arrived, depth[winner], into.depth),
        hit=into.hit | arrived,
    )


def warp_to(
    source_image: jax.Array,
    source: Camera,
    target: Camera,
    depth: jax.Array,
    *,
    source_depth: jax.Array | None = None,
    tolerance: jax.Array | float = 0.02,
) -> BackwardWarp:
    """Read a source image into a target view: the paper's backward warp I' in one call.

    Each target pixel is lifted with its z-depth, projected into the source and read there
    bilinearly. It is not hit where its depth is undefined, where its point lies behind the source
    camera or outside the source image, or, if `source_depth` is passed, where its point is
    occluded in the source.

    Args:
      source_image: `[Hs, Ws, C]` float.
      source: camera of the image, of size `Hs, Ws`.
      target: camera of the view to fill, of size `H, W`.
      depth: `[H, W]` z-depth of the target view; not positive or not finite is undefined.
      source_depth: `[Hs, Ws]` z-depth of the source; None ignores occlusion.
      tolerance: relative; a point is occluded if its z-depth in the source differs by more from
        `source_depth` at the nearest pixel.

    Returns:
      A `BackwardWarp`. `values` is differentiable in `source_image`, in `depth` and in the cameras;
      gradients are finite, and 0 where not hit.
    """
    chex.assert_shape(source_image, (source.height, source.width, None))
    chex.assert_type(source_image, float)
    chex.assert_shape(depth, (target.height, target.width))
    defined = (depth > 0) & jnp.isfinite(depth)
    grid = pixel_grid(target.height, target.width)
    points = pixels_to_points(target, grid, jnp.where(defined, depth, 1))
    pixels, landed_depth = points_to_pixels(source, points)
    hit = defined & (landed_depth > 0) & in_bounds(pixels, source.height, source.width)
    if source_depth is not None:
        chex.assert_shape(source_depth, (source.height, source.width))
        observed = backward_warp(source_depth[..., None], pixels, order=0)[..., 0]
        hit &= depth_consistent(observed, landed_depth, tolerance)
    values = jnp.where(hit[..., None], backward_warp(source_image, pixels), 0)
    return BackwardWarp(values, hit, pixels)


def warp_forward_to(
    source_image: jax.Array,
    source: Camera,
    target: Camera,
    source_depth: jax.Array,
    *,
    valid: jax.Array | None = None,
    into: ForwardWarp | None = None,
) -> ForwardWarp:
    """Splat a source image into a target view: the paper's forward warp in one call.

    The twin of `warp_to`: each source pixel is lifted with its own z-depth, projected into the
    target and drawn on the pixel that it falls on, where the nearest source pixel wins. Several
    sources join in one target by passing each result to the next call's `into`; `union_warp` does
    the same for many large views.

    Args:
      source_image: `[Hs, Ws, C]` values of any type.
      source: camera of the image, of size `Hs, Ws`.
      target: camera of the view to fill, of size `H, W`.
      source_depth: `[Hs, Ws]` z-depth of the source; not positive or not finite is not drawn.
      valid: `[Hs, Ws]` bool, source pixels to draw; None draws all.
      into: earlier result to draw onto, which wins ties; None starts from an empty target.

    Returns:
      A `ForwardWarp` of size `H, W`, differentiable in `source_image`, `source_depth` and cameras.
    """
    chex.assert_shape(source_image, (source.height, source.width, None))
    chex.assert_shape(source_depth, (source.height, source.width))
    defined = (source_depth > 0) & jnp.isfinite(source_depth)
    grid = pixel_grid(source.height, source.width)
    points = pixels_to_points(source, grid, jnp.where(defined, source_depth, 1))
    pixels, depth = points_to_pixels(target, points)
    drawn = defined if valid is None else defined & valid
    shape = target.height, target.width
    return forward_warp(source_image, pixels, depth, shape=shape, valid=drawn, into=into)


def draw_nearest(
    buffer: tuple[jax.Array, jax.Array], target: jax.Array, depth: jax.Array, source: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Draw into a z-buffer: the nearest source wins, and the lowest index among equal depths.

    Args:
      buffer: depths `[N]`, inf where empty, and int32 sources `[N]`, `NO_SOURCE` where empty.
      target: `[M]` int32 entry where each source falls; N and above are not drawn.
      depth: `[M]` depths of the sources, finite.
      source: `[M]` int32 indices of the sources.

    Returns:
      The updated buffer.
    """
    before, sources = buffer
    # Two scatters with commutative minima: the result does not depend on their order. The first
    # finds the nearest depth of each entry, the second the lowest index among its sources.
    nearest = before.at[target].min(depth, mode="drop")
    wins = depth == nearest.at[target].get(mode="fill", fill_value=-jnp.inf)
    sources = jnp.where(nearest < before, NO_SOURCE, sources)
    return nearest, sources.at[jnp.where(wins, target, nearest.size)].min(source, mode="drop")


def _index(coordinate: jax.Array, size: int) -> jax.Array:
    """Return the index of the pixel that holds a coordinate, clamped to the image."""
    return jnp.clip(jnp.floor(coordinate).astype(jnp.int32), 0, size - 1)
