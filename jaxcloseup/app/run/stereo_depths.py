"""Depth of a run's photographs by stereo: what training begins with, and keeps to."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.methods.method import StereoTraining
from jaxcloseup.geometry.cameras import pixel_grid, pixels_to_points
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.native import library
from jaxcloseup.photos.depth_maps import GatherSources, join_maps
from jaxcloseup.photos.pyramids import Pyramid, divisor_near
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views, camera_at, pad_images, to_float
from jaxcloseup.stereo import StereoConfig, StereoMaps, choose_neighbors, estimate_depths


_MATCHING = StereoConfig()
_estimate = functools.partial(jax.jit, static_argnames="config")(estimate_depths)


class StereoDepths(NamedTuple):
    """Depth and normals of V photographs by stereo.

    Attributes:
      views: the photographs as stereo read them.
      maps: what it found.
    """

    views: Views
    maps: StereoMaps

    @property
    def sources(self) -> GatherSources:
        """Return the depth maps, trusted as they are confident."""
        depth, confidence = self.maps.depth, self.maps.confidence
        inverse = safe_divide(jnp.ones_like(depth), jnp.where(confidence > 0, depth, 0))
        return join_maps(self.views.cameras, inverse, confidence)


def can_match(scene: Scene) -> bool:
    """Return whether depth can be confirmed, in minutes; where a library is missing, say so."""
    if len(scene.train) <= _MATCHING.confirmations:
        return False
    if jax.default_backend() == "cpu" and not library.available():
        print(f"{library.missing()}, so photographs are not matched for depth")
        return False
    return True


def matched_divisor(scene: Scene, config: StereoTraining, finest: int) -> int:
    """Return the divisor of the photographs' own size at which they are matched.

    Args:
      scene: a scene whose photographs were divided for training.
      config: how many pixels are matched.
      finest: divisor of the finest photographs that may be read.
    """
    cameras = scene.train.cameras
    affords = config.pixels / (len(scene.train) * cameras.height * cameras.width)
    return divisor_near(finest, scene.metadata.get("downscale", 1), max(1.0, affords**0.5))


def match_photographs(
    scene: Scene, pyramid: Pyramid, config: StereoTraining, matching: StereoConfig = _MATCHING
) -> StereoDepths:
    """Estimate depth of all training photographs, at the size that `config` affords."""
    views = _reduced(scene, pyramid, config.pixels)
    size = views.cameras
    chosen = choose_neighbors(size, scene.near, scene.far, matching, scene.points)
    with progress.saying(f"matching photographs of {size.width} x {size.height}"):
        maps = _estimate(
            jax.random.key(0), views, jnp.asarray(chosen), scene.near, scene.far, config=matching
        )
        return StereoDepths(views, jax.block_until_ready(maps))


def _reduced(scene: Scene, pyramid: Pyramid, pixels: int) -> Views:
    """Return the training photographs at the level that has about so many pixels in all."""
    cameras = scene.train.cameras
    each = max(cameras.height * cameras.width, pixels / len(pyramid))
    level = pyramid.level_near((each * cameras.width / cameras.height) ** 0.5)
    height, width = pyramid.sizes[level]
    images = [np.asarray(pyramid.image(view, level)) for view in range(len(pyramid))]
    values = pad_images(images, height, width)
    weight = to_float(jnp.asarray(values[..., 3]))
    return Views(pyramid.cameras(cameras, level), jnp.asarray(values[..., :3]), weight)


def draw_points(stereo: StereoDepths, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most `count` world points `[P, 3]` of confident pixels, and their colors."""
    confidence = np.asarray(stereo.maps.confidence)
    rows = np.flatnonzero(confidence)
    if len(rows) > count:
        rows = np.sort(np.random.default_rng(0).choice(rows, count, replace=False))
    _, height, width = confidence.shape
    view, pixel = np.divmod(rows, height * width)
    pixels = np.asarray(pixel_grid(height, width)).reshape(-1, 2)[pixel]
    depth = np.asarray(stereo.maps.depth).reshape(-1)[rows]
    cameras = camera_at(stereo.views.cameras, jnp.asarray(view))
    points = jax.vmap(pixels_to_points)(cameras, jnp.asarray(pixels), jnp.asarray(depth))
    return np.asarray(points), to_float(np.asarray(stereo.views.rgb).reshape(-1, 3)[rows])
