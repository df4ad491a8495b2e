"""The record that every loader returns."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photographs import Views


class SceneError(ValueError):
    """A scene that cannot be loaded."""


class SceneWarning(UserWarning):
    """A scene that was loaded, though something about it may not be what its owner meant."""


class UnknownKeyWarning(SceneWarning):
    """A file holds fields that nothing here reads."""


class ImageSizeWarning(SceneWarning):
    """Photographs are not of the size their file gives."""


class NearFarWarning(SceneWarning):
    """The depth range was estimated."""


class DuplicateFileWarning(SceneWarning):
    """One photograph is listed more than once."""


class PointsWarning(SceneWarning):
    """Some of the initial points were dropped."""


class Surface(NamedTuple):
    """What a camera truly sees, per pixel `[H, W]`.

    Attributes:
      rgb: `[H, W, 3]` anti-aliased color in [0, 1].
      depth: `[H, W]` exact z-depth at the pixel center, world units; 0 where nothing is hit.
      normal: `[H, W, 3]` unit world normal at the pixel center, towards the camera; 0 where empty.
    """

    rgb: jax.Array
    depth: jax.Array
    normal: jax.Array


@dataclasses.dataclass(frozen=True)
class Scene:
    """A capture in memory.

    Attributes:
      name: what it is called.
      train: the far photographs.
      test: held-out close-ups, or None.
      test_far: held-out ordinary views, or None.
      points: `[P, 3]` world points on the surface, possibly none.
      rgb: `[P, 3]` their float colors in [0, 1].
      near: z-depth before which nothing is.
      far: z-depth behind which nothing is.
      names: for each split present, the names of its photographs in order.
      metadata: anything a format adds: source paths, downscale, capture-to-world transform.
      surface: `camera -> Surface`, the exact scene at any pose; None for photographs.
    """

    name: str
    train: Views
    test: Views | None
    test_far: Views | None
    points: np.ndarray
    rgb: np.ndarray
    near: float
    far: float
    names: dict[str, list[str]]
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)
    surface: Callable[[Camera], Surface] | None = None
