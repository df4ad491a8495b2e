"""Held-out views with all that scoring needs: photographs, weights, and how often each is seen."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxcloseup.app import progress
from jaxcloseup.app.score.metrics_text import FINER
from jaxcloseup.app.score.surface_error import Landmarks, find_landmarks
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.photos.scene import Scene, SceneError, Surface
from jaxcloseup.photos.support import count_seen
from jaxcloseup.photos.views import Views, camera_at, to_float
from jaxcloseup.photos.windows import in_quarters


class Target(NamedTuple):
    """A held-out view of `[H, W]` pixels, the size of its photograph."""

    name: str  # name of its photograph
    # its camera, padded at the right and the bottom to the size of its split, so that all views of
    # a split share compiled programs
    camera: Camera
    rgb: jax.Array  # `[H, W, 3]` the photograph, float in [0, 1]
    weight: jax.Array  # `[H, W]` weights
    seen: jax.Array  # `[H, W]` number of training photographs that saw the surface at each pixel
    surface: Surface | None = None  # the exact surface, or None where it is unknown
    # visible points of the capture, or None where the exact surface is known
    landmarks: Landmarks | None = None


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
    finer: tuple[Views, Sequence[tuple[int, int]]] | None = None,
) -> list[Target]:
    """Return the held-out views of a split, with the number of photographs that saw each pixel.

    That number needs a depth: the exact one on built-in scenes, the baseline's on captures. So all
    stages are scored on the same pixels.

    Args:
      scene: the scene.
      split: name of the split.
      train_depths: `[V, H, W]` depths of the training views.
      render: `camera -> Rendering` of the baseline.
      finer: the split's photographs at another size, as `Scene.photographs_at` returns them;
        default: the scene's.
    """
    views, sizes = finer or (getattr(scene, split), scene.sizes(split))
    surface = _geometry(scene.surface) if scene.surface else None
    if surface and finer:
        # Quarters of finer views are mostly as large as the others: one program serves both.
        surface = functools.partial(in_quarters, surface)
    count = jax.jit(count_seen)
    rgb_of, weight_of = jax.device_get((views.rgb, views.weight))

    def make(i: int) -> Target:
        camera, (width, height) = camera_at(views.cameras, i), sizes[i]
        whole = camera.replace(width=width, height=height)  # without padding
        exact = surface(camera) if surface else None
        landmarks = None if exact else find_landmarks(whole, scene.points)
        depth = exact.depth if exact else render(camera).depth
        pixels = pixel_grid(camera.height, camera.width)
        seen = count(camera, pixels, depth, scene.train, train_depths)[:height, :width]
        rgb = jnp.asarray(to_float(rgb_of[i, :height, :width]))
        weight = jnp.asarray(weight_of[i, :height, :width])
        return Target(scene.names[split][i], camera, rgb, weight, seen, exact, landmarks)

    return list(progress.each(make, range(len(sizes)), f"truth of {split}"))


def targets_by_split(
    scene: Scene,
    train_depths: jax.Array,
    exact: jax.Array | None,
    render: Callable[[Camera], Rendering],
    *,
    finer: int | None = None,
) -> dict[str, list[Target]]:
    """Return `make_targets` for every split except the training views.

    Args:
      scene: the scene.
      train_depths: `[V, H, W]` rendered depths of the training views.
      exact: `[V, H, W]` exact depths, which are used instead; None on captures.
      render: `camera -> Rendering` of the baseline.
      finer: divisor of the photographs' size at which the views are scored too, in further
        splits, named with `FINER`; None without these.
    """
    seen_from = train_depths if exact is None else exact
    splits = [split for split in scene.names if split != "train"]
    targets = {split: make_targets(scene, split, seen_from, render) for split in splits}
    if finer is None or scene.photographs_at is None:
        return targets
    for split in splits:
        try:
            photographs = scene.photographs_at(finer, split)
        except SceneError as error:  # such as full-size photographs that were not kept
            print(f"views are scored at the size of training alone: {error}")
            break
        targets[split + FINER] = make_targets(scene, split, seen_from, render, photographs)
    return targets
