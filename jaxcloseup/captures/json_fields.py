"""Checks of the values that files give; messages name the file and the field."""

import json
import math
import pathlib
import sys
from typing import Any

import numpy as np

from jaxcloseup.scene import SceneError


_LARGEST = int(sys.float_info.max)  # whole numbers in JSON have no bound


def number(label: str, key: str, value: Any, *, above: float = -math.inf) -> float:
    """`value` as a float, which must be finite and greater than `above`."""
    if isinstance(value, int) and abs(value) > _LARGEST:
        raise SceneError(f"{label}: {key} has {len(str(value))} digits, too many: correct it.")
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SceneError(f"{label}: {key} must be a finite number, got {value!r}: correct it.")
    if value <= above:
        raise SceneError(f"{label}: {key} must be greater than {above:g}, got {value}: correct it.")
    return float(value)


def side(label: str, key: str, value: Any) -> int:
    """`value` as an image's width or height in pixels."""
    pixels = number(label, key, value, above=0)
    if pixels < 1:
        raise SceneError(f"{label}: {key} must be at least 1 pixel, got {value}: correct it.")
    return round(pixels)


def affine_transform(label: str, key: str, value: Any) -> np.ndarray:
    """A `[3, 4]` float64 matrix out of a 3x4 or 4x4 list of lists."""
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(())
    if matrix.shape not in ((3, 4), (4, 4)):
        raise SceneError(f"{label}: {key} must be a 4x4 matrix of numbers: correct it.")
    if not np.isfinite(matrix).all():
        raise SceneError(f"{label}: {key} holds a value that is not finite: drop or correct it.")
    if len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise SceneError(f"{label}: {key} must end in the row 0, 0, 0, 1: it may be transposed.")
    return matrix[:3]


def rigid_transform(label: str, key: str, value: Any) -> np.ndarray:
    """As `affine_transform`, and made of a rotation and a position."""
    matrix = affine_transform(label, key, value)
    rotation = matrix[:, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > 1e-3:
        raise SceneError(
            f"{label}: {key} is not rigid, its rotation is off by {error:.2g}: scale positions "
            "only, and leave the rotation's columns orthogonal and of unit length."
        )
    if np.linalg.det(rotation) < 0:
        raise SceneError(f"{label}: {key} mirrors space: flip one axis of its rotation.")
    return matrix


def read_object(path: pathlib.Path, holds: str) -> dict[str, Any]:
    """The object of a JSON file, which `holds` what a sentence on another file would miss."""
    try:
        fields = json.loads(path.read_text(encoding="utf-8-sig"))
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
            f"{path}: nested too deep, or a number of thousands of digits: is it the right file?"
        ) from error
    if not isinstance(fields, dict):
        raise SceneError(f"{path}: not an object with {holds}: is it the right file?")
    return fields
