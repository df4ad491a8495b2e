"""Fields and optimizers of volumetric methods, in coordinates where a scene has about unit size."""

from collections.abc import Callable
from typing import Any

import numpy as np
import optax

from jaxcloseup.app.methods.shared.sightings import find_sightings
from jaxcloseup.app.methods.volumes import AdamConfig, DepthConfig
from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.volume.depth_supervision import (
    DepthSupervision,
    PixelSupervision,
    PointSupervision,
)
from jaxcloseup.fields.volume.rays import Extent
from jaxcloseup.photos.scene import Scene


def build_field(
    field: Callable[..., RadianceField], config: Any, scene: Scene, *, normalize: bool = True
) -> RadianceField:
    """Return a field of the library between a scene's near and far.

    Args:
      field: `(config, extent, supervision=) -> RadianceField`.
      config: its configuration, which is also a `DepthConfig`.
      scene: what was photographed.
      normalize: scale the scene to the unit cube.

    Raises:
      SceneError: depth is supervised by points, but the scene has none for it.
    """
    center, scale = unit_cube(scene) if normalize else ((0.0, 0.0, 0.0), 1.0)
    extent = Extent(scene.near, scene.far, center, scale)
    return field(config, extent, supervision=_depth_supervision(config, scene))


def _depth_supervision(config: DepthConfig, scene: Scene) -> DepthSupervision | None:
    if not config.depth_weight:
        return None
    if config.depth_from == "stereo":
        return PixelSupervision(config.depth_weight)
    return PointSupervision(find_sightings(scene), config.depth_weight, config.depth_share)


def grid_adam(config: AdamConfig, scene: Scene) -> optax.GradientTransformation:
    """Return Adam as for hash grids (Instant-NGP, section 4): tiny gradients move entries too."""
    del scene
    rate = optax.exponential_decay(config.initial_lr, config.lr_decay_steps, config.lr_decay)
    return optax.adam(rate, b1=0.9, b2=0.99, eps=1e-15)


def network_adam(config: AdamConfig, scene: Scene) -> optax.GradientTransformation:
    """Return Adam with its usual constants and an exponentially decaying learning rate."""
    del scene
    return optax.adam(
        optax.exponential_decay(config.initial_lr, config.lr_decay_steps, config.lr_decay)
    )


def unit_cube(scene: Scene) -> tuple[tuple[float, float, float], float]:
    """Return center and scale that bring cameras and most of their view into [-1, 1]."""
    positions = np.asarray(scene.train.cameras.position)
    forward = np.asarray(scene.train.cameras.rotation)[..., 2]
    middle = positions + 0.5 * (scene.near + scene.far) * forward
    seen = scene.points if len(scene.points) else middle
    both = np.concatenate([positions, np.percentile(seen, [5, 95], axis=0)])
    low, high = both.min(axis=0), both.max(axis=0)
    x, y, z = ((low + high) / 2).tolist()
    return (x, y, z), float(2 / (high - low).max())
