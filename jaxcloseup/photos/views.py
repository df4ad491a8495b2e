"""Photographs with their cameras, and random draws of their pixels for training."""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcloseup.geometry.cameras import Camera


class Views(struct.PyTreeNode):
    """Photographs of one capture, padded to one static size.

    Attributes:
      cameras: stacked cameras, `[V]` on every leaf.
      rgb: `[V, H, W, 3]`, uint8 or float in [0, 1].
      weight: `[V, H, W]` in [0, 1]; 0 marks padding and masked pixels.
    """

    cameras: Camera
    rgb: jax.Array
    weight: jax.Array

    def __len__(self) -> int:
        """Return the number of photographs."""
        return self.rgb.shape[0]


class Photograph(NamedTuple):
    """One photograph at its own size, on the host.

    Attributes:
      camera: its camera.
      rgb: `[H, W, 3]`, uint8 or float in [0, 1].
      weight: `[H, W]`, uint8 (255 means 1) or float in [0, 1]; 0 marks masked pixels.
    """

    camera: Camera
    rgb: Any
    weight: Any


def unpadded(views: Views, sizes: Sequence[tuple[int, int]] | None = None) -> list[Photograph]:
    """Return the photographs of views, given width and height of each; by default none is padded.

    They share the memory of the views where that is the host's.
    """
    rgb, weight = np.asarray(views.rgb), np.asarray(views.weight)
    found = []
    for i, (width, height) in enumerate(sizes or [rgb.shape[2:0:-1]] * len(rgb)):
        camera = camera_at(views.cameras, i).replace(width=width, height=height)
        found.append(Photograph(camera, rgb[i, :height, :width], weight[i, :height, :width]))
    return found


def pad_images(images: Sequence[Any], height: int, width: int) -> np.ndarray:
    """Stack `[h, w, ...]` images into the top left of zeros `[V, height, width, ...]`."""
    stack = np.zeros((len(images), height, width, *images[0].shape[2:]), images[0].dtype)
    for target, image in zip(stack, images, strict=True):
        target[: image.shape[0], : image.shape[1]] = image
    return stack


class Measured(NamedTuple):
    """Depth that is known of pixels `[B]` or `[H, W]`, apart from any field.

    Attributes:
      depth: z-depth in world units; 0 where it is unknown.
      trust: in [0, 1]; 0 where it is unknown.
    """

    depth: jax.Array
    trust: jax.Array


class Batch(NamedTuple):
    """Pixels to render and their true colors.

    Attributes:
      cameras: stacked cameras `[B]`, one per pixel, or one camera for all of them.
      pixels: `[B, 2]` pixel centers, or None for the whole image.
      rgb: `[B, 3]` or `[H, W, 3]` float colors in [0, 1].
      weight: `[B]` or `[H, W]`, 0 where the color does not count.
      measured: depth of the pixels, where it is known; None: nowhere.
    """

    cameras: Camera
    pixels: jax.Array | None
    rgb: jax.Array
    weight: jax.Array
    measured: Measured | None = None


_Array = TypeVar("_Array", jax.Array, np.ndarray)


def to_float(rgb: _Array) -> _Array:
    """Convert colors to float32: uint8 to [0, 1], int8 to [-1, 1]; floats stay."""
    if rgb.dtype in (jnp.uint8, jnp.int8):
        return rgb.astype(jnp.float32) / jnp.iinfo(rgb.dtype).max
    return rgb


def camera_at(cameras: Camera, index: jax.Array | int) -> Camera:
    """Pick one camera, or several by an array of indices, out of stacked cameras."""
    return jax.tree.map(lambda leaf: leaf[index], cameras)


def sample_pixels(key: jax.Array, views: Views, count: int) -> Batch:
    """Draw `count` pixels of all photographs uniformly, with replacement; `key` is consumed."""
    num_views, height, width = views.weight.shape
    key_view, key_y, key_x = jax.random.split(key, 3)
    view = jax.random.randint(key_view, (count,), 0, num_views)
    y = jax.random.randint(key_y, (count,), 0, height)
    x = jax.random.randint(key_x, (count,), 0, width)
    return Batch(
        cameras=camera_at(views.cameras, view),
        pixels=jnp.stack([x, y], axis=-1).astype(jnp.float32) + 0.5,
        rgb=to_float(views.rgb[view, y, x]),
        weight=views.weight[view, y, x],
    )


def sample_image(key: jax.Array, views: Views) -> Batch:
    """Draw one whole photograph uniformly; `key` is consumed."""
    view = jax.random.randint(key, (), 0, len(views))
    return Batch(
        camera_at(views.cameras, view), None, to_float(views.rgb[view]), views.weight[view]
    )
