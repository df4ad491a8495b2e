"""The record that every loader returns."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxcloseup.batch import Views
from jaxcloseup.geometry.cameras import Camera


class Surface(NamedTuple):
    """What a camera truly sees, per pixel `[H, W]`.

    Attributes:
      rgb: `[H, W, 3]` anti-aliased colour in [0, 1].
      depth: `[H, W]` exact z-depth at the pixel centre, world units; 0 where nothing is hit.
      normal: `[H, W, 3]` unit world normal at the pixel centre, towards the camera; 0 where empty.
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
      rgb: `[P, 3]` their float colours in [0, 1].
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
