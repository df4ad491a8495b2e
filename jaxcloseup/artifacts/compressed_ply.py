"""Pack splats as compressed PLY: chunks of 256 neighbors, in 16 bytes each and a few for color.

The layout is that of PlayCanvas and SuperSplat. A chunk holds the smallest and largest positions,
log scales and colors of its splats, and these are fractions of that range: positions and log scales
of 11, 10 and 11 bits, colors and opacity of 8. Rotations are the three smallest components of a
quaternion, of 10 bits. Spherical harmonics above degree 0 follow, in 8 bits between -4 and 4.
"""

import jax
import numpy as np

from jaxcloseup.artifacts.file_splats import file_splats, smallest_three
from jaxcloseup.fields.splats.local import morton_order
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.io.placement import UNMOVED, Placement
from jaxcloseup.io.ply import header_lines


_CHUNK = 256
_order = jax.jit(morton_order)
_LIMIT = 20.0  # of log scales, which the format cuts


def pack_compressed_ply(
    surfels: Surfels, alive: jax.Array, *, placement: Placement = UNMOVED
) -> tuple[bytes, int]:
    """Return the surfels that are alive as the bytes of a file, neighbors together.

    Args:
      surfels: `N` surfels, which get a thickness, or volumetric Gaussians.
      alive: `[N]` bool.
      placement: of the surfels in the coordinates to write. By default they stay.

    Returns:
      The bytes, and the number of alive surfels that were dropped because a value is not finite.
    """
    order = np.asarray(_order(surfels, alive))
    surfels = jax.tree.map(lambda leaf: np.asarray(leaf)[order], surfels)
    splats, dropped = file_splats(surfels, np.asarray(alive)[order], placement=placement)
    means, bounds_of_means = _in_chunks(splats.means)
    scales, bounds_of_scales = _in_chunks(np.clip(splats.log_scales, -_LIMIT, _LIMIT))
    colors, bounds_of_colors = _in_chunks(splats.base_colors)
    bounds = [*bounds_of_means, *bounds_of_scales, *bounds_of_colors]
    chunks = np.concatenate(bounds, axis=1).astype("<f4")
    words = [
        _pack(means, (11, 10, 11)),
        _rotations(splats.quaternions),
        _pack(scales, (11, 10, 11)),
        _pack(np.column_stack([colors, splats.opacities]), (8, 8, 8, 8)),
    ]
    vertices = np.stack(words, axis=1).astype("<u4")
    # Channel by channel, as in plain files.
    higher = splats.sh[:, 1:].swapaxes(1, 2).reshape(len(vertices), 3 * (splats.sh.shape[1] - 1))
    harmonics = np.clip(np.floor((higher / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    header = _header(len(chunks), len(vertices), harmonics.shape[1], placement.offset)
    return header + chunks.tobytes() + vertices.tobytes() + harmonics.tobytes(), dropped


def _header(chunks: int, count: int, harmonics: int, offset: np.ndarray) -> bytes:
    ranges = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
    names = [f"{end}_{name}" for names in ranges for end in ("min", "max") for name in names]
    packed = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
    lines = [
        *header_lines(offset),
        f"element chunk {chunks}",
        *(f"property float {name}" for name in names),
        f"element vertex {count}",
        *(f"property uint {name}" for name in packed),
    ]
    if harmonics:
        lines += [f"element sh {count}"]
        lines += [f"property uchar f_rest_{i}" for i in range(harmonics)]
    return "\n".join([*lines, "end_header\n"]).encode()


def _in_chunks(values: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return values `[M, 3]` as fractions of their chunk's range, and its ends, `[chunks, 3]`."""
    starts = np.arange(0, len(values), _CHUNK)
    if not len(values):
        return values, (np.zeros((0, 3)), np.zeros((0, 3)))
    values = values.astype(np.float32)
    low, high = (end.reduceat(values, starts) for end in (np.minimum, np.maximum))
    chunk = np.arange(len(values)) // _CHUNK
    spread = np.maximum(high - low, 1e-30)
    return (values - low[chunk]) / spread[chunk], (low, high)


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    largest, others = smallest_three(quaternions)
    return largest.astype(np.uint32) << 30 | _pack(others * np.sqrt(0.5) + 0.5, (10, 10, 10))


def _pack(fractions: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Pack fractions `[M, len(bits)]` into `[M]` words, the first in the highest bits."""
    words = np.zeros(len(fractions), np.uint32)
    for fraction, count in zip(fractions.T, bits, strict=True):
        most = 2**count - 1
        words = words << count | np.clip(np.rint(fraction * most), 0, most).astype(np.uint32)
    return words
