"""What a method is, and what its presets hold: plain numbers that print and serialize."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from jaxcloseup.labels.config import LabelConfig
from jaxcloseup.setting import setting
from jaxcloseup.training.config import TrainConfig


if TYPE_CHECKING:  # flags read presets, and must not wait for JAX
    import jax
    import optax

    from jaxcloseup.fields.contract import RadianceField
    from jaxcloseup.fields.splats.surfels import Surfels
    from jaxcloseup.photos.scene import Scene
    from jaxcloseup.training.state import TrainState


@dataclasses.dataclass(frozen=True)
class TargetConfig:
    """How target views are labeled and learned where random close-ups differ."""

    label: str = setting(
        "warp", "source of labels, as in `LabelConfig`", choices=("warp", "residual")
    )
    label_loss_weight: float = setting(0.5, "weight of the labels' loss in a step", high=1)
    lr_scale: float = setting(1.0, "factor on the learning rates in steps with labels")
    control_lr_scale: float = setting(
        1.0, "factor on the learning rates of `test_time_control`, as many steps without labels"
    )


@dataclasses.dataclass(frozen=True)
class WindowConfig:
    """How steps read photographs finer than they are reduced.

    Fields that render whole images read windows as large as reduced photographs, and fields that
    render single rays read single pixels.
    """

    finest: int = setting(
        1,
        "divisor of the finest size that steps read; larger if that size does not fit into memory",
        low=1,
    )
    whole_share: float = setting(
        0.4, "share of the steps, or pixels, that read a whole reduced photograph", high=1
    )


@dataclasses.dataclass(frozen=True)
class CoarseConfig:
    """A first training, on whole reduced photographs, whose result becomes finer."""

    field: Any = setting(help="configuration of the field during this training")
    steps: int = setting(help="number of steps", low=1)
    poses: bool = setting(
        False,
        "move a capture's cameras to where the coarse model fits their photographs, not in sweeps",
    )


@dataclasses.dataclass(frozen=True)
class StereoTraining:
    """What training takes from depth that photographs show by themselves."""

    pixels: int = setting(
        2**21,
        "about how many pixels of all photographs together are matched: few photographs are "
        "matched at a larger size than many; 0 matches none",
        low=0,
    )
    points: int = setting(10_000, "initial points at matched pixels", low=0)
    exposures: bool = setting(
        True, "bring photographs to one exposure where matched pixels differ in it"
    )


@dataclasses.dataclass(frozen=True)
class Preset:
    """One experiment with one method."""

    method: str = setting(help="a name in `METHODS`")
    field: Any = setting(help="the method's configuration of its field, optimizer and target views")
    train: TrainConfig = setting(help="how much a step looks at")
    labels: LabelConfig = setting(help="how close-ups are drawn and labeled")
    baseline_steps: int = setting(help="steps of stage 1, on photographs alone", low=1)
    closeup_steps: int = setting(help="steps of stage 2 with labels, and of its control", low=1)
    downscale: int | None = setting(
        1, "divisor of the photographs' size; none: as `step_pixels` needs", low=1
    )
    step_pixels: int = setting(
        8192, "about how many pixels photographs keep, and steps read, without `downscale`", low=256
    )
    score_width: int | None = setting(
        None,
        "about how many pixels the longer side of held-out views has when they are scored; none: "
        "as the photographs, or 960 where these are larger than a screen",
        low=1,
    )
    gated: bool = setting(
        False, "let held-out training photographs decide the weight of labels, which may be 0"
    )
    windows: WindowConfig | None = setting(
        None, "how steps read finer photographs; none reads reduced photographs only"
    )
    coarse: CoarseConfig | None = setting(
        None, "training before stage 1; none begins stage 1 with the initial points"
    )
    stereo: StereoTraining | None = setting(
        None, "depth by matching photographs, before any field; none uses the capture's points"
    )
    targets: TargetConfig | None = setting(
        None, "how target views are labeled; none labels them as random close-ups"
    )

    @property
    def target_labels(self) -> LabelConfig:
        """Return how target views are labeled."""
        if self.targets is None:
            return self.labels
        own = {k: v for k, v in vars(self.targets).items() if k != "control_lr_scale"}
        return dataclasses.replace(self.labels, **own)


@dataclasses.dataclass(frozen=True)
class Method:
    """A radiance field and its training: plain values, and functions that import JAX when called.

    `config` below is the `field` of a preset.
    """

    help: str  # a line for `--help`, with the paper
    # By name; `quick`, the default, is the smallest run that shows the method honestly.
    presets: Mapping[str, Preset]
    # `(config, scene, growth) -> RadianceField`; `growth` multiplies the capacity of a field whose
    # renderings overflow.
    make_field: "Callable[[Any, Scene, int], RadianceField]"
    # `(config, scene) -> optax.GradientTransformation`.
    make_optimizer: "Callable[[Any, Scene], optax.GradientTransformation]"
    renders_pixels: bool  # whether the field renders single pixels, or whole images alone
    # `(config, count) -> int`, steps in all on `count` target views.
    target_steps: Callable[[Any, int], int]
    # `(config) -> int | None`, how many initial points fit; None: any number.
    max_points: Callable[[Any], int | None] = lambda config: None
    # `(buffers, expected) -> buffers` of a field that renders its expected depth (true) or its
    # median depth (false) as depth; None for fields without a choice.
    with_expected_depth: Callable[[Any, bool], Any] | None = None
    # `(params, buffers) -> (surfels, alive)`, splats that other programs draw, and which are
    # alive; None: viewers draw the scene's points.
    splats: "Callable[[Any, Any], tuple[Surfels, jax.Array]] | None" = None
    # `(config) -> float`, gray level in [0, 1] behind the scene.
    background: Callable[[Any], float] = lambda config: 0.0
    # `(key, config, params, buffers, render, scene, pyramid) -> (params, buffers)` gives what
    # `CoarseConfig` trained the room and the detail of `config`; `render(params, buffers, camera)`
    # renders a state with this room, `pyramid` holds the scene's training photographs. None for
    # methods without `coarse`.
    refine: Callable[..., tuple[Any, Any]] | None = None
    # `(key, config, state, labels, render, scene) -> state` with what `labels` of target views show
    # and `render(camera)` of the state does not.
    add_for_targets: "Callable[..., TrainState]" = lambda key, config, state, *data: state
