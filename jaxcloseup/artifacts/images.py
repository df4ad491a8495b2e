"""Draw images: PNG files, color maps for depth, error, normals and support, rows of panels.

Images are RGB `[H, W, 3]` or gray `[H, W]`; floats in [0, 1] or uint8; NumPy or JAX arrays.
"""

import base64
import io
import pathlib
from collections.abc import Callable, Iterable, Sequence

import cv2
import jax
import numpy as np
import PIL.Image

from jaxcloseup.io.files import write_file


Image = np.ndarray | jax.Array

_LABEL_HEIGHT = 24
_LEGEND_WIDTH = 360
_UNSEEN = (230, 0, 126)  # magenta
_FOOTPRINTS, _COUNTS = (1, 2, 4, 8), (-9, -5, -3, -2)  # where colors of support change
_ERRORS = 2, 4, 8, 16, 32  # the same of expected errors, in gray levels


def to_uint8(image: Image) -> np.ndarray:
    """Convert an image to uint8 `[H, W, 3]`: clip, round, and make NaN black."""
    image = np.asarray(image)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(f"an image must be [H, W, 3] or [H, W], got {image.shape}.")
    if image.dtype != np.uint8:
        image = np.rint(np.clip(np.nan_to_num(image.astype(np.float32)), 0, 1) * 255)
    image = image.astype(np.uint8, copy=False)
    return np.repeat(image[..., None], 3, 2) if image.ndim == 2 else image


def encode_png(image: Image) -> bytes:
    """Encode an image as the bytes of an 8-bit PNG."""
    # By OpenCV, because it takes a twentieth of Pillow's time, at any level of compression.
    return cv2.imencode(".png", to_uint8(image)[..., ::-1])[1].tobytes()


def write_png(path: str | pathlib.Path, image: Image) -> None:
    """Write an image as an 8-bit PNG, atomically, and create its folders.

    Raises:
      OSError: the path cannot be written.
    """
    write_file(path, encode_png(image))


def encode_jpeg(image: Image, *, quality: int = 95) -> bytes:
    """Encode an image as a JPEG whose colors are as fine as its brightness."""
    full = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, *full]
    return cv2.imencode(".jpg", to_uint8(image)[..., ::-1], options)[1].tobytes()


def webp_data_uri(image: Image, *, quality: int = 90) -> str:
    """Encode an image as a `data:` URI, for a self-contained HTML page.

    Args:
      image: the image.
      quality: WebP's, 1 to 100; higher ones keep all colors.
    """
    options = [cv2.IMWRITE_WEBP_QUALITY, quality]
    data = cv2.imencode(".webp", to_uint8(image)[..., ::-1], options)[1]
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode()


def encode_webp_animation(frames: Sequence[Image], *, fps: float, quality: int = 80) -> bytes:
    """Encode frames of one size as the bytes of a WebP that plays for ever.

    Args:
      frames: at least one image; one that is shown several times is kept once.
      fps: frames per second.
      quality: WebP's, 1 to 100.
    """
    each = {id(frame): frame for frame in frames}
    made = {key: PIL.Image.fromarray(to_uint8(frame)) for key, frame in each.items()}
    first, *rest = (made[id(frame)] for frame in frames)
    file, duration = io.BytesIO(), round(1000 / fps)
    options = {"duration": duration, "loop": 0, "quality": quality}
    first.save(file, "WEBP", save_all=True, append_images=rest, **options)
    return file.getvalue()


def colorize_depth(
    depth: Image, *, near: float | None = None, far: float | None = None, valid: Image | None = None
) -> np.ndarray:
    """Map depth to colors, uint8 `[H, W, 3]`: near is red, far is blue, invalid is black.

    Colors follow inverse depth, which gives near surfaces most of the range.

    Args:
      depth: `[H, W]` z-depth; values that are not positive and finite are invalid.
      near: depth drawn as the darkest red; by default the 2nd percentile of the valid depths.
      far: depth drawn as the darkest blue; by default the 98th percentile.
      valid: `[H, W]` bool, False at further invalid pixels.
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
    """Map absolute error to colors, uint8 `[H, W, 3]`, from black (0) to bright yellow.

    Args:
      error: `[H, W]` errors, or `[H, W, 3]` to average over channels; signs are ignored.
      highest: error drawn in the brightest color; fixed, so that images are comparable.
    """
    error = np.abs(np.asarray(error, np.float64))
    return _map((error.mean(-1) if error.ndim == 3 else error) / highest, cv2.COLORMAP_INFERNO)


def colorize_expected_error(error: Image) -> np.ndarray:
    """Draw the error that is expected at each pixel, with a legend in gray levels of 255.

    Args:
      error: `[H, W]` errors of colors in [0, 1]; NaN, drawn in magenta, where no photograph saw the
        surface.

    Returns:
      uint8 `[H', W', 3]`; small images are enlarged so that their legend is readable.
    """
    error = np.asarray(error)
    return _panel(255 * np.nan_to_num(error), np.isnan(error), _ERRORS, "more")


def colorize_normals(normal: Image) -> np.ndarray:
    """Map normals to colors (n + 1) / 2, uint8 `[H, W, 3]`; pixels without a normal are black.

    Args:
      normal: `[H, W, 3]` normals of any length; length 0 means no normal.
    """
    normal = np.nan_to_num(np.asarray(normal, np.float64))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    unit = normal / np.where(length > 0, length, 1)
    return to_uint8(np.where(length > 0, (unit + 1) / 2, 0))


def colorize_support(count: Image, footprint: Image) -> np.ndarray:
    """Draw how sharply, and in how many photographs, each pixel was seen: two panels with legends.

    Unseen pixels are magenta in both panels, a color that the maps do not contain.

    Args:
      count: `[H, W]` number of photographs that saw the pixel.
      footprint: `[H, W]` side of the finest photograph's pixel, in pixels of the view; drawn in
        steps of up to 1 (as sharp as the view), 2, 4, 8 and coarser.

    Returns:
      uint8 `[H', W', 3]`; small images are enlarged so that their legends are readable.
    """
    count = np.asarray(count)
    panels = [
        _panel(np.asarray(footprint), count < 1, _FOOTPRINTS, "coarser"),
        _panel(-count, count < 1, _COUNTS, "1"),
    ]
    titles = ["finest photograph's pixel, in pixels here", "photographs that saw it"]
    return side_by_side(panels, labels=titles)


def color_counts(count: Image) -> tuple[np.ndarray, np.ndarray]:
    """Return uint8 colors `[..., 3]` of numbers of photographs `[...]`, as `colorize_support`.

    The second array is their legend, an image.
    """
    count = np.asarray(count)
    colors, legend = _in_steps(-count, count < 1, _COUNTS, "1")
    return colors, legend(_LEGEND_WIDTH)


def color_errors(error: Image) -> tuple[np.ndarray, np.ndarray]:
    """Return uint8 colors `[..., 3]` of expected errors `[...]`, as `colorize_expected_error`.

    The second array is their legend, an image.
    """
    error = np.asarray(error)
    colors, legend = _in_steps(255 * np.nan_to_num(error), np.isnan(error), _ERRORS, "more")
    return colors, legend(_LEGEND_WIDTH)


def _panel(values: np.ndarray, unseen: np.ndarray, steps: Sequence[int], last: str) -> np.ndarray:
    """Draw an image of values in steps above its legend; small images are enlarged to fit it."""
    image, legend = _in_steps(values, unseen, steps, last)
    factor = -(-_LEGEND_WIDTH // image.shape[1])
    image = image.repeat(factor, axis=0).repeat(factor, axis=1)
    return np.concatenate([image, legend(image.shape[1])])


def _in_steps(
    values: np.ndarray, unseen: np.ndarray, steps: Sequence[int], last: str
) -> tuple[np.ndarray, Callable[[int], np.ndarray]]:
    """Return colors of values, and a function that draws their legend with a given width.

    `last` says what lies beyond all steps.
    """
    step = np.searchsorted(np.array(steps) * (1 + 1e-4 * np.sign(steps)), values)
    colors = _map(np.linspace(0.95, 0.1, len(steps) + 1), cv2.COLORMAP_VIRIDIS)
    colors = np.concatenate([colors.reshape(-1, 3), [_UNSEEN]]).astype(np.uint8)
    texts = [f"<={s}" if s > 0 else f">={-s}" for s in steps]
    texts += [last, "unseen"]
    return (
        colors[np.where(unseen, len(steps) + 1, step)],
        lambda width: _legend(colors, texts, width),
    )


def side_by_side(
    images: Iterable[Image], *, labels: Sequence[str] | None = None, gap: int = 8
) -> np.ndarray:
    """Draw labeled panels in a row on white, aligned at the top, uint8 `[H, W, 3]`."""
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


def _map(unit: np.ndarray, colors: int) -> np.ndarray:
    """Map values in [0, 1] to RGB with a color map of OpenCV, which stores blue first."""
    levels = np.rint(np.clip(np.nan_to_num(unit), 0, 1) * 255).astype(np.uint8)
    return cv2.applyColorMap(levels, colors)[..., ::-1]


def _label(text: str, width: int) -> np.ndarray:
    """Draw `text` on a white strip, scaled to fit; OpenCV's fonts have only ASCII."""
    strip = np.full((_LABEL_HEIGHT, width, 3), 255, np.uint8)
    text = text.encode("ascii", "replace").decode()
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.5
    (length, _), _ = cv2.getTextSize(text, font, scale, 1)
    scale *= min(1, (width - 4) / max(length, 1))
    return cv2.putText(strip, text, (2, 17), font, scale, (0, 0, 0), 1, cv2.LINE_AA)


def _legend(colors: np.ndarray, texts: Sequence[str], width: int) -> np.ndarray:
    """Draw a strip of color boxes, each with its text."""
    edges = np.linspace(0, width, len(texts) + 1).astype(int)
    boxes = []
    for color, text, left, right in zip(colors, texts, edges, edges[1:], strict=False):
        box = np.full((_LABEL_HEIGHT, right - left, 3), 255, np.uint8)
        box[4:-4, 2:14] = color
        box[:, 14:] = _label(text, right - left - 14)
        boxes.append(box)
    return np.concatenate(boxes, axis=1)
