"""Pack splats as SPZ, version 3: a few bytes for each number, and all of them compressed.

The format, its rounding and its frame (x right, y up, z backward, while PLY files have y down and z
forward) are those of its authors' own programs: https://github.com/nianticlabs/spz.
"""

import gzip
import math
import struct

import jax
import numpy as np

from jaxcloseup.artifacts.viewer_gaussians import thickened
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.io.placement import UNMOVED, Placement


_MAGIC, _VERSION = 0x5053474E, 3
_COLOR_SCALE = 0.15
_MOST_BITS = 20  # of the fraction of coordinates; more would say nothing
# What each basis function of spherical harmonics above degree 0 becomes where y and z change sign.
_SIGNS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
_FIRST_BUCKET, _BUCKET = 8, 16  # of degree 1, and of the higher ones: 5 and 4 of 8 bits


def pack_spz(
    surfels: Surfels, alive: jax.Array, *, placement: Placement = UNMOVED
) -> tuple[bytes, int]:
    """Return the surfels that are alive as the bytes of a file.

    Args:
      surfels: `N` surfels, which get a thickness, or volumetric Gaussians.
      alive: `[N]` bool.
      placement: of the surfels in the coordinates to write. By default they stay.

    Returns:
      The bytes, and the number of alive surfels that were dropped because a value is not finite.
    """
    arrays = {name: np.asarray(array, np.float32) for name, array in vars(surfels).items()}
    living = np.asarray(alive)
    finite = [np.isfinite(array).reshape(len(living), -1).all(axis=1) for array in arrays.values()]
    kept = living & np.all(finite, axis=0)
    arrays = {name: array[kept] for name, array in arrays.items()}
    means = placement.to_file(arrays["means"]) * [1, -1, -1]
    scales = thickened(arrays["log_scales"]) - np.float32(math.log(placement.scale))
    bits, positions = _positions(means)
    opacity = 1 / (1 + np.exp(-np.clip(arrays["opacity_logits"], -80, 80)))
    sh = arrays["sh"]
    degree = math.isqrt(sh.shape[1]) - 1
    header = struct.pack("<IIIBBBB", _MAGIC, _VERSION, len(means), degree, bits, 0, 0)
    parts = (
        positions,
        _bytes(255 * opacity),
        _bytes(255 * (_COLOR_SCALE * sh[:, 0] + 0.5)),
        _bytes(16 * (scales + 10)),
        _rotations(arrays["quaternions"]),
        _harmonics(sh[:, 1:]),
    )
    packed = header + b"".join(part.tobytes() for part in parts)
    return gzip.compress(packed, compresslevel=9, mtime=0), int(np.sum(living & ~kept))


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _positions(means: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the bits of the fraction, and coordinates `[N, 3]` as `[N, 3, 3]` bytes."""
    largest = float(np.abs(means).max(initial=1e-6))
    bits = int(np.clip(math.floor(22.999 - math.log2(largest)), 0, _MOST_BITS))
    fixed = np.clip(np.rint(means * 2.0**bits), -(2**23), 2**23 - 1).astype("<i4")
    return bits, fixed[..., None].view(np.uint8)[..., :3]


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """Return the three smallest components of quaternions `[N, 4]` (w, x, y, z) as `[N]` words."""
    turned = np.asarray(quaternions, np.float64)[:, [1, 2, 3, 0]] * [1, -1, -1, 1]
    turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)
    largest = np.abs(turned).argmax(axis=1)
    rows = np.arange(len(turned))
    turned *= np.where(turned[rows, largest] < 0, -1.0, 1.0)[:, None]
    words = largest.astype(np.uint32)
    for axis in range(4):
        value = turned[:, axis]
        size = np.floor(511 * np.abs(value) * math.sqrt(2) + 0.5).astype(np.uint32)
        packed = words << 10 | (value < 0).astype(np.uint32) << 9 | np.minimum(size, 511)
        words = np.where(axis == largest, words, packed).astype(np.uint32)
    return words.astype("<u4")


def _harmonics(sh: np.ndarray) -> np.ndarray:
    """Return coefficients `[N, K, 3]` above degree 0, to the nearest of few levels, as bytes."""
    count = sh.shape[1]
    buckets = np.where(np.arange(count) < 3, _FIRST_BUCKET, _BUCKET)[:, None]
    values = np.rint(128 * sh * _SIGNS[:count, None]) + 128
    return np.clip((values + buckets // 2) // buckets * buckets, 0, 255).astype(np.uint8)
