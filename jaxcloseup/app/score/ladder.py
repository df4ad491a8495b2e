"""The zoom ladder: the same points seen from nearer and nearer, on built-in scenes.

Each held-out ordinary view has a camera for each rung. The camera moves 1, 2, 4, 8 and 16 times
nearer to one point of the view without turning, so only the magnification changes along the ladder.
The rung below 1 has half the view's focal length: moving back might lead out of the scene.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.app import progress
from jaxcloseup.app.score.targets import Target
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points
from jaxcloseup.geometry.poses import closeup_position, sample_anchor
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.support import count_seen
from jaxcloseup.photos.views import camera_at


MAGNIFICATIONS = (0.5, 1, 2, 4, 8, 16)
PREFIX = "zoom_"
MIN_PHOTOGRAPHS = 3  # photographs that must see the point of a ladder, if any point has so many


def ladder_targets(scene: Scene, exact_depths: jax.Array) -> dict[str, list[Target]]:
    """Return the held-out views of the ladder, by `zoom_<magnification>`.

    Args:
      scene: the scene.
      exact_depths: `[V, H, W]` exact depths of the training views.

    Returns:
      For each magnification, one target for each ordinary view. Empty for scenes without `surface`
      or without ordinary held-out views.
    """
    if scene.surface is None or scene.test_far is None:
        return {}
    surface, count, cameras = scene.surface, jax.jit(count_seen), scene.test_far.cameras

    def rungs(i: int) -> list[Target]:
        name, far = scene.names["test_far"][i], camera_at(cameras, i)
        pixels = pixel_grid(far.height, far.width)
        far_surface = surface(far)
        seen = count(far, pixels, far_surface.depth, scene.train, exact_depths)
        anchor = _anchor(jax.random.key(i), far, far_surface.depth, seen)
        targets = []
        for m in MAGNIFICATIONS:
            camera = _nearer(far, anchor, m) if m > 1 else _wider(far, m)
            seen_surface = far_surface if m == 1 else surface(camera)
            seen = count(camera, pixels, seen_surface.depth, scene.train, exact_depths)
            weight = jnp.ones(seen.shape, jnp.float32)
            rgb = seen_surface.rgb.astype(jnp.float32)
            targets.append(Target(name, camera, rgb, weight, seen, seen_surface))
        return targets

    views = progress.each(rungs, range(len(scene.names["test_far"])), "truth of the zoom ladder")
    rows = zip(MAGNIFICATIONS, zip(*views, strict=True), strict=True)
    return {f"{PREFIX}{m:g}": list(targets) for m, targets in rows}


@jax.jit
def _anchor(key: jax.Array, camera: Camera, depth: jax.Array, seen: jax.Array) -> jax.Array:
    """Draw a point in the middle half of the view that several photographs see."""
    height, width = depth.shape
    middle = jnp.zeros((height, width), jnp.float32)
    middle = middle.at[height // 4 : -(height // 4), width // 4 : -(width // 4)].set(1)
    weight = jnp.where(seen >= MIN_PHOTOGRAPHS, middle, 0)
    weight = jnp.where(jnp.any(weight > 0), weight, middle)
    pixel = sample_anchor(key, depth, weight)
    column, row = jnp.floor(pixel).astype(jnp.int32)
    return pixels_to_points(camera, pixel, depth[row, column])


@jax.jit
def _nearer(camera: Camera, anchor: jax.Array, magnification: float) -> Camera:
    position = closeup_position(anchor, camera.position, magnification)
    return camera.replace(camtoworld=camera.camtoworld.at[:, 3].set(position))


@jax.jit
def _wider(camera: Camera, magnification: float) -> Camera:
    focal = camera.intrinsics[:2] * magnification
    return camera.replace(intrinsics=camera.intrinsics.at[:2].set(focal))


def describe_ladder(splits: Mapping[str, Any]) -> str:
    """Return the PSNR at each magnification as one line."""
    rungs = ((m, splits[f"{PREFIX}{m:g}"]["psnr"]) for m in rungs_of(splits))
    return "PSNR (dB) by magnification: " + ", ".join(
        f"{m:g}x {'-' if value is None else f'{value:.2f}'}" for m, value in rungs
    )


def rungs_of(splits: Iterable[str]) -> list[float]:
    """Return the magnifications of the ladder's splits, in ascending order."""
    return sorted(float(name.removeprefix(PREFIX)) for name in splits if name.startswith(PREFIX))
