"""Pack splats as SPZ, version 3: a few bytes for each number, and all of them compressed.

What the format leaves open is chosen for size: coordinates are as fine as the splats are small,
rotations have 6 bits, and splats are in the order of their heights, so that these repeat.

The format, its rounding and its frame (x right, y up, z backward, while PLY files have y down and z
forward) are those of its authors' own programs: https://github.com/nianticlabs/spz.
"""

import gzip
import math
import struct
import warnings

import jax
import numpy as np

from jaxcloseup.artifacts.file_splats import FileSplats, file_splats, smallest_three, with_y_up
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.io.placement import UNMOVED, Placement


_MAGIC, _VERSION = 0x5053474E, 3
_COLOR_SCALE = 0.15
_LEAST_SCALE, _MOST_SCALE = -10, 255 / 16 - 10  # natural logarithms
_ANTIALIASED = 1  # the flag of splats that learned to be drawn with a filter that keeps their light
_MOST_BITS = 20  # of the fraction of coordinates; more would say nothing
_STEP = 0.3  # largest step of coordinates over the smaller radius of small splats, ...
_SMALL = 0.1  # a tenth of which are smaller
_TURN = 8  # step of rotations, of 511
_FIRST_BUCKET, _BUCKET = 8, 16  # of degree 1, and of the higher ones: 5 and 4 of 8 bits


def pack_spz(
    surfels: Surfels,
    alive: jax.Array | np.ndarray,
    *,
    placement: Placement = UNMOVED,
    antialiased: bool = False,
) -> tuple[bytes, int]:
    """Return the surfels that are alive as the bytes of a file.

    Args:
      surfels: `N` surfels, which get a thickness, or volumetric Gaussians.
      alive: `[N]` bool.
      placement: of the surfels in the coordinates to write. By default they stay.
      antialiased: whether they were trained with `raster.antialias`, which viewers are told.

    Warns:
      UserWarning: radii are smaller or larger than the format can say.

    Returns:
      The bytes, and the number of alive surfels that were dropped because a value is not finite.
    """
    splats, dropped = file_splats(surfels, alive, placement=placement)
    splats = with_y_up(splats)
    _warn_of_radii(splats)
    bits = _fraction_bits(splats)
    steps = np.rint(splats.means * 2.0**bits)
    order = np.lexsort(steps.T[[2, 0, 1]])
    splats = FileSplats(*(array[order] for array in splats))
    positions = np.clip(steps[order], -(2**23), 2**23 - 1).astype("<i4")
    degree = math.isqrt(splats.sh.shape[1]) - 1
    flags, count = _ANTIALIASED if antialiased else 0, len(splats.means)
    header = struct.pack("<IIIBBBB", _MAGIC, _VERSION, count, degree, bits, flags, 0)
    parts = (
        positions[..., None].view(np.uint8)[..., :3],
        _bytes(255 * splats.opacities),
        _bytes(255 * (_COLOR_SCALE * splats.sh[:, 0] + 0.5)),
        _bytes(16 * (splats.log_scales - _LEAST_SCALE)),
        _rotations(splats.quaternions),
        _harmonics(splats.sh[:, 1:]),
    )
    packed = header + b"".join(part.tobytes() for part in parts)
    return gzip.compress(packed, compresslevel=9, mtime=0), dropped


def _warn_of_radii(splats: FileSplats) -> None:
    radii = np.sort(splats.log_scales, axis=1)[:, 1:]  # not the thickness, which shows least
    wrong = np.any((radii < _LEAST_SCALE) | (radii > _MOST_SCALE), axis=1)
    if wrong.any():
        warnings.warn(
            f"SPZ has radii of {math.exp(_LEAST_SCALE):.2g} to {math.exp(_MOST_SCALE):.0f} units: "
            f"{wrong.sum():,} of {len(wrong):,} splats are made larger or smaller. Use another "
            "format, or a capture in another unit",
            stacklevel=3,
        )


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _fraction_bits(splats: FileSplats) -> int:
    """Return the bits of the fraction of coordinates, whose 24 bits must hold the largest."""
    if not len(splats.means):
        return 0
    # Surfels have a thickness, which is no radius.
    smaller = np.sort(splats.log_scales, axis=1)[:, -2]
    bits = math.ceil(-math.log2(_STEP * math.exp(np.quantile(smaller, _SMALL))))
    largest = max(float(np.abs(splats.means).max()), 1e-6)
    return int(np.clip(min(bits, math.floor(22.999 - math.log2(largest))), 0, _MOST_BITS))


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """Return the three smallest components of quaternions `[N, 4]` (w, x, y, z) as `[N]` words."""
    largest, others = smallest_three(quaternions[:, [1, 2, 3, 0]])
    words = largest.astype(np.uint32)
    for value in others.T:
        size = _TURN * np.rint(511 / _TURN * np.abs(value) * math.sqrt(2))
        size = np.minimum(size, 511).astype(np.uint32)
        words = words << 10 | ((value < 0) & (size > 0)).astype(np.uint32) << 9 | size
    return words.astype("<u4")


def _harmonics(sh: np.ndarray) -> np.ndarray:
    """Return coefficients `[N, K, 3]` above degree 0, to the nearest of few levels, as bytes."""
    count = sh.shape[1]
    buckets = np.where(np.arange(count) < 3, _FIRST_BUCKET, _BUCKET)[:, None]
    values = np.rint(128 * sh) + 128
    return np.clip((values + buckets // 2) // buckets * buckets, 0, 255).astype(np.uint8)
