"""Pictures: PNG files, colour maps for depth and error, panels side by side.

Images are `[H, W, 3]`, red first, or `[H, W]` grey; floats in [0, 1] or uint8; NumPy or JAX arrays.
"""

import base64
import pathlib
from collections.abc import Iterable, Sequence

import cv2
import jax
import numpy as np

from jaxcloseup.files import write_file


Image = np.ndarray | jax.Array

_LABEL_HEIGHT = 24


def to_uint8(image: Image) -> np.ndarray:
    """The image as uint8 `[H, W, 3]`: clipped, rounded, black where it is not a number."""
    image = np.asarray(image)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(f"an image must be [H, W, 3] or [H, W], this one is {image.shape}.")
    if image.dtype != np.uint8:
        image = np.rint(np.clip(np.nan_to_num(image.astype(np.float32)), 0, 1) * 255)
    return (
        np.repeat(image[..., None], 3, 2).astype(np.uint8) if image.ndim == 2 else np.uint8(image)
    )


def write_png(path: str | pathlib.Path, image: Image) -> None:
    """Write an image as an 8-bit PNG, whole or not at all, making its folders.

    Raises:
      OSError: the path cannot be written.
    """
    write_file(path, _png(image))


def png_data_uri(image: Image) -> str:
    """The image as a `data:` address, for a page that needs no files beside it."""
    return "data:image/png;base64," + base64.b64encode(_png(image)).decode()


def colorize_depth(
    depth: Image,
    *,
    near: float | None = None,
    far: float | None = None,
    valid: Image | None = None,
) -> np.ndarray:
    """Depth in false colours, uint8 `[H, W, 3]`: near is red, far is blue, nothing is black.

    Colours follow inverse depth, so that what is near keeps most of them.

    Args:
      depth: `[H, W]` z-depth; what is not positive and finite is nothing.
      near: depth of the reddest red; by default the 2nd percentile of the depths.
      far: depth of the darkest blue; by default the 98th.
      valid: `[H, W]` bool, False where depth means nothing.
    """
    depth = np.asarray(depth, np.float64)
    shown = np.isfinite(depth) & (depth > 0)
    if valid is not None:
        shown &= np.asarray(valid, bool)
    if not shown.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.percentile(depth[shown], [2, 98])
    low, high = (low if near is None else near), (high if far is None else far)
    inverse = 1 / np.where(shown, depth, 1)
    unit = (inverse - 1 / high) / max(1 / low - 1 / high, 1e-12)
    return np.where(shown[..., None], _map(unit, cv2.COLORMAP_TURBO), np.uint8(0))


def colorize_error(error: Image, *, highest: float = 0.25) -> np.ndarray:
    """Absolute error in false colours, uint8 `[H, W, 3]`: black is none, bright yellow is much.

    Args:
      error: `[H, W]`, or `[H, W, 3]` to be averaged over channels; signs do not matter.
      highest: the error of the brightest colour, fixed so that pictures compare.
    """
    error = np.abs(np.asarray(error, np.float64))
    return _map((error.mean(-1) if error.ndim == 3 else error) / highest, cv2.COLORMAP_INFERNO)


def side_by_side(
    images: Iterable[Image], *, labels: Sequence[str] | None = None, gap: int = 8
) -> np.ndarray:
    """Panels in a row on white, uint8 `[H, W, 3]`, aligned at the top, each under its label."""
    panels = [to_uint8(image) for image in images]
    if labels is not None:
        panels = [
            np.concatenate([_label(text, panel.shape[1]), panel])
            for text, panel in zip(labels, panels, strict=True)
        ]
    height = max(panel.shape[0] for panel in panels)
    width = sum(panel.shape[1] for panel in panels) + gap * (len(panels) - 1)
    row, left = np.full((height, width, 3), 255, np.uint8), 0
    for panel in panels:
        row[: panel.shape[0], left : left + panel.shape[1]] = panel
        left += panel.shape[1] + gap
    return row


def _png(image: Image) -> bytes:
    return cv2.imencode(".png", to_uint8(image)[..., ::-1])[1].tobytes()


def _map(unit: np.ndarray, colours: int) -> np.ndarray:
    """Colours of values in [0, 1]; OpenCV's maps come blue first."""
    levels = np.rint(np.clip(np.nan_to_num(unit), 0, 1) * 255).astype(np.uint8)
    return cv2.applyColorMap(levels, colours)[..., ::-1]


def _label(text: str, width: int) -> np.ndarray:
    """A white strip with `text`, made small enough to fit; OpenCV's fonts know ASCII only."""
    strip = np.full((_LABEL_HEIGHT, width, 3), 255, np.uint8)
    text = text.encode("ascii", "replace").decode()
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.5
    (length, _), _ = cv2.getTextSize(text, font, scale, 1)
    scale *= min(1, (width - 4) / max(length, 1))
    return cv2.putText(strip, text, (2, 17), font, scale, (0, 0, 0), 1, cv2.LINE_AA)
