"""Pyramids: images of several views at a fine size and at halves of it."""

import math

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photographs import Views
from jaxcloseup.scene import Scene


BUDGET = 2**29  # bytes that the photographs of a scene may take
_BYTES_PER_PIXEL = 4 * 4 / 3  # colors and weight of the finest level, and of all halves of it


@struct.dataclass
class Pyramid:
    """Images of V views at L sizes, from the finest level to the coarsest; P pixels in all.

    Attributes:
      values: `[V, P, C]` the levels one after the other, each row by row: uint8 (255 means 1),
        int8 (127 means 1) or float.
      intrinsics: `[V, L, 4]` fx, fy, cx, cy of each level, in its own pixels.
      sizes: (height, width) of each level, static.
    """

    values: jax.Array
    intrinsics: jax.Array
    sizes: tuple[tuple[int, int], ...] = struct.field(pytree_node=False)

    def pixels_of(self, index: int) -> slice:
        """The pixels of one level, among the P."""
        start = sum(height * width for height, width in self.sizes[:index])
        height, width = self.sizes[index]
        return slice(start, start + height * width)

    def level(self, index: int) -> jax.Array:
        """Images `[V, H, W, C]` of one level."""
        flat = self.values[:, self.pixels_of(index)]
        return flat.reshape(flat.shape[0], *self.sizes[index], flat.shape[-1])

    def image(self, view: int, index: int) -> jax.Array:
        """The image `[H, W, C]` of one view at one level."""
        flat = self.values[view, self.pixels_of(index)]
        return flat.reshape(*self.sizes[index], flat.shape[-1])

    def camera(self, camera: Camera, view: int, index: int) -> Camera:
        """The camera of one view's image at one level, given any camera with its pose."""
        height, width = self.sizes[index]
        intrinsics = self.intrinsics[view, index]
        return camera.replace(intrinsics=intrinsics, height=height, width=width)


def scene_pyramid(scene: Scene, *, finest: int, budget: int = BUDGET) -> tuple[Pyramid, int]:
    """The training photographs of a scene at the finest size that fits, and at halves of it.

    Args:
      scene: a scene whose photographs were divided by `metadata["downscale"]` for training.
      finest: smallest divisor of the photographs' own size.
      budget: bytes that the pyramid may take; larger photographs are divided more.

    Returns:
      The pyramid, as `photograph_pyramid`, and the divisor of its finest level.
    """
    train, coarse = scene.train, scene.metadata.get("downscale", 1)
    pixels = train.weight.size * coarse**2
    fitting = math.ceil(math.sqrt(pixels * _BYTES_PER_PIXEL / budget))
    factor = max(finest, fitting)
    if scene.photographs_at is None or factor >= coarse:
        factor, views = coarse, train
    else:
        views = scene.photographs_at(factor)
    return photograph_pyramid(views, coarsest=train.cameras.width), factor


def photograph_pyramid(views: Views, *, coarsest: int) -> Pyramid:
    """Photographs and halves of them, with their weights: `[V, P, 4]` uint8.

    A half averages 2 x 2 pixels by their weights; a last odd row or column is dropped, so that the
    intrinsics halve exactly. Pixels without weight are black.

    Args:
      views: photographs at the finest size.
      coarsest: the last level is the first whose width is below 1.5 times this one.
    """
    images, weight = np.asarray(views.rgb), np.asarray(views.weight)
    if images.dtype != np.uint8:
        images = np.rint(np.clip(images, 0, 1) * 255).astype(np.uint8)
    sizes = [images.shape[1:3]]
    while sizes[-1][1] >= 1.5 * coarsest and min(sizes[-1]) > 1:
        sizes.append((sizes[-1][0] // 2, sizes[-1][1] // 2))
    values = np.empty((len(images), sum(h * w for h, w in sizes), 4), np.uint8)
    for row, image, shares in zip(values, images, weight, strict=True):
        level = image.astype(np.float32) * (shares > 0)[..., None], shares.astype(np.float32)
        start = 0
        for height, width in sizes:
            if level[1].shape != (height, width):
                level = _halve(*level)
            whole = np.dstack([level[0], 255 * level[1]])
            row[start : start + height * width] = np.rint(whole).reshape(-1, 4)
            start += height * width
    powers = 2.0 ** -np.arange(len(sizes), dtype=np.float32)
    intrinsics = np.asarray(views.cameras.intrinsics)[:, None] * powers[:, None]
    return Pyramid(jnp.asarray(values), jnp.asarray(intrinsics), tuple(sizes))


def _halve(image, weight):
    height, width = weight.shape[0] // 2, weight.shape[1] // 2

    def mean(array):
        array = np.ascontiguousarray(array[: 2 * height, : 2 * width])
        return cv2.resize(array, (width, height), interpolation=cv2.INTER_AREA)

    shares = mean(weight)
    colors = mean(image * weight[..., None]) / np.maximum(shares, 1e-6)[..., None]
    return colors, shares
