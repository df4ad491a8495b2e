"""Understand the values of masks: white is kept, but what is white depends on who wrote them.

A mask may be gray, a palette whose index tells objects apart, colors that do, or shapes in alpha;
its kept pixels may be 1 instead of 255. One mask alone may be all black or all white, so the values
are understood from all masks of a capture.
"""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxcloseup.captures.photo_files import decode_channels, read_file
from jaxcloseup.photos.scene import SceneError


_NOISE = 31  # of 255, by how much lossy files change black and gray
_WHITES = {255: range(128, 256), 65535: range(2**15, 2**16)}  # and what soft masks may reach
# Whose values only tell objects apart, and become white: what is ignored, and what is kept.
_KINDS = {"palette": ("index 0", "index above 0"), "colors": ("black", "any but black")}


class MaskValues(NamedTuple):
    """What the values of a capture's masks mean.

    Attributes:
      white: value that is kept whole, such as 1, 255 or 65535; at most the largest of a file.
      by_alpha: whether shapes are drawn in alpha, in one color.
    """

    white: int = 255
    by_alpha: bool = False


class _Mask(NamedTuple):
    """A mask as it is stored."""

    value: np.ndarray  # `[H, W]` uint8 or uint16 brightness
    alpha: np.ndarray | None  # `[H, W]` of the same type; None where the file has none
    kind: str = ""  # one of `_KINDS`


def read_mask(
    path: pathlib.Path, values: MaskValues | None = None, *, data: np.ndarray | None = None
) -> np.ndarray:
    """Read a mask as uint8 `[H, W]`: 255 where it keeps a pixel, 0 where it does not.

    Args:
      path: path of the file.
      values: what the values of this mask and those beside it mean; by default this one decides.
      data: bytes of the file, if already read.

    Raises:
      SceneError: it is no image that can be read, or its values could mean anything.
    """
    if values is None:
        values, _ = understand_masks([path])
    mask = _decode(path, read_file(path) if data is None else data)
    largest = np.iinfo(mask.value.dtype).max
    scale = np.minimum(np.arange(largest + 1) / min(values.white, largest), 1)
    weight = np.rint(255 * scale).astype(np.uint8)[mask.value]
    if mask.alpha is None:
        return weight
    shown = mask.alpha / np.float32(largest)
    return np.rint(shown * (255 if values.by_alpha else weight)).astype(np.uint8)


def understand_masks(
    files: Sequence[pathlib.Path], *, inverted: bool = False
) -> tuple[MaskValues, str]:
    """Find out what the values of masks mean, from as few of them as it takes.

    Args:
      files: the masks of a capture, at least one.
      inverted: whether white is ignored, which only the words tell.

    Returns:
      The meaning, and words for it such as "0 and 1; 1 is kept".

    Raises:
      SceneError: a mask cannot be read, or the values could mean anything.
    """
    used: set[int] = set()  # values of pixels that are not transparent
    opacities: set[int] = set()  # of 255
    kinds: set[str] = set()
    for file in files:
        mask = _decode(file, read_file(file))
        largest = np.iinfo(mask.value.dtype).max
        used |= _distinct(mask.value if mask.alpha is None else mask.value[mask.alpha > 0])
        alpha = {largest} if mask.alpha is None else _distinct(mask.alpha)
        opacities |= {value * 255 // largest for value in alpha}
        kinds |= {mask.kind} - {""}
        if {0, largest} <= used:
            break  # no other mask could change the meaning
    if len(used) < 2 and len(opacities) > 1:
        return MaskValues(by_alpha=True), _kept(
            "shapes in alpha", "transparent", "opaque", inverted
        )
    if len(used) < 2:
        color = "white" if any(used) else "black"
        nothing = ": they mask nothing" if any(used) != inverted else ""
        return MaskValues(max(used, default=0) or 255), f"{color} everywhere{nothing}"
    top = max(used)
    white = top if len(used - {0}) == 1 else _white(files, used)
    for kind in sorted(kinds):
        return MaskValues(white), _kept(kind, *_KINDS[kind], inverted)
    if top == white and top not in _WHITES:
        return MaskValues(white), _kept(f"0 and {white}", "0", str(white), inverted)
    return MaskValues(white), _kept("", "black", "white", inverted)


def _kept(what: str, low: str, high: str, inverted: bool) -> str:
    """Say which of two values is kept."""
    return f"{what}; " * bool(what) + f"{low if inverted else high} is kept"


def _white(files: Sequence[pathlib.Path], used: set[int]) -> int:
    """Return the white of soft masks, or raise if their largest value could be anything."""
    top = max(used)
    for white, tops in _WHITES.items():
        if top in tops:
            return white
    folder = files[0] if len(files) == 1 else files[0].parent
    raise SceneError(
        f"{folder}: masks hold {len(used)} values from {min(used)} to {top}, and which of them are "
        "kept is unclear: save 255 where pixels are kept, and 0 where they are ignored."
    )


def _distinct(values: np.ndarray) -> set[int]:
    """Return the different values of uint8 or uint16, of any shape."""
    used = np.zeros(np.iinfo(values.dtype).max + 1, bool)
    used[values] = True
    return set(np.flatnonzero(used).tolist())


def _decode(path: pathlib.Path, data: np.ndarray) -> _Mask:
    colors, alpha = decode_channels(path, data)
    value = colors[..., 0]
    if colors.shape[-1] == 1:
        return _Mask(value, alpha)
    value = colors.max(-1)
    largest = np.iinfo(value.dtype).max
    noise = _NOISE * (largest // 255)
    palette = _palette(data)
    if len(palette) and np.ptp(palette, axis=-1).any():
        objects = (colors != palette[0]).any(-1)
        return _Mask(objects * np.uint8(255), alpha, "palette")
    if (value - colors.min(-1)).max() > noise:
        return _Mask((value > noise) * value.dtype.type(largest), alpha, "colors")
    return _Mask(value, alpha)


def _palette(data: np.ndarray) -> np.ndarray:
    """Return the colors `[N, 3]` of a PNG's palette; none for other files."""
    held = data.tobytes()
    at = held.find(b"PLTE") if held.startswith(b"\x89PNG") and held[25:26] == b"\x03" else -1
    if at < 0:
        return np.zeros((0, 3), np.uint8)
    length = int.from_bytes(held[at - 4 : at], "big") // 3 * 3
    return np.frombuffer(held[at + 4 : at + 4 + length], np.uint8).reshape(-1, 3)
