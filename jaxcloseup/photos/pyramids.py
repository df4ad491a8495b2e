"""Pyramids: images of several views at a fine size, at halves of it, and as training reads them."""

import itertools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcloseup.geometry.cameras import Camera, mean_focal
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views, to_float


BUDGET = 5 * 2**28  # bytes that the photographs of a scene may take
_BYTES_PER_PIXEL = 4 * 4 / 3  # colors and weight of the finest level, and of all halves of it


@struct.dataclass
class Pyramid:
    """Images of V views at L sizes, from the finest level to the coarsest; P pixels in all.

    Attributes:
      values: `[V, P, C]` the levels one after the other, each row by row: uint8 (255 means 1),
        int8 (127 means 1) or float.
      intrinsics: `[V, L, 4]` fx, fy, cx, cy of each level, in its own pixels.
      sizes: (height, width) of each level, static.
      extents: `[V, L, 2]` int32 height and width of each image without its padding at the right and
        the bottom; None: no image is padded.
    """

    values: jax.Array
    intrinsics: jax.Array
    sizes: tuple[tuple[int, int], ...] = struct.field(pytree_node=False)
    extents: jax.Array | None = None

    def coarseness(self, view: int | jax.Array) -> jax.Array:
        """Return log2 of how much larger each level's pixels are than the finest ones, `[L]`."""
        focal = mean_focal(self.intrinsics[view])
        return jnp.log2(focal[0] / focal)

    @property
    def starts(self) -> tuple[int, ...]:
        """Return the index of each level's first pixel, among the P."""
        counts = [height * width for height, width in self.sizes]
        return tuple(itertools.accumulate(counts[:-1], initial=0))

    def pixels_of(self, index: int) -> slice:
        """Return the pixels of one level, among the P."""
        start, (height, width) = self.starts[index], self.sizes[index]
        return slice(start, start + height * width)

    def level_near(self, width: float) -> int:
        """Return the finest level that is not 1.5 times as wide as `width`; there must be one."""
        return [finer < 1.5 * width for _, finer in self.sizes].index(True)

    def level(self, index: int) -> jax.Array:
        """Return the images `[V, H, W, C]` of one level."""
        flat = self.values[:, self.pixels_of(index)]
        return flat.reshape(flat.shape[0], *self.sizes[index], flat.shape[-1])

    def image(self, view: int, index: int) -> jax.Array:
        """Return the image `[H, W, C]` of one view at one level."""
        flat = self.values[view, self.pixels_of(index)]
        return flat.reshape(*self.sizes[index], flat.shape[-1])

    def size_of(self, view: int, index: int) -> tuple[int, int]:
        """Return width and height of one view's image at one level, without its padding."""
        extent = (
            self.sizes[index] if self.extents is None else np.asarray(self.extents)[view, index]
        )
        height, width = map(int, extent)
        return width, height

    def camera(self, camera: Camera, view: int | slice, index: int) -> Camera:
        """Return the camera of one view's image at one level, given any camera with its pose.

        Also stacked cameras of several views.
        """
        height, width = self.sizes[index]
        intrinsics = self.intrinsics[view, index]
        return camera.replace(intrinsics=intrinsics, height=height, width=width)


def scene_pyramid(scene: Scene, *, finest: int = 1, budget: int = BUDGET) -> tuple[Pyramid, int]:
    """Make a pyramid of the training photographs, from the finest size that fits to their own.

    Args:
      scene: a scene whose photographs were divided by `metadata["downscale"]` for training.
      finest: smallest divisor of the photographs' own size.
      budget: bytes that the pyramid may take; larger photographs are divided more.

    Returns:
      The pyramid, as `photograph_pyramid`, and the divisor of its finest level.
    """
    train, coarse = scene.train, scene.metadata.get("downscale", 1)
    pixels = train.weight.size * coarse**2
    factor = max(finest, math.ceil(math.sqrt(pixels * _BYTES_PER_PIXEL / budget)))
    own = scene.sizes("train")
    if scene.photographs_at is None or factor >= coarse:
        return photograph_pyramid(train, extents=[own]), coarse
    finer, sizes = scene.photographs_at(factor)
    return photograph_pyramid(finer, train, extents=[sizes, own]), factor


def photograph_pyramid(
    views: Views,
    coarsest: Views | None = None,
    *,
    least: tuple[int, int] | None = None,
    extents: Sequence[Sequence[tuple[int, int]]] = (),
) -> Pyramid:
    """Make a pyramid of photographs, halves of them, and the photographs as training reads them.

    The values are `[V, P, 4]` uint8, colors and weight. A half averages 2 x 2 pixels by their
    weights; a last odd row or column is dropped, so that the intrinsics halve exactly. Pixels
    without weight are black.

    Args:
      views: photographs at the finest size.
      coarsest: the last level, after halves that are at least 1.5 times as wide.
      least: without `coarsest`, smallest height and width of a half; None makes only one level.
      extents: width and height of each photograph without padding, at the finest size and, with
        `coarsest`, at that; by default none is padded.
    """
    height, width = views.rgb.shape[1:3]
    sizes = [(height, width)]
    smallest: tuple[float, float] | None = least
    if coarsest is not None:
        smallest = 1, 1.5 * coarsest.cameras.width
    while smallest is not None and all(np.floor_divide(sizes[-1], 2) >= smallest):
        sizes.append((sizes[-1][0] // 2, sizes[-1][1] // 2))
    if coarsest is not None:
        sizes.append((coarsest.cameras.height, coarsest.cameras.width))
    images, weight = _bytes(views), np.asarray(views.weight)
    values = np.empty((len(images), sum(h * w for h, w in sizes), 4), np.uint8)
    halves = sizes if coarsest is None else sizes[:-1]
    for row, image, shares in zip(values, images, weight, strict=True):
        level = image.astype(np.float32), shares.astype(np.float32)
        start = 0
        for height, width in halves:
            if level[1].shape != (height, width):
                level = _halve(*level)
            row[start : start + height * width] = _pixels(*level)
            start += height * width
    powers = 2.0 ** -np.arange(len(halves), dtype=np.float32)
    intrinsics = np.asarray(views.cameras.intrinsics)[:, None] * powers[:, None]
    if coarsest is not None:
        last = zip(_bytes(coarsest), np.asarray(coarsest.weight), strict=True)
        values[:, start:] = [_pixels(*level) for level in last]
        given = np.asarray(coarsest.cameras.intrinsics)[:, None]
        intrinsics = np.concatenate([intrinsics, given], axis=1)
    unpadded = _extents(extents, sizes, len(halves))
    return Pyramid(jnp.asarray(values), jnp.asarray(intrinsics), tuple(sizes), unpadded)


def _extents(
    given: Sequence[Sequence[tuple[int, int]]], sizes: Sequence[tuple[int, int]], halves: int
) -> jax.Array | None:
    """Return `Pyramid.extents`, of which `given` has the finest level and the coarsest."""
    if not given:
        return None
    finest = np.asarray(given[0], np.int32)[:, ::-1]
    levels = [finest // 2**level for level in range(halves)]
    levels += [np.asarray(given[-1], np.int32)[:, ::-1]] * (len(sizes) - halves)
    found = np.maximum(np.stack(levels, axis=1), 1)
    return None if (found == np.asarray(sizes)).all() else jnp.asarray(found)


def _bytes(views: Views) -> np.ndarray:
    images = np.asarray(views.rgb)
    if images.dtype != np.uint8:
        images = np.rint(np.clip(images, 0, 1) * 255).astype(np.uint8)
    return images


def _pixels(colors: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Convert colors and weight of one image to bytes `[H * W, 4]`."""
    whole = np.dstack([colors * (weight > 0)[..., None], 255 * weight])
    return np.rint(whole).astype(np.uint8).reshape(-1, 4)


def _halve(image: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Average 2 x 2 pixels of an image `[H, W, 3]` by their weights `[H, W]`."""
    height, width = weight.shape[0] // 2, weight.shape[1] // 2
    image, weight = image[: 2 * height, : 2 * width], weight[: 2 * height, : 2 * width]
    # The order of these sums is that of OpenCV's INTER_AREA, so that bytes round alike.
    top_left, top_right, bottom_left, bottom_right = _corners(weight)
    shares = ((top_left + top_right) + (bottom_left + bottom_right)) * np.float32(0.25)
    top_left, top_right, bottom_left, bottom_right = _corners(image * weight[..., None])
    colors = (((top_left + top_right) + bottom_left) + bottom_right) * np.float32(0.25)
    return colors / np.maximum(shares, 1e-6)[..., None], shares


def _corners(array: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return array[::2, ::2], array[::2, 1::2], array[1::2, ::2], array[1::2, 1::2]


def fractional_level(coarser: jax.Array, coarseness: jax.Array) -> jax.Array:
    """Return the fractional level `[N]` that is so much coarser than the finest of `[L]` levels.

    Args:
      coarser: `[N]` log2 of how much coarser.
      coarseness: `[L]` of the levels, from `Pyramid.coarseness`.
    """
    level = jnp.zeros_like(coarser)
    for before, after in itertools.pairwise(coarseness):
        level += jnp.clip((coarser - before) / (after - before), 0, 1)
    return level


def read_pyramid(
    pyramid: Pyramid, view: jax.Array | int, ray: jax.Array, level: jax.Array
) -> jax.Array:
    """Read values `[N, C]` of one view, linearly between pixels and between levels.

    Args:
      pyramid: of all views.
      view: which of them.
      ray: `[N, 2]` x / z and y / z in the view's frame.
      level: `[N]` fractional levels; 0 is the finest.
    """
    sizes, starts = (jnp.asarray(x, jnp.int32) for x in (pyramid.sizes, pyramid.starts))
    finer = jnp.floor(jax.lax.stop_gradient(level)).astype(jnp.int32)
    share = (level - finer.astype(level.dtype))[:, None]

    def read(index: jax.Array) -> jax.Array:
        index = jnp.minimum(index, len(pyramid.sizes) - 1)
        height, width = sizes[index, 0], sizes[index, 1]
        intrinsics = pyramid.intrinsics[view][index]
        pixel = ray * intrinsics[:, :2] + intrinsics[:, 2:] - 0.5
        corner = jnp.floor(jax.lax.stop_gradient(pixel))
        wx, wy = jnp.moveaxis(pixel - corner, -1, 0)
        x, y = jnp.moveaxis(jnp.clip(corner, -2.0, 2.0**20).astype(jnp.int32), -1, 0)

        def tap(dx: int, dy: int) -> jax.Array:
            row, column = jnp.clip(y + dy, 0, height - 1), jnp.clip(x + dx, 0, width - 1)
            return to_float(pyramid.values[view, starts[index] + row * width + column])

        top = (1 - wx)[:, None] * tap(0, 0) + wx[:, None] * tap(1, 0)
        bottom = (1 - wx)[:, None] * tap(0, 1) + wx[:, None] * tap(1, 1)
        return (1 - wy)[:, None] * top + wy[:, None] * bottom

    return (1 - share) * read(finer) + share * read(finer + 1)
