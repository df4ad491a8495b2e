"""Held-out views with all that scoring needs: photographs, weights, and how often each is seen."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.score.metrics_text import REDUCED
from jaxcloseup.app.score.surface_error import Landmarks, find_landmarks
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.photos.exposures import Taken
from jaxcloseup.photos.proximity import Proximity, measure_proximity
from jaxcloseup.photos.scene import Scene, SceneError, Surface
from jaxcloseup.photos.support import find_support
from jaxcloseup.photos.views import Photograph, camera_at, unpadded


_SCREEN = 1920  # longest side in pixels of views that are scored at the photographs' own size
_COMMON_WIDTH = 960  # of larger ones; the paper's
_ENOUGH_SEEN = 0.25  # share of a view that a photograph must have seen to count as near to it


class Target(NamedTuple):
    """A held-out view of `[H, W]` pixels, the size of its photograph."""

    name: str  # name of its photograph
    camera: Camera  # its camera
    rgb: Any  # `[H, W, 3]` the photograph, uint8 or float in [0, 1]
    weight: Any  # `[H, W]` weights, uint8 (255 means 1) or float in [0, 1]
    seen: jax.Array  # `[H, W]` number of training photographs that saw the surface at each pixel
    surface: Surface | None = None  # the exact surface, or None where it is unknown
    # visible points of the capture, or None where the exact surface is known
    landmarks: Landmarks | None = None
    # finest period in pixels that photographs of their own size hold of most of the view; None
    # where none sees it
    could_resolve: float | None = None
    # how near photographs come, see `describe_proximity`; None where that was not asked
    proximity: Mapping[str, float] | None = None
    taken: Taken | None = None  # how it was taken, or None where all have one exposure


def exact_depths(scene: Scene, cameras: Camera) -> jax.Array:
    """Return the exact z-depths `[V, H, W]` of stacked cameras on a built-in scene."""
    assert scene.surface is not None
    geometry, count = _geometry(scene.surface), cameras.intrinsics.shape[0]

    def depth(index: int) -> jax.Array:
        return geometry(camera_at(cameras, index)).depth

    return jnp.stack(list(progress.each(depth, range(count), "exact depths")))


@functools.lru_cache(maxsize=4)
def _geometry(surface: Callable[[Camera], Surface]) -> Callable[[Camera], Surface]:
    """Return the surface without colors."""
    # Colors take longest to compile, and nobody asks for them here.
    return jax.jit(lambda camera: surface(camera)._replace(rgb=None))  # type: ignore[arg-type]


def make_targets(
    scene: Scene,
    split: str,
    train_depths: jax.Array,
    render: Callable[[Camera], Rendering],
    photographs: Sequence[Photograph] | None = None,
) -> list[Target]:
    """Return the held-out views of a split, with the number of photographs that saw each pixel.

    That number needs a depth: the exact one on built-in scenes, the baseline's on captures. So all
    stages are scored on the same pixels.

    Args:
      scene: the scene.
      split: name of the split.
      train_depths: `[V, H, W]` depths of the training views.
      render: `camera -> Rendering` of the baseline.
      photographs: the split's photographs at another size, as `Scene.photographs_at` returns
        them; default: the scene's.
    """
    photographs = photographs or unpadded(getattr(scene, split), scene.sizes(split))
    surface = _geometry(scene.surface) if scene.surface else None
    find, measure = jax.jit(find_support), jax.jit(measure_proximity)
    # With --split=zoom, the photographs' own pixels are held out.
    own = scene.metadata.get("downscale", 1) if scene.photographs_at else 1

    def make(i: int) -> Target:
        camera, rgb, weight = photographs[i]
        exact = surface(camera) if surface else None
        landmarks = None if exact else find_landmarks(camera, scene.points)
        depth = exact.depth if exact else render(camera).depth
        pixels = pixel_grid(camera.height, camera.width)
        support = find(camera, pixels, depth, scene.train, train_depths)
        seen, footprint = map(np.asarray, support)
        # A period takes two pixels, of the photograph or of the view.
        held = max(2.0, 2 * float(np.median(footprint[seen > 0])) / own) if seen.any() else None
        name, counts = scene.names[split][i], jnp.asarray(seen)
        near = describe_proximity(measure(camera, depth, scene.train, train_depths))
        return Target(name, camera, rgb, weight, counts, exact, landmarks, held, near)

    pixels = max(photograph.weight.size for photograph in photographs)
    return list(progress.each(make, range(len(photographs)), f"truth of {split}", pixels=pixels))


def describe_proximity(proximity: Proximity) -> dict[str, float]:
    """Return how near photographs come to a view, as numbers for `results.json`.

    `overlap` is the largest with any photograph. `depth_ratio` and `ray_angle`, in degrees, are the
    smallest of photographs that saw a quarter of the view, where there are any.
    """
    seen, overlap, ratio, angle = map(np.asarray, proximity)
    found, enough = {"overlap": float(overlap.max())}, seen >= _ENOUGH_SEEN
    if enough.any():
        degrees = np.rad2deg(angle[enough].min())
        found |= {"depth_ratio": float(ratio[enough].min()), "ray_angle": float(degrees)}
    return found


def targets_by_split(
    scene: Scene,
    train_depths: jax.Array,
    exact: jax.Array | None,
    render: Callable[[Camera], Rendering],
    *,
    divisor: int | None = None,
) -> dict[str, list[Target]]:
    """Return `make_targets` for every split except the training views.

    Args:
      scene: the scene.
      train_depths: `[V, H, W]` rendered depths of the training views.
      exact: `[V, H, W]` exact depths, which are used instead; None on captures.
      render: `camera -> Rendering` of the baseline.
      divisor: of the photographs' own size, at which the splits' views are scored; those at the
        size of training get further splits, named with `REDUCED`. None: the size of training.
    """
    seen_from = train_depths if exact is None else exact
    splits = [split for split in scene.names if split != "train"]
    reduced = {split: make_targets(scene, split, seen_from, render) for split in splits}
    if divisor is None or scene.photographs_at is None:
        return reduced
    targets = {}
    for split in splits:
        try:
            photographs = scene.photographs_at(divisor, split)
        except SceneError as error:  # such as full-size photographs that were not kept
            print(f"views are scored at the size of training alone: {error}")
            return reduced
        targets[split] = make_targets(scene, split, seen_from, render, photographs)
    return targets | {split + REDUCED: views for split, views in reduced.items()}


def score_divisor(scene: Scene, width: int | None) -> int | None:
    """Return the divisor of the photographs' own size at which views are scored.

    Args:
      scene: the scene.
      width: about how many pixels the longer side of views has; None: as many as the photographs
        if these are no larger than a screen, else `_COMMON_WIDTH`.

    Returns:
      None where photographs are trained on at this size, or have no finer one.
    """
    reduced = scene.metadata.get("downscale", 1)
    side = reduced * max(scene.train.cameras.width, scene.train.cameras.height)
    if width is None:
        width = side if side <= _SCREEN else _COMMON_WIDTH
    divisor = max(1, round(side / width))
    return divisor if divisor < reduced and scene.photographs_at else None
