"""Read JSON files and check values from capture files; errors name the file and the field."""

import json
import math
import pathlib
import sys
from typing import Any

import numpy as np

from jaxcloseup.io.files import read_bytes
from jaxcloseup.photos.scene import SceneError


LARGEST_JSON = 2**26  # bytes; ten thousand frames take about 10 MiB
_LARGEST = int(sys.float_info.max)  # JSON integers can exceed any float


def number(label: str, key: str, value: Any, *, above: float = -math.inf) -> float:
    """Return `value` as a float.

    Raises:
      SceneError: as float32, which stores it, the number is not finite or does not exceed `above`.
    """
    if isinstance(value, int) and abs(value) > _LARGEST:
        raise SceneError(
            f"{label}: {key} has {len(str(value))} digits, too many for a number: correct it."
        )
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SceneError(f"{label}: {key} must be a finite number, got {value!r}: correct it.")
    stored = _as_float32(float(value))
    if not np.isfinite(stored):
        raise SceneError(f"{label}: {key} is too large for 32 bits, {value:.3g}: correct it.")
    if stored <= above:
        raise SceneError(f"{label}: {key} must be greater than {above:g}, got {value}: correct it.")
    return float(value)


def _as_float32(value: float | np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", under="ignore"):
        return np.asarray(value).astype(np.float32)


def image_side(label: str, key: str, value: Any) -> int:
    """Return `value` as an image's width or height in pixels; raise `SceneError` below 1."""
    pixels = number(label, key, value, above=0)
    if pixels < 1:
        raise SceneError(f"{label}: {key} must be at least 1 pixel, got {value}: correct it.")
    return round(pixels)


def affine_transform(label: str, key: str, value: Any) -> np.ndarray:
    """Return a 3x4 or 4x4 list of lists as a `[3, 4]` float64 matrix, or raise `SceneError`."""
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(())
    if matrix.shape not in ((3, 4), (4, 4)):
        raise SceneError(f"{label}: {key} must be a 4x4 matrix of numbers: correct it.")
    if not np.isfinite(_as_float32(matrix)).all():
        raise SceneError(
            f"{label}: {key} holds a value that is not finite in 32 bits: remove or correct it."
        )
    if len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise SceneError(
            f"{label}: {key} must end in the row 0, 0, 0, 1: correct it; it may be transposed."
        )
    return matrix[:3]


def rigid_transform(label: str, key: str, value: Any) -> np.ndarray:
    """Read an `affine_transform` that must consist of a rotation and a position."""
    matrix = affine_transform(label, key, value)
    rotation = matrix[:, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > 1e-3:
        raise SceneError(
            f"{label}: {key} is not rigid, its rotation is off by {error:.2g}: make the rotation's "
            "columns orthogonal and of unit length, and scale only the position."
        )
    if np.linalg.det(rotation) < 0:
        raise SceneError(f"{label}: {key} mirrors space: flip one axis of its rotation.")
    return matrix


def read_json(path: pathlib.Path) -> Any:
    """Read a JSON file of at most `LARGEST_JSON` bytes; raises as `open` and `json.loads` do."""
    return json.loads(read_bytes(path, most=LARGEST_JSON).decode("utf-8-sig"))


def read_object(path: pathlib.Path, holds: str) -> dict[str, Any]:
    """Read the object in a JSON file.

    Args:
      path: path of the file.
      holds: what the object should hold, for error messages.

    Raises:
      SceneError: the file cannot be read, or it does not hold a JSON object.
    """
    try:
        fields = read_json(path)
    except OSError as error:
        raise SceneError(f"{path} cannot be read ({error.strerror}): restore the file.") from error
    except json.JSONDecodeError as error:
        raise SceneError(
            f"{path}: not JSON at line {error.lineno} ({error.msg}): correct it."
        ) from error
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: not UTF-8 text: save it again as UTF-8.") from error
    except (ValueError, RecursionError) as error:
        raise SceneError(
            f"{path}: nested too deep, or a number has thousands of digits: is it the right file?"
        ) from error
    if not isinstance(fields, dict):
        raise SceneError(f"{path}: not an object with {holds}: is it the right file?")
    return fields
