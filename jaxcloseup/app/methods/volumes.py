"""What presets of volumetric methods share; no JAX is imported."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from jaxcloseup.app.methods.method import Method, Preset, StereoTraining, TargetConfig, WindowConfig
from jaxcloseup.labels.config import LabelConfig
from jaxcloseup.lazy import lazy_function
from jaxcloseup.setting import setting
from jaxcloseup.training.config import TrainConfig


TRAINING = "jaxcloseup.app.methods.shared.volume_training"
GRID_ADAM = lazy_function(TRAINING, "grid_adam")
NETWORK_ADAM = lazy_function(TRAINING, "network_adam")


@dataclasses.dataclass(frozen=True)
class AdamConfig:
    """A training by Adam whose learning rate decays."""

    initial_lr: float = setting(1e-2, "learning rate at the first step")
    lr_decay: float = setting(
        0.1,
        "factor of the learning rate's exponential decay over `lr_decay_steps`, through all stages",
    )
    lr_decay_steps: int = setting(
        20_000, "steps over which the learning rate decays by `lr_decay`", low=1
    )
    target_steps: int = setting(200, "steps on all target views together", low=1)


@dataclasses.dataclass(frozen=True)
class DepthConfig:
    """Supervision of depth, for any volumetric field."""

    depth_weight: float = setting(0.0, "weight of the depth loss; 0 turns it off")
    depth_from: str = setting(
        "points",
        "what knows depth: the capture's points, or stereo, which matches photographs",
        choices=("points", "stereo"),
    )
    depth_share: float = setting(
        0.25, "rays through the capture's points in a step, as a share of its pixels", high=1
    )


def volumetric(
    field: Callable[..., Any],
    *,
    help: str,
    presets: Mapping[str, Preset],
    make_optimizer: Callable[..., Any] = GRID_ADAM,
    normalize: Callable[[Any], bool] = lambda config: True,
) -> Method:
    """Return the method of a volumetric field, as `build_field` takes it.

    `normalize(config)` says whether to scale the scene to the unit cube.
    """
    build_field = lazy_function(TRAINING, "build_field")

    def make_field(config: Any, scene: Any, growth: int) -> Any:
        del growth  # nothing overflows
        return build_field(field, config, scene, normalize=normalize(config))

    return Method(
        help=help,
        presets=presets,
        make_field=make_field,
        make_optimizer=make_optimizer,
        renders_pixels=True,
        target_steps=lambda config, count: config.target_steps,
    )


# A short training leaves depth errors of several per cent, under which the paper's labels are worse
# than the model: only labels that the other views confirm closely are kept, at a pixel's weight.
QUICK_LABELS = LabelConfig(
    rgb_tolerance=0.04, depth_tolerance=0.02, leave_out_source=True, source_tolerance=0.05
)
# Matches nothing; `--set stereo.pixels=N` does.
_NO_STEREO = StereoTraining(pixels=0, points=0, exposures=False)
# Target views learn from renders with detail instead, whose weights say how far to trust them.
QUICK_TARGETS = TargetConfig("residual", lr_scale=3.0)


def paper_preset(method: str, field: Any, *, rays: int, steps: int, closeup_steps: int) -> Preset:
    """Return a preset with a paper's field and length, and as many rays with labels as without."""
    return Preset(
        method=method,
        field=field,
        train=TrainConfig(num_rays=rays, num_label_rays=rays),
        labels=LabelConfig(),
        baseline_steps=steps,
        closeup_steps=closeup_steps,
    )


def quick_preset(
    method: str,
    field: Any,
    *,
    rays: int,
    steps: int,
    finest: int = 1,
    stereo: StereoTraining = _NO_STEREO,
) -> Preset:
    """Return a short training on reduced photographs, with windows up to `finest`."""
    return Preset(
        method=method,
        field=field,
        train=TrainConfig(num_rays=rays, num_label_rays=rays, label_rule="pooled"),
        labels=QUICK_LABELS,
        targets=QUICK_TARGETS,
        baseline_steps=steps,
        closeup_steps=200,
        downscale=None,
        score_width=120,  # single rays take a minute for an image of 960 x 540
        windows=WindowConfig(finest=finest),
        stereo=stereo,
    )
