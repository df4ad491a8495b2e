"""Match patches of a photograph with its neighbors under slanted planes.

The cost is 1 - NCC, the normalized cross-correlation of grays, weighted bilaterally: samples whose
gray differs from the center's likely lie on another surface. `native/stereo_rows.cc` has the same
arithmetic for CPUs.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.geometry.numerics import matmul
from jaxcloseup.native import library
from jaxcloseup.photos.views import camera_at
from jaxcloseup.stereo.config import StereoConfig
from jaxcloseup.stereo.planes import relative_transforms


class Photographs(NamedTuple):
    """Grays of V photographs, stored for reading between pixels.

    Attributes:
      cameras: stacked cameras, of size `H, W`.
      quads: `[V, H, W]` uint32, of each pixel the grays in [0, 255] of itself, its right, its lower
        and its lower right neighbor, from the lowest byte; borders are repeated.
      weight: `[V, H, W]` float32, 0 where a pixel does not count.
    """

    cameras: Camera
    quads: jax.Array
    weight: jax.Array


def pack_photographs(cameras: Camera, gray: jax.Array, weight: jax.Array) -> Photographs:
    """Round and clip grays `[V, H, W]` to bytes, and pack four neighbors into one number."""
    rounded = jnp.clip(jnp.round(gray), 0, 255).astype(jnp.uint32)
    padded = jnp.pad(rounded, ((0, 0), (0, 1), (0, 1)), mode="edge")
    _, height, width = gray.shape
    corners = [padded[:, y : y + height, x : x + width] for y in (0, 1) for x in (0, 1)]
    shifted = [corner << jnp.uint32(8 * i) for i, corner in enumerate(corners)]
    quads = shifted[0] | shifted[1] | shifted[2] | shifted[3]
    return Photographs(cameras, quads, weight.astype(jnp.float32))


def match_planes(
    photographs: Photographs,
    reference: jax.Array,
    neighbors: jax.Array,
    planes: jax.Array,
    config: StereoConfig,
    *,
    native: bool | None = None,
) -> jax.Array:
    """Return how badly planes at the pixels of one photograph fit its neighbors.

    Args:
      photographs: all photographs.
      reference: `[]` int32, index of the photograph whose pixels have planes.
      neighbors: `[N]` int32, indices of the photographs to compare with; -1 is none.
      planes: `[K, 3, H, W]` planes, see `planes`.
      config: size of patches, scales, and how many of the neighbors count.
      native: whether to call the native library; None: where it is there and a program is
        compiled for CPUs.

    Returns:
      `[K, H, W]` costs in [0, 1]: the mean of 1 - NCC, no more than 1, over the `config.best`
      neighbors that fit best. A neighbor that does not show the point counts as 1.

    Raises:
      LibraryError: the library is to be called, and is not there.
    """
    camera = camera_at(photographs.cameras, reference)
    others = camera_at(photographs.cameras, jnp.maximum(neighbors, 0))
    matrix, offset = relative_transforms(camera, others)
    transforms = jnp.concatenate([matrix, offset[..., None]], axis=-1)
    arrays = _Arrays(photographs, reference, neighbors, transforms, planes)
    natively = functools.partial(_match_natively, config=config)
    in_jax = functools.partial(_match_in_jax, config=config)
    single = transforms.dtype == planes.dtype == photographs.weight.dtype == jnp.float32
    if native is None and single and library.available():
        return jax.lax.platform_dependent(arrays, cpu=natively, default=in_jax)
    if native:
        library.require("native=True", "leave it out")
    return natively(arrays) if native else in_jax(arrays)


class _Arrays(NamedTuple):
    """What is matched: arguments of `match_planes`, and `[N, 3, 4]` maps into the neighbors."""

    photographs: Photographs
    reference: jax.Array
    neighbors: jax.Array
    transforms: jax.Array
    planes: jax.Array


def _match_in_jax(arrays: _Arrays, config: StereoConfig) -> jax.Array:
    photographs, reference, neighbors, transforms, planes = arrays
    patches = _read_patches(photographs, reference, config)
    best = min(config.best, neighbors.shape[0])

    def match(plane: jax.Array) -> jax.Array:
        def compare(neighbor: tuple[jax.Array, jax.Array]) -> jax.Array:
            return _compare(photographs, patches, plane, *neighbor, config)

        costs = jax.lax.map(compare, (neighbors, transforms))
        missing = (config.best - best) * 1.0
        return (jnp.sum(jnp.sort(costs, axis=0)[:best], axis=0) + missing) / config.best

    return jax.lax.map(match, planes)


def _match_natively(arrays: _Arrays, config: StereoConfig) -> jax.Array:
    photographs, reference, neighbors, transforms, planes = arrays
    costs = jax.ShapeDtypeStruct((planes.shape[0], *planes.shape[2:]), jnp.float32)
    function = jax.ffi.ffi_call("jaxcloseup_stereo", costs, vmap_method="sequential")
    gray, pixel, noise = _scales(config)
    return function(
        *(photographs.quads, photographs.weight),
        *(jnp.asarray(index, jnp.int32) for index in (reference, neighbors)),
        *(transforms, planes),
        patch=np.array([config.radius, config.stride, config.best], np.int64),
        scales=np.array([np.sqrt(gray), pixel, noise], np.float32),
    )


def _scales(config: StereoConfig) -> tuple[float, float, float]:
    """Return factors on squared differences of grays and on squared pixels, and the noise."""
    return 1 / config.gray_sigma**2, 1 / (2 * config.radius**2), config.noise


class _Patches(NamedTuple):
    """Samples of a patch about each pixel: weights of sum 1 and grays, `[S, H, W]`."""

    weight: jax.Array
    gray: jax.Array


def _offsets(config: StereoConfig) -> jax.Array:
    """Return (dx, dy) of the samples of a patch, `[S, 2]` int32."""
    steps = jnp.arange(-config.radius, config.radius + 1, config.stride)
    return jnp.stack(jnp.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def _read_patches(photographs: Photographs, reference: jax.Array, config: StereoConfig) -> _Patches:
    gray = (photographs.quads[reference] & 255).astype(jnp.float32)
    gray_scale, pixel_scale, _ = _scales(config)
    padded, counts = (
        jnp.pad(image, config.radius, mode="edge")
        for image in (gray, photographs.weight[reference] > 0)
    )

    def sample(offset: jax.Array) -> tuple[jax.Array, jax.Array]:
        start = offset[::-1] + config.radius
        own, count = (jax.lax.dynamic_slice(image, start, gray.shape) for image in (padded, counts))
        far = pixel_scale * jnp.sum(offset**2).astype(gray.dtype)
        return jnp.where(count, jnp.exp(-gray_scale * (own - gray) ** 2 - far), 0), own

    weight, samples = jax.vmap(sample)(_offsets(config))
    total = jnp.maximum(jnp.sum(weight, axis=0), 1e-12)
    return _Patches(weight / total[None], samples)


def _compare(
    photographs: Photographs,
    patches: _Patches,
    plane: jax.Array,
    neighbor: jax.Array,
    transform: jax.Array,
    config: StereoConfig,
) -> jax.Array:
    """Return 1 - NCC `[H, W]` with one neighbor."""
    height, width = plane.shape[1:]
    quads, weight = photographs.quads[neighbor], photographs.weight[neighbor]
    pixels = pixel_grid(height, width)

    def project(offset: jax.Array) -> tuple[jax.Array, jax.Array]:
        dx, dy = offset.astype(plane.dtype)
        inverse = plane[0] + dx * plane[1] + dy * plane[2]
        one = jnp.stack([pixels[..., 0] + dx, pixels[..., 1] + dy, jnp.ones_like(inverse), inverse])
        seen = jnp.moveaxis(matmul(transform, one.reshape(4, -1)).reshape(3, height, width), 0, -1)
        return seen[..., :2] / seen[..., 2:], seen[..., 2]

    landed, ratio = project(jnp.zeros(2))
    x, y = landed[..., 0], landed[..., 1]
    inside = (ratio > 1e-6) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    column, row = (jnp.clip(at, 0, size - 1).astype(int) for at, size in ((x, width), (y, height)))
    inside &= (weight[row, column] > 0) & (neighbor >= 0) & (plane[0] > 0)
    grays = jax.vmap(lambda offset: _read(quads, project(offset)[0]))(_offsets(config))

    def average(of: jax.Array) -> jax.Array:
        return jnp.sum(patches.weight * of, axis=0)

    # The means are subtracted first: squares of grays would cancel.
    own = patches.gray - average(patches.gray)[None]
    theirs = grays - average(grays)[None]
    product = (average(own**2) + config.noise) * (average(theirs**2) + config.noise)
    ncc = average(own * theirs) / jnp.sqrt(product)
    return jnp.where(inside, jnp.clip(1 - ncc, 0, 1), 1)


def _read(quads: jax.Array, pixels: jax.Array) -> jax.Array:
    """Read grays bilinearly at pixels `[..., 2]`; borders are repeated."""
    height, width = quads.shape
    last = jnp.array([width - 1, height - 1], pixels.dtype)
    at = jnp.clip(jnp.nan_to_num(pixels - 0.5), 0, last.reshape((1,) * (pixels.ndim - 1) + (2,)))
    corner = at.astype(jnp.int32)
    wx, wy = jnp.moveaxis(at - corner.astype(at.dtype), -1, 0)
    quad = quads[corner[..., 1], corner[..., 0]]
    a, b, c, d = (
        ((quad >> jnp.uint32(shift)) & 255).astype(jnp.float32) for shift in (0, 8, 16, 24)
    )
    return (1 - wy) * ((1 - wx) * a + wx * b) + wy * ((1 - wx) * c + wx * d)
