"""Pyramids: images of several views at a fine size, at halves of it, and as training reads them."""

import itertools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcloseup.geometry.cameras import Camera, mean_focal
from jaxcloseup.io.buffers import empty_for_jax
from jaxcloseup.photos.light import change_exposure, light_by_curve, to_colors
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Photograph, Views, to_float, unpadded


BUDGET = 5 * 2**28  # bytes that the photographs of a scene may take
_BYTES_PER_PIXEL = 4 * 4 / 3  # colors and weight of the finest level, and of all halves of it
_WIDER = 1.5  # times that a finer level is at least as wide as the one that is wanted, or the last


@struct.dataclass
class Pyramid:
    """Images of V views at L sizes, from the finest level to the coarsest; P pixels in all.

    Views may differ in size, and none is padded.

    Attributes:
      values: `[P, C]` the views one after the other, of each the levels one after the other, row by
        row: uint8 (255 means 1), int8 (127 means 1) or float.
      intrinsics: `[V, L, 4]` fx, fy, cx, cy of each level, in its own pixels.
      extents: `[V, L, 2]` int32 height and width of each image.
      gains: `[V, 3]` factor of the light of each view's first three values over that at the middle
        exposure, at which `image` and windows show them; None: all have one exposure.
      curves: `[V, N]` light of each view's colors, from black to white; None: that of sRGB.
    """

    values: jax.Array
    intrinsics: jax.Array
    extents: jax.Array
    gains: jax.Array | None = None
    curves: jax.Array | None = None

    def __len__(self) -> int:
        """Return the number of views."""
        return self.extents.shape[0]

    @property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        """Return the largest height and width of each level."""
        return tuple((height, width) for height, width in np.asarray(self.extents).max(0).tolist())

    @property
    def starts(self) -> jax.Array:
        """Return the index of each image's first pixel, among the P, int32 `[V, L]`."""
        counts = self.extents.prod(-1)
        ends = counts.reshape(-1).cumsum(dtype=jnp.int32)
        return ends.reshape(counts.shape) - counts

    def coarseness(self, view: int | jax.Array) -> jax.Array:
        """Return log2 of how much larger each level's pixels are than the finest ones, `[L]`."""
        focal = mean_focal(self.intrinsics[view])
        return jnp.log2(focal[0] / focal)

    def level_near(self, width: float) -> int:
        """Return the finest level that is not 1.5 times as wide as `width`, else the coarsest."""
        fitting = (i for i, (_, wide) in enumerate(self.sizes) if wide < _WIDER * width)
        return next(fitting, len(self.sizes) - 1)

    def image(self, view: int, index: int) -> jax.Array:
        """Return the image `[H, W, C]` of one view at one level."""
        height, width = np.asarray(self.extents)[view, index].tolist()
        start = np.asarray(self.starts)[view, index]
        # One program serves all images of a size.
        flat = jax.lax.dynamic_slice_in_dim(self.values, start, height * width)
        return self.at_middle(flat.reshape(height, width, flat.shape[-1]), view)

    def at_middle(self, values: jax.Array, view: int | jax.Array) -> jax.Array:
        """Return values `[..., C]` of views `[...]`, or of one, at the middle exposure.

        They become float32 where exposures differ.
        """
        if self.gains is None:
            return values
        values = to_float(values)
        gain = jnp.broadcast_to(1 / self.gains[view], (*values.shape[:-1], 3))
        if self.curves is None:
            rgb = change_exposure(values[..., :3], gain)
        else:
            rgb = to_colors(light_by_curve(values[..., :3], self.curves, view) * gain)
        return jnp.concatenate([rgb, values[..., 3:]], axis=-1)

    def camera(self, camera: Camera, view: int, index: int) -> Camera:
        """Return the camera of one view's image at one level, given any camera with its pose."""
        height, width = np.asarray(self.extents)[view, index].tolist()
        intrinsics = self.intrinsics[view, index]
        return camera.replace(intrinsics=intrinsics, height=height, width=width)

    def cameras(self, cameras: Camera, index: int) -> Camera:
        """Return the stacked cameras of all views at one level, as large as the largest image."""
        height, width = self.sizes[index]
        return cameras.replace(intrinsics=self.intrinsics[:, index], height=height, width=width)


def scene_pyramid(scene: Scene, *, finest: int = 1, budget: int = BUDGET) -> tuple[Pyramid, int]:
    """Make a pyramid of the training photographs, from the finest size that fits to their own.

    Args:
      scene: a scene whose photographs were divided by `metadata["downscale"]` for training.
      finest: smallest divisor of the photographs' own size.
      budget: bytes that the pyramid may take; larger photographs are divided more.

    Returns:
      The pyramid, as `photograph_pyramid`, and the divisor of its finest level.
    """
    sizes, coarse = scene.sizes("train"), scene.metadata.get("downscale", 1)
    train = unpadded(scene.train, sizes)
    pixels = sum(width * height for width, height in sizes) * coarse**2
    factor = max(finest, math.ceil(math.sqrt(pixels * _BYTES_PER_PIXEL / budget)))
    if scene.photographs_at is None or factor >= coarse:
        return photograph_pyramid(train), coarse
    return photograph_pyramid(scene.photographs_at(factor), train), factor


def divisor_near(finest: int, coarsest: int, times: float) -> int:
    """Return the divisor of the level that `Pyramid.level_near` chooses, without the pyramid.

    Args:
      finest: divisor of the photographs' own size at the first level.
      coarsest: divisor at the last level.
      times: the width that is wanted, in widths of the last level, 1 or more.
    """
    while coarsest / finest >= _WIDER * times:
        if coarsest / (2 * finest) < _WIDER:
            return coarsest
        finest *= 2
    return finest


def photograph_pyramid(
    photographs: Views | Sequence[Photograph],
    coarsest: Views | Sequence[Photograph] | None = None,
    *,
    least: tuple[int, int] | None = None,
) -> Pyramid:
    """Make a pyramid of photographs, halves of them, and the photographs as training reads them.

    The values are uint8, colors and weight. A half averages 2 x 2 pixels by their weights; a last
    odd row or column is dropped, so that the intrinsics halve exactly. Pixels without weight are
    black.

    Args:
      photographs: photographs at the finest size.
      coarsest: the last level, after halves that are at least 1.5 times as wide.
      least: without `coarsest`, smallest height and width of a half; None makes only one level.
    """
    finest, last = map(_listed, (photographs, coarsest or ()))
    halves = [np.array([image.weight.shape for image in finest], np.int32)]
    ends = np.array([image.weight.shape for image in last], np.int32).reshape(-1, 2)
    smallest = (1, _WIDER * ends[:, 1].max()) if len(last) else least
    while smallest is not None and _holds(halves[-1] // 2, smallest):
        halves.append(halves[-1] // 2)
    extents = np.stack([*halves, *([ends] if len(last) else [])], axis=1)
    values = empty_for_jax((int(extents.prod(-1).sum()), 4), np.uint8)
    images = iter(np.split(values, extents.prod(-1).cumsum()[:-1]))
    for i, photograph in enumerate(finest):
        level = _as_floats(photograph)
        for j in range(len(halves)):
            level = _halve(*level) if j else level
            next(images)[:] = _pixels(*level)
        if last:
            next(images)[:] = _pixels(*_as_floats(last[i]))
    powers = 2.0 ** -np.arange(len(halves), dtype=np.float32)
    intrinsics = _intrinsics(finest)[:, None] * powers[:, None]
    if last:
        intrinsics = np.concatenate([intrinsics, _intrinsics(last)[:, None]], axis=1)
    return Pyramid(jax.device_put(values), jnp.asarray(intrinsics), jnp.asarray(extents))


def _holds(sizes: np.ndarray, smallest: tuple[float, float]) -> bool:
    """Return whether no image is empty, and the largest height and width reach the smallest."""
    return bool(sizes.min() > 0 and (sizes.max(0) >= smallest).all())


def _listed(photographs: Views | Sequence[Photograph]) -> Sequence[Photograph]:
    return unpadded(photographs) if isinstance(photographs, Views) else photographs


def _intrinsics(photographs: Sequence[Photograph]) -> np.ndarray:
    return np.stack([photograph.camera.intrinsics for photograph in photographs])


def _as_floats(photograph: Photograph) -> tuple[np.ndarray, np.ndarray]:
    """Return colors from 0 to 255, as bytes have them, and weights in [0, 1]."""
    rgb, weight = np.asarray(photograph.rgb), np.asarray(photograph.weight)
    if rgb.dtype != np.uint8:
        rgb = np.rint(np.clip(rgb, 0, 1) * 255)
    if weight.dtype == np.uint8:
        weight = weight / np.float32(255)
    return rgb.astype(np.float32), weight.astype(np.float32)


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
    sizes, starts = pyramid.extents[view], pyramid.starts[view]
    finer = jnp.floor(jax.lax.stop_gradient(level)).astype(jnp.int32)
    share = (level - finer.astype(level.dtype))[:, None]

    def read(index: jax.Array) -> jax.Array:
        index = jnp.minimum(index, len(sizes) - 1)
        height, width = sizes[index, 0], sizes[index, 1]
        intrinsics = pyramid.intrinsics[view][index]
        pixel = ray * intrinsics[:, :2] + intrinsics[:, 2:] - 0.5
        corner = jnp.floor(jax.lax.stop_gradient(pixel))
        wx, wy = jnp.moveaxis(pixel - corner, -1, 0)
        x, y = jnp.moveaxis(jnp.clip(corner, -2.0, 2.0**20).astype(jnp.int32), -1, 0)

        def tap(dx: int, dy: int) -> jax.Array:
            row, column = jnp.clip(y + dy, 0, height - 1), jnp.clip(x + dx, 0, width - 1)
            return to_float(pyramid.values[starts[index] + row * width + column])

        top = (1 - wx)[:, None] * tap(0, 0) + wx[:, None] * tap(1, 0)
        bottom = (1 - wx)[:, None] * tap(0, 1) + wx[:, None] * tap(1, 1)
        return (1 - wy)[:, None] * top + wy[:, None] * bottom

    return (1 - share) * read(finer) + share * read(finer + 1)
