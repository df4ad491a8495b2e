"""What the volumetric methods share: Adam, and coordinates in which a scene has about unit size."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import optax

from jaxcloseup.app.methods.method import LabelConfig, Method, Preset, TargetConfig
from jaxcloseup.app.methods.sightings import find_sightings
from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.volume.depth_supervision import DepthSupervision
from jaxcloseup.photos.scene import Scene
from jaxcloseup.setting import setting


@dataclasses.dataclass(frozen=True)
class AdamConfig:
    """A training by Adam whose learning rate decays."""

    initial_lr: float = setting(1e-2, "learning rate at the first step")
    lr_decay: float = setting(
        0.1,
        "factor of the learning rate's exponential decay over `lr_decay_steps`, through all stages",
    )
    lr_decay_steps: int = setting(
        20_000,
        "steps over which the learning rate decays by `lr_decay`",
        low=1,
    )
    target_steps: int = setting(200, "steps on all target views together", low=1)


@dataclasses.dataclass(frozen=True)
class DepthConfig:
    """Supervision of depth by the capture's points, for any volumetric field."""

    depth_weight: float = setting(0.0, "weight of the depth loss; 0 turns it off")
    depth_share: float = setting(
        0.25,
        "rays through points in a step, as a share of its pixels",
        high=1,
    )


def depth_supervision(config: DepthConfig, scene: Scene) -> DepthSupervision | None:
    """What `config` says, on a scene.

    Raises:
      SceneError: the scene has no points for it.
    """
    if not config.depth_weight:
        return None
    return DepthSupervision(find_sightings(scene), config.depth_weight, config.depth_share)


def maker(field: Callable[..., RadianceField]) -> Callable[[Any, Scene, int], RadianceField]:
    """`Method.make_field` of a field of the library, between a scene's near and far.

    Args:
      field: `(config, near=, far=, center=, scale=, supervision=) -> RadianceField`.
    """

    def make_field(config: Any, scene: Scene, growth: int) -> RadianceField:
        del growth  # nothing overflows
        center, scale = unit_cube(scene)
        return field(
            config,
            near=scene.near,
            far=scene.far,
            center=center,
            scale=scale,
            supervision=depth_supervision(config, scene),
        )

    return make_field


def adam(config: AdamConfig, scene: Scene) -> optax.GradientTransformation:
    """Adam as for hash grids (Instant-NGP, section 4): entries with tiny gradients move too."""
    del scene
    rate = optax.exponential_decay(config.initial_lr, config.lr_decay_steps, config.lr_decay)
    return optax.adam(rate, b1=0.9, b2=0.99, eps=1e-15)


def volumetric(field: Callable[..., RadianceField], **presets: Preset) -> Method:
    """The method of a volumetric field in unit coordinates, trained by `adam`.

    Args:
      field: as in `maker`.
      **presets: by name; the first one is the default.
    """
    return Method(
        presets=presets,
        make_field=maker(field),
        make_optimizer=adam,
        renders_pixels=True,
        target_steps=lambda config, count: config.target_steps,
    )


# A short training leaves depth errors of several per cent, under which the paper's labels are worse
# than the model: only labels that the other views confirm closely are kept, at a pixel's weight.
QUICK_LABELS = LabelConfig(
    rgb_tolerance=0.04, depth_tolerance=0.02, leave_out_source=True, source_tolerance=0.05
)
# Wanted views learn from renders with detail instead, which know how far to trust themselves.
QUICK_TARGETS = TargetConfig("residual", lr_scale=3.0)


def unit_cube(scene: Scene) -> tuple[tuple[float, float, float], float]:
    """Center and scale that bring the cameras and most of what they see into [-1, 1]."""
    positions = np.asarray(scene.train.cameras.position)
    forward = np.asarray(scene.train.cameras.rotation)[..., 2]
    middle = positions + 0.5 * (scene.near + scene.far) * forward
    seen = scene.points if len(scene.points) else middle
    both = np.concatenate([positions, np.percentile(seen, [5, 95], axis=0)])
    low, high = both.min(axis=0), both.max(axis=0)
    return tuple(((low + high) / 2).tolist()), float(2 / (high - low).max())
