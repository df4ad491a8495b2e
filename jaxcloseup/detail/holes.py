"""Holes: pixels of a view that no photograph shows, filled with the colors around them.

Rays that leave the part of the scene that was photographed meet no surface, so their pixels fade to
black. A smooth continuation of the surroundings is nearer to the truth.
"""

import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.geometry.warp import backward_warp
from jaxcloseup.photos.depth_maps import GatherSources


OPAQUE = 0.9  # opacity from which a render counts as opaque
_PHOTOGRAPHS = 3  # photographs that must see through a place that counts as empty; fewer may err
_DEPTHS = 16  # places that are tried on a ray,
_REACH = 3.0  # from 2**-3 to 2**3 times the typical depth of the photographs
_RAYS = 120  # rays that are tried across an image
_ACROSS = 20  # width in pixels of the small image whose enlargement blurs the rims of holes


def find_empty(camera: Camera, pixels: jax.Array, sources: GatherSources) -> jax.Array:
    """Return the pixels `[H, W]` whose rays pass a place behind which photographs see nothing.

    Dark surfaces may be learned as transparent, so these pixels may truly be black.

    Args:
      camera: camera of the view.
      pixels: `[H, W, 2]` its pixel centers, neighbors in the image.
      sources: depth maps of the photographs; an inverse depth of 0 means that nothing was seen.
    """
    (height, width), step = pixels.shape[:2], max(1, round(pixels.shape[1] / _RAYS))
    pixels, known = pixels[::step, ::step], sources.inverse_depth > 0
    nothing = jnp.where(known, 0.0, 1.0)[..., None]
    log_depth = -jnp.log2(jnp.where(known, sources.inverse_depth, 1))
    typical = safe_divide(jnp.sum(log_depth), jnp.sum(known, dtype=log_depth.dtype))

    def at_depth(depth: jax.Array) -> jax.Array:
        points = pixels_to_points(camera, pixels, jnp.full(pixels.shape[:2], depth))

        def add(through: jax.Array, photograph: tuple[Camera, jax.Array]) -> tuple[jax.Array, None]:
            view, nothing = photograph
            landed, z = points_to_pixels(view, points)
            sees_nothing = backward_warp(nothing, landed, order=0)[..., 0]
            return through + jnp.where(z > 0, sees_nothing, 0), None

        return jax.lax.scan(add, jnp.zeros(pixels.shape[:2]), (sources.cameras, nothing))[0]

    depths = 2 ** (typical + jnp.linspace(-_REACH, _REACH, _DEPTHS))
    empty = jnp.max(jax.lax.map(at_depth, depths), axis=0) >= _PHOTOGRAPHS
    return jnp.repeat(jnp.repeat(empty, step, axis=0), step, axis=1)[:height, :width]


def fill_holes(rgb: jax.Array, alpha: jax.Array, seen: jax.Array, empty: jax.Array) -> jax.Array:
    """Fill the holes of a render with the colors around them, by a pull-push pyramid.

    A hole is where no photograph saw a surface, nor emptiness. Its rendered opacity stays, and the
    rest is filled; so are its rims, where opacity fades. Colors are averaged into coarser images
    by their weight and flow back to finer pixels of low weight (Gortler et al. 1996, section
    3.4.2).

    Args:
      rgb: `[H, W, 3]` colors over black.
      alpha: `[H, W]` opacity.
      seen: `[H, W]` whether a photograph saw the surface.
      empty: `[H, W]` from `find_empty`.
    """
    hole, (height, width) = ~seen & ~empty, seen.shape
    few = max(1, round(_ACROSS * height / width)), _ACROSS
    near = jax.image.resize(hole.astype(rgb.dtype), few, "linear")
    near = jnp.clip(2 * jax.image.resize(near, hole.shape, "linear"), 0, 1)
    missing = near * (1 - jnp.clip(alpha / OPAQUE, 0, 1))
    opacity = jnp.where(seen, jnp.maximum(alpha, 0.05), 1)
    colors = jnp.clip(rgb / opacity[..., None], 0, 1)
    weight = jnp.where(hole, 0, jnp.where(seen, jnp.clip(alpha, 0, 1), 1))
    around = _spread(colors, weight[..., None])
    return jnp.clip(rgb + missing[..., None] * around, 0, 1)


def _spread(colors: jax.Array, weight: jax.Array) -> jax.Array:
    """Mix colors `[H, W, 3]` of weight `[H, W, 1]` with coarser ones, which have the rest."""
    height, width, _ = colors.shape
    if min(height, width) == 1:
        coarse = safe_divide(jnp.sum(weight * colors, (0, 1)), jnp.sum(weight))
        return weight * colors + (1 - weight) * coarse[None, None]
    both = jnp.concatenate([weight * colors, weight], axis=-1)
    both = jax.image.resize(both, ((height + 1) // 2, (width + 1) // 2, 4), "linear")
    coarse = _spread(safe_divide(both[..., :3], both[..., 3:]), both[..., 3:])
    return weight * colors + (1 - weight) * jax.image.resize(coarse, colors.shape, "linear")
