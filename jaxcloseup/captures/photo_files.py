"""Decode, downscale and pad images."""

import io
import math
import pathlib
import re
import threading
import warnings

import cv2
import numpy as np
import PIL.Image

from jaxcloseup.captures.file_kinds import as_stored, unread_format
from jaxcloseup.io.files import read_bytes
from jaxcloseup.photos.scene import SceneError


ENDINGS = {".png", ".jpg", ".jpeg", ".jfif", ".webp", ".tif", ".tiff", ".bmp"}  # of photographs
MOST_PIXELS = 170_000_000  # a file of 100 kB may claim a billion of them
_MARKER = re.compile(rb"\xff+([^\x00\xff])", re.DOTALL)  # of a JPEG, before its scan
_filters = threading.Lock()  # filters of warnings belong to all threads


def read_file(path: pathlib.Path) -> np.ndarray:
    """Read the bytes of an image file as uint8 `[N]`.

    Raises:
      SceneError: the file is missing, cannot be read, or has more than 1 GiB.
    """
    try:
        # `cv2.imread` fails on non-ASCII paths on some systems; decoding from memory does not.
        return np.frombuffer(read_bytes(path), np.uint8)
    except OSError as error:
        raise SceneError(f"{path} cannot be read ({error.strerror}): restore the file.") from error


def read_image(
    path: pathlib.Path, *, background: float = 1.0, data: np.ndarray | None = None
) -> np.ndarray:
    """Read a photograph as uint8 RGB, `[H, W, 3]`, with transparent pixels over a background.

    Args:
      path: path of the file.
      background: gray level in [0, 1] behind transparent pixels.
      data: bytes of the file, if already read.

    Raises:
      SceneError: as `decode_image`.
    """
    return composite(decode_image(path, data=data), background)


def decode_image(path: pathlib.Path, *, data: np.ndarray | None = None) -> np.ndarray:
    """Decode a photograph as uint8 RGB or RGBA, `[H, W, 3 or 4]`.

    Gray becomes RGB, and 16 bits become 8. The EXIF orientation is ignored, because cameras refer
    to the stored pixels.

    Args:
      path: path of the file.
      data: bytes of the file, if already read.

    Raises:
      SceneError: the file is missing, truncated, damaged, not an image of 8 or 16 bits, of a format
        that is not read, or has more than `MOST_PIXELS`.
    """
    colors, alpha = decode_channels(path, read_file(path) if data is None else data)
    colors = np.repeat(colors, 3, -1) if colors.shape[-1] == 1 else colors
    image = colors if alpha is None else np.concatenate([colors, alpha[..., None]], -1)
    if image.dtype == np.uint16:
        image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    return np.ascontiguousarray(image)


def composite(image: np.ndarray, background: float) -> np.ndarray:
    """Return RGBA `[H, W, 4]` over a gray level in [0, 1]; RGB `[H, W, 3]` stays as it is."""
    if image.shape[-1] == 3:
        return image
    share = image[..., 3:].astype(np.float32) / 255
    rgb = image[..., :3] * share + 255 * background * (1 - share)
    return np.rint(rgb).astype(np.uint8)


def downscale_image(image: np.ndarray, factor: int) -> np.ndarray:
    """Shrink `[H, W, ...]` to `[H // factor, W // factor, ...]` by averaging equal areas."""
    if factor == 1:
        return image
    height, width = (max(1, side // factor) for side in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def size_of_image(path: pathlib.Path) -> tuple[int, int] | None:
    """Return width and height that a file's header says; None where Pillow cannot read it."""
    try:
        return _header_size(path)
    except (OSError, ValueError, PIL.Image.DecompressionBombError):
        return None


def decode_channels(path: pathlib.Path, data: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode an image as it is stored, uint8 or uint16.

    Args:
      path: path of the file, for errors.
      data: `[N]` bytes of the file.

    Returns:
      Gray `[H, W, 1]` or RGB `[H, W, 3]`; and alpha `[H, W]`, None where the file has none.

    Raises:
      SceneError: as `decode_image`.
    """
    if unread := unread_format(data):
        raise SceneError(f"{path} {unread[0]}, which is not read: {unread[1]}.")
    image, large = None, _pixels(data) > MOST_PIXELS
    if not large and data.size and not _is_truncated_jpeg(data.tobytes()):
        try:
            # Ignores the EXIF orientation, keeps alpha and depth.
            image = cv2.imdecode(as_stored(data), cv2.IMREAD_UNCHANGED)
        except cv2.error as error:
            large = "MAX_IMAGE" in str(error) or error.code == cv2.Error.StsNoMem
    if large:
        raise SceneError(
            f"{path} has more than {MOST_PIXELS / 10**6:g} megapixels and is too large to decode, "
            "or its header is damaged: shrink or export it again."
        )
    if image is None:
        raise SceneError(
            f"{path} is not a readable image or is truncated: copy or export it again."
        )
    if image.dtype not in (np.uint8, np.uint16):
        raise SceneError(
            f"{path} holds {image.dtype} values: export it with 8 or 16 bits per channel."
        )
    if image.ndim == 2:
        image = image[..., None]
    alpha = None
    if image.shape[-1] in (2, 4):
        image, alpha = image[..., :-1], image[..., -1]
    return image[..., ::-1], alpha  # OpenCV stores blue first


def _pixels(data: np.ndarray) -> float:
    """Return the pixels that an image's header claims; 0 for formats unknown to Pillow."""
    try:
        return math.prod(_header_size(io.BytesIO(data.data)))
    except PIL.Image.DecompressionBombError:
        return math.inf
    except Exception:  # OpenCV tells what is wrong
        return 0


def _header_size(file: pathlib.Path | io.BytesIO) -> tuple[int, int]:
    """Return width and height that an image's header says; raise what Pillow raises."""
    # Pillow warns of many pixels, which `MOST_PIXELS` limits, and of fields that do not matter.
    with _filters, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with PIL.Image.open(file) as image:
            return image.size


def _is_truncated_jpeg(data: bytes) -> bool:
    """Return True if a JPEG lacks its end marker; some decoders fill the rest with gray.

    The search skips the segments before the scan, since a thumbnail in one of them has its own end
    marker. Inside the scan, ff d9 is always the end marker. Decoders skip bytes between segments,
    and a marker may begin with several ff.
    """
    if not data.startswith(b"\xff\xd8"):
        return False
    position = 2
    while found := _MARKER.search(data, position):
        if found[1] == b"\xda":
            return b"\xff\xd9" not in data[found.end() :]
        length = data[found.end() : found.end() + 2]
        position = found.end() + int.from_bytes(length, "big")
    return True
