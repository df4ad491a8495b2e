"""What a method is, and what its presets hold: plain numbers that print and serialize."""

import dataclasses
import pathlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import optax

from jaxcloseup.artifacts.viewer_gaussians import Gaussians
from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.labels.config import LabelConfig
from jaxcloseup.photos.scene import Scene
from jaxcloseup.training.config import TrainConfig
from jaxcloseup.training.steps import TrainState


@dataclasses.dataclass(frozen=True)
class TargetConfig:
    """How target views, the wanted ones, are labeled and learned, other than random close-ups.

    Attributes:
      label: as in `LabelConfig`.
      label_loss_weight: as there.
      lr_scale: as there.
      control_lr_scale: the same for as many steps without labels, `test_time_control`, which may
        learn best at other rates.
    """

    label: str = "warp"
    label_loss_weight: float = 0.5
    lr_scale: float = 1.0
    control_lr_scale: float = 1.0


@dataclasses.dataclass(frozen=True)
class WindowConfig:
    """How steps read photographs finer than they are reduced.

    Fields that render whole images read windows as large as reduced photographs, and fields that
    render single rays read single pixels.

    Attributes:
      finest: divisor of the finest size that is read; one that fits into memory is taken.
      whole_share: share of the steps, or pixels, that read a whole reduced photograph.
    """

    finest: int = 1
    whole_share: float = 0.4


@dataclasses.dataclass(frozen=True)
class CoarseConfig:
    """A first training, on whole reduced photographs, whose result becomes finer.

    Attributes:
      field: the field's configuration in it.
      steps: how many.
    """

    field: Any
    steps: int


@dataclasses.dataclass(frozen=True)
class Preset:
    """One experiment with one method.

    Attributes:
      method: a name in `METHODS`.
      field: the method's own configuration: its field, optimizer and steps for target views.
      train: what a step looks at.
      labels: how close-ups are drawn and labeled.
      baseline_steps: steps of stage 1, on photographs alone.
      closeup_steps: steps of stage 2 with labels, and of its control without.
      downscale: divisor of the photographs' size.
      score_downscale: divisor of the photographs' size at which held-out views are scored too,
        if it is finer; None: at none.
      gated: let left-out photographs decide how much labels weigh, which may be nothing.
      windows: how steps read finer photographs; None: they read reduced photographs alone.
      coarse: what trains before stage 1; None: stage 1 begins with the initial points.
      targets: how target views are labeled; None: as random close-ups.
    """

    method: str
    field: Any
    train: TrainConfig
    labels: LabelConfig
    baseline_steps: int
    closeup_steps: int
    downscale: int = 1
    score_downscale: int | None = None
    gated: bool = False
    windows: WindowConfig | None = None
    coarse: CoarseConfig | None = None
    targets: TargetConfig | None = None

    @property
    def target_labels(self) -> LabelConfig:
        """How target views are labeled."""
        if self.targets is None:
            return self.labels
        own = {k: v for k, v in vars(self.targets).items() if k != "control_lr_scale"}
        return dataclasses.replace(self.labels, **own)


class Method(NamedTuple):
    """A radiance field as experiments train it: plain values and functions.

    `config` below is the `field` of a preset.

    Attributes:
      presets: by name; `quick`, the default, is the smallest run that shows the method honestly.
      make_field: `(config, scene, growth) -> RadianceField`; `growth` multiplies the capacity of a
        field whose renderings overflow.
      make_optimizer: `(config, scene) -> optax.GradientTransformation`.
      renders_pixels: whether the field renders single pixels, or whole images alone.
      target_steps: `(config, count) -> int`, steps in all on `count` target views.
      max_points: `(config) -> int | None`, how many initial points fit; None: any number.
      with_expected_depth: `(buffers, expected) -> buffers` of a field that renders its expected
        depth (true) or its median depth (false) as depth; None for fields without a choice.
      export: `(folder, stage, params, buffers) -> None` writes a stage's state for other programs.
      gaussians: `(params, buffers, position) -> Gaussians`, what viewers draw, with the colors that
        are seen from `position[3]`; None: they draw the scene's points.
      background: `(config) -> float`, gray level in [0, 1] behind the scene.
      refine: `(key, config, params, buffers, render, scene, pyramid) -> (params, buffers)` gives
        what `CoarseConfig` trained the room and the detail of `config`; `render(params, buffers,
        camera)` renders a state with this room, `pyramid` holds the scene's training photographs.
        None for methods without `coarse`.
      add_for_targets: `(key, config, state, labels, render, scene) -> state` with what `labels` of
        target views show and `render(camera)` of the state does not.
    """

    presets: Mapping[str, Preset]
    make_field: Callable[[Any, Scene, int], RadianceField]
    make_optimizer: Callable[[Any, Scene], optax.GradientTransformation]
    renders_pixels: bool
    target_steps: Callable[[Any, int], int]
    max_points: Callable[[Any], int | None] = lambda config: None
    with_expected_depth: Callable[[Any, bool], Any] | None = None
    export: Callable[[pathlib.Path, str, Any, Any], None] = lambda *state: None
    gaussians: Callable[[Any, Any, Any], Gaussians] | None = None
    background: Callable[[Any], float] = lambda config: 0.0
    refine: Callable[..., tuple[Any, Any]] | None = None
    add_for_targets: Callable[..., TrainState] = lambda key, config, state, *data: state
