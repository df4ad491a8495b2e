"""Photographs from disk: decoding, transparency, downscaling and padding."""

import pathlib
from collections.abc import Sequence

import cv2
import numpy as np

from jaxcloseup.scene import SceneError


def read_file(path: pathlib.Path) -> np.ndarray:
    """The bytes of a picture's file, as uint8 `[N]`.

    Raises:
      SceneError: it is missing or may not be read.
    """
    try:
        # `cv2.imread` fails on non-ASCII paths on some systems; decoding from memory never does.
        return np.fromfile(path, np.uint8)
    except OSError as error:
        raise SceneError(f"{path} cannot be read ({error.strerror}): restore the file.") from error


def read_image(
    path: pathlib.Path,
    *,
    background: float = 1.0,
    keep_alpha: bool = False,
    data: np.ndarray | None = None,
) -> np.ndarray:
    """A photograph as uint8 `[H, W, 3]`, red first.

    Gray becomes RGB, 16 bits become 8, and transparency is composited over the gray level
    `background` in [0, 1]. Pixels stay as they are stored: an EXIF orientation is not applied,
    because cameras are solved for, and transforms refer to, the stored pixels.

    Args:
      path: of the file.
      background: behind transparent pixels.
      keep_alpha: composite over black, and give alpha as a fourth channel if the file has one.
      data: the file's bytes where they have been read already.

    Raises:
      SceneError: the file is missing, truncated, damaged or not a picture of 8 or 16 bits.
    """
    image, alpha = _decode(path, read_file(path) if data is None else data), None
    if image.ndim == 2:
        image = image[..., None]
    if image.shape[-1] in (2, 4):
        image, alpha = image[..., :-1], image[..., -1:]
        share, behind = alpha.astype(np.float32) / 255, 0.0 if keep_alpha else 255 * background
        image = np.rint(image * share + behind * (1 - share)).astype(np.uint8)
    # OpenCV stores blue first.
    image = np.repeat(image, 3, -1) if image.shape[-1] == 1 else image[..., ::-1]
    if keep_alpha and alpha is not None:
        image = np.concatenate([image, alpha], -1)
    return np.ascontiguousarray(image)


def read_mask(path: pathlib.Path, *, data: np.ndarray | None = None) -> np.ndarray:
    """A mask as uint8 `[H, W]`: white counts, black and transparent do not."""
    return read_image(path, background=0.0, data=data)[..., 0]


def downscale_image(image: np.ndarray, factor: int) -> np.ndarray:
    """Average areas of `factor` x `factor` pixels; a remainder is spread over all of them."""
    if factor == 1:
        return image
    height, width = (max(1, side // factor) for side in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def pad_images(images: Sequence[np.ndarray], height: int, width: int) -> np.ndarray:
    """Stack `[h, w, ...]` images of any sizes into the top left of `[V, height, width, ...]`."""
    stack = np.zeros((len(images), height, width, *images[0].shape[2:]), images[0].dtype)
    for target, image in zip(stack, images, strict=True):
        target[: image.shape[0], : image.shape[1]] = image
    return stack


def _decode(path: pathlib.Path, data: np.ndarray) -> np.ndarray:
    image, large = None, False
    if data.size and not _is_truncated_jpeg(data.tobytes()):
        try:
            image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)  # ignores EXIF, keeps alpha and depth
        except cv2.error as error:
            large = "MAX_IMAGE" in str(error) or error.code == cv2.Error.StsNoMem
    if large:
        raise SceneError(f"{path} says that it is too large to decode: shrink or export it again.")
    if image is None:
        raise SceneError(
            f"{path} is not a readable image, or it is truncated: copy or export it again."
        )
    if image.dtype == np.uint16:
        image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if image.dtype != np.uint8:
        raise SceneError(
            f"{path} holds {image.dtype} values: export it with 8 or 16 bits per channel."
        )
    return image


def _is_truncated_jpeg(data: bytes) -> bool:
    """Whether a JPEG ends before its end marker; some decoders then return gray without a word.

    Segments before the scan are skipped by their lengths, since a thumbnail inside one of them has
    an end marker of its own. In the scan itself ff d9 can be nothing else.
    """
    if not data.startswith(b"\xff\xd8"):
        return False
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        if data[position + 1] == 0xDA:
            return b"\xff\xd9" not in data[position:]
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return True
