"""Holes: pixels of a view that no photograph shows, filled with the colors around them.

Rays that leave the part of the scene that was photographed meet no surface, so their pixels fade to
black. A smooth continuation of the surroundings is nearer to the truth.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.cameras import Camera, pixels_to_rays
from jaxcloseup.geometry.masks import in_bounds
from jaxcloseup.geometry.numerics import matmul, safe_divide
from jaxcloseup.photos.depth_maps import GatherSources


OPAQUE = 0.9  # opacity from which a render counts as opaque
_PHOTOGRAPHS = 2  # photographs that see through a place that is surely empty; one may err
_DEPTHS = 16  # places that are tried on a ray,
_REACH = 3.0  # from 2**-3 to 2**3 times the typical depth of the photographs
_RAYS = 120  # rays that are tried across an image
_BAND = 4  # rows of these that are skipped together
_FAINT = 0.02  # opacity below which a color is not known
_ACROSS = 20  # width in pixels of the small image whose enlargement blurs the rims of holes


def find_empty(
    camera: Camera,
    pixels: jax.Array,
    sources: GatherSources,
    wanted: jax.Array | None = None,
    *,
    sizes: jax.Array | None = None,
) -> jax.Array:
    """Return how surely rays pass a place behind which photographs see nothing, `[H, W]` in [0, 1].

    Dark surfaces may be learned as transparent, so these pixels may truly be black. Some rays
    across the image are tried, and one alone among others is not empty: photographs may err.

    Args:
      camera: camera of the view.
      pixels: `[H, W, 2]` its pixel centers, neighbors in the image.
      sources: depth maps of the photographs; an inverse depth of 0 means that nothing was seen.
      wanted: `[H, W]` bool, where the answer is needed; elsewhere it may be 0. None is everywhere.
      sizes: `[V, 2]` height and width of each depth map without its padding; None is without any.
    """
    count, *size = sources.inverse_depth.shape
    sizes = jnp.tile(jnp.array(size), (count, 1)) if sizes is None else sizes
    sizes = sizes.astype(pixels.dtype)
    (height, width), step = pixels.shape[:2], max(1, round(pixels.shape[1] / _RAYS))
    middles = [
        np.minimum(np.arange(step // 2, size + step // 2, step), size - 1)
        for size in (height, width)
    ]
    pixels = pixels[middles[0]][:, middles[1]]
    rows, columns = pixels.shape[:2]
    if wanted is None:
        wanted = jnp.ones((rows, columns), bool)
    else:
        wanted = jnp.pad(wanted, ((0, -height % step), (0, -width % step)))
        wanted = wanted.reshape(rows, step, columns, step).any((1, 3))
        # Neighbors count too, below.
        wanted = jax.lax.reduce_window(wanted, False, jax.lax.bitwise_or, (5, 5), (1, 1), "same")
    pad = ((0, -rows % _BAND), (0, 0))
    pixels = jnp.pad(pixels, (*pad, (0, 0)), mode="edge").reshape(-1, _BAND * columns, 2)
    wanted = jnp.pad(wanted, pad).reshape(-1, _BAND * columns)

    def find(band: tuple[jax.Array, jax.Array]) -> jax.Array:
        pixels, wanted = band
        return jax.lax.cond(
            jnp.any(wanted),
            lambda: _pass_emptiness(camera, pixels, sources, sizes),
            lambda: jnp.zeros(wanted.shape, jnp.float32),
        )

    empty = jax.lax.map(find, (pixels, wanted)).reshape(-1, columns)[:rows]
    padded = jnp.pad(empty, 1, mode="edge")
    around = jax.lax.reduce_window(padded, 0.0, jax.lax.add, (3, 3), (1, 1), "valid") / 9
    sure = jnp.clip(3 * around - 1, 0, 1)  # 1 from the side of a straight border that is empty
    large = jax.image.resize(sure, (rows * step, columns * step), "linear")
    return large[:height, :width]


def _pass_emptiness(
    camera: Camera, pixels: jax.Array, sources: GatherSources, sizes: jax.Array
) -> jax.Array:
    """Return how surely rays of pixels `[N, 2]` pass an empty place, `[N]` in [0, 1]."""
    known = sources.inverse_depth > 0
    log_depth = -jnp.log2(jnp.where(known, sources.inverse_depth, 1))
    typical = safe_divide(jnp.sum(log_depth), jnp.sum(known, dtype=log_depth.dtype))
    depths = 2 ** (typical + jnp.linspace(-_REACH, _REACH, _DEPTHS))[None, :, None]
    _, directions = pixels_to_rays(camera, pixels)

    def add(
        through: jax.Array, photograph: tuple[Camera, jax.Array, jax.Array]
    ) -> tuple[jax.Array, None]:
        view, known, size = photograph
        # Places on a ray are linear in depth, in any camera.
        start = matmul(camera.position - view.position, view.rotation)
        x, y, z = start[:, None, None] + depths * matmul(directions, view.rotation).T[:, None, :]
        fx, fy, cx, cy = view.intrinsics
        in_front = z > jnp.finfo(z.dtype).eps
        z = jnp.where(in_front, z, 1)
        landed = jnp.stack([fx * x / z + cx, fy * y / z + cy], axis=-1)
        inside = in_bounds(landed, *size)
        column, row = jnp.moveaxis(jnp.where(inside[..., None], landed, 0).astype(jnp.int32), -1, 0)
        sees_nothing = in_front & inside & ~known[row, column]
        return through + sees_nothing.astype(jnp.int32), None

    none = jnp.zeros((_DEPTHS, len(pixels)), jnp.int32)
    through, _ = jax.lax.scan(add, none, (sources.cameras, known, sizes))
    most = jnp.max(through, axis=0).astype(jnp.float32)
    return jnp.minimum(most / _PHOTOGRAPHS, 1)


def fill_holes(rgb: jax.Array, alpha: jax.Array, seen: jax.Array, empty: jax.Array) -> jax.Array:
    """Fill the holes of a render with the colors around them, by a pull-push pyramid.

    A hole is where no photograph saw a surface, nor emptiness. Its rendered opacity stays, and the
    rest is filled; so are its rims, where opacity fades. Colors are averaged into coarser images
    by their weight and flow back to finer pixels of low weight (Gortler et al. 1996, section
    3.4.2). The fog that a model has in a hole is a weak hint of its color, so it weighs as the
    root of its opacity.

    Args:
      rgb: `[H, W, 3]` colors over black.
      alpha: `[H, W]` opacity.
      seen: `[H, W]` whether a photograph saw the surface.
      empty: `[H, W]` in [0, 1] from `find_empty`.
    """
    height, width = seen.shape
    hole = jnp.where(seen, 0, 1 - empty)
    few = max(1, round(_ACROSS * height / width)), _ACROSS
    near = jax.image.resize(hole, few, "linear")
    near = jnp.clip(2 * jax.image.resize(near, hole.shape, "linear"), 0, 1)
    missing = near * jnp.where(seen, 1, 1 - empty) * (1 - jnp.clip(alpha / OPAQUE, 0, 1))
    opacity = empty + (1 - empty) * jnp.maximum(alpha, _FAINT)
    colors = jnp.clip(rgb / opacity[..., None], 0, 1)
    alpha = jnp.clip(alpha, 0, 1)
    weight = jnp.where(seen, alpha, empty**4 + hole * jnp.sqrt(alpha))
    planes = jnp.concatenate([jnp.moveaxis(colors, -1, 0), weight[None]])
    around = jnp.moveaxis(_spread(planes), 0, -1)
    return jnp.clip(rgb + missing[..., None] * around, 0, jnp.maximum(rgb, 1))


def _spread(planes: jax.Array) -> jax.Array:
    """Mix colors with coarser ones, which have the rest of the weight, `[3, H, W]`.

    Args:
      planes: `[4, H, W]` colors and their weight.
    """
    colors, weight = planes[:3], planes[3:]
    _, height, width = planes.shape
    if min(height, width) == 1:
        coarse = safe_divide(jnp.sum(weight * colors, (1, 2)), jnp.sum(weight))
        return weight * colors + (1 - weight) * coarse[:, None, None]
    both = _halve(_halve(jnp.concatenate([weight * colors, weight]), axis=1), axis=2)
    both = jnp.concatenate([safe_divide(both[:3], both[3:]), both[3:]])
    coarse = _double(_double(_spread(both), height, axis=1), width, axis=2)
    return weight * colors + (1 - weight) * coarse


def _halve(images: jax.Array, *, axis: int) -> jax.Array:
    """Resize images along an axis to half their size, rounded up, as `jax.image.resize` does.

    It multiplies by whole matrices, of which no row has more than five numbers that are not 0.
    """
    old = images.shape[axis]
    new = (old + 1) // 2
    first = 2 * np.arange(new)
    shares = _shares(first[None] + np.arange(-2, 3)[:, None], np.arange(new), old, new)
    padded = _pad(images, axis, (2, 2 + old % 2))
    return _sum_shares(
        shares, [jax.lax.slice_in_dim(padded, k, k + 2 * new - 1, 2, axis) for k in range(5)], axis
    )


def _double(images: jax.Array, size: int, *, axis: int) -> jax.Array:
    """Resize images along an axis likewise to a size that is twice theirs, or 1 less."""
    old = images.shape[axis]
    padded, here = _pad(images, axis, (1, 1)), np.arange(old)
    parts = [jax.lax.slice_in_dim(padded, k, k + old, axis=axis) for k in range(3)]
    pairs = [
        _sum_shares(_shares(here + np.arange(-1, 2)[:, None], 2 * here + i, old, size), parts, axis)
        for i in range(2)
    ]
    shape = [2 * n if i == axis else n for i, n in enumerate(images.shape)]
    doubled = jnp.stack(pairs, axis=axis + 1).reshape(shape)
    return jax.lax.slice_in_dim(doubled, 0, size, axis=axis)


def _shares(index: np.ndarray, resized: np.ndarray, old: int, new: int) -> np.ndarray:
    """Return the shares `[K, N]` of old pixels `index[K, N]` in new ones `resized[N]`."""
    center = (resized + 0.5) * old / new - 0.5
    shares = np.maximum(1 - np.abs(index - center) / max(old / new, 1), 0)
    shares = np.where((index >= 0) & (index < old), shares, 0)
    return shares / np.maximum(shares.sum(0), 1e-9)


def _sum_shares(shares: np.ndarray, parts: Sequence[jax.Array], axis: int) -> jax.Array:
    shape = [-1 if i == axis else 1 for i in range(3)]
    products = (
        jnp.asarray(share.reshape(shape), part.dtype) * part
        for share, part in zip(shares, parts, strict=True)
        if share.any()
    )
    return functools.reduce(jnp.add, products)


def _pad(images: jax.Array, axis: int, width: tuple[int, int]) -> jax.Array:
    return jnp.pad(images, [width if i == axis else (0, 0) for i in range(3)])
