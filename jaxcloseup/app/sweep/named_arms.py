"""The arms of a sweep: the rows of the paper's Table 1, ceilings, and any settings of labels."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax

from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.settings import with_settings
from jaxcloseup.labels.config import LabelConfig, pseudo_settings
from jaxcloseup.labels.make import PseudoSettings
from jaxcloseup.photos.scene import Scene


# The paper's Table 1, its two test-time rows, and the control that all are compared with.
_WARPS = ("label=warp",)
_FIXED_POSES = (*_WARPS, "fixed_anchors=true", "magnification=4:4", "max_angle=0")
NAMED_ARMS: dict[str, tuple[str, ...]] = {
    "control": (*_WARPS, "label_loss_weight=0"),
    "labels": ("use_mask=false", "depth_tolerance=inf", *_FIXED_POSES),
    "mask": _FIXED_POSES,
    "diverse": (),
}
ARMS_IN_TURN = ("oracle", "resolved", "test_time")  # labeled once, before their first step
KINDS = ("baseline", *NAMED_ARMS, *ARMS_IN_TURN)
_LABEL_SETTINGS = frozenset(LabelConfig.__dataclass_fields__)


class Arm(NamedTuple):
    """One arm."""

    name: str  # as the user wrote it
    kind: str  # what it is before its settings change: `baseline`, `diverse`, one in turn, ...
    labels: LabelConfig  # how its close-ups are drawn and labeled
    # Share of the depth's error that its labels keep; None: labels from rendered depth as it is.
    depth_error: float | None = None

    @property
    def settings(self) -> PseudoSettings:
        """Return the traced settings of its labels."""
        return pseudo_settings(self.labels)

    @property
    def in_turn(self) -> bool:
        """Return True if it trains alone, on views that are labeled before its first step."""
        by_detail = self.labels.label == "residual"
        return self.kind in ARMS_IN_TURN or self.depth_error is not None or by_detail

    @property
    def outlook(self) -> str:
        """Return settings that decide, with the seed, which cameras it draws and what it warps."""
        settings, labels = self.settings, self.labels
        seen_from = settings.pose, settings.fixed_anchors, settings.leave_out_source
        return str(jax.device_get((seen_from, labels.expected_depth)))


def make_arm(name: str, preset: Preset) -> Arm:
    """Return an arm by its name: the preset's settings of labels, changed as the name says.

    The name is one of `KINDS`, settings with values as in `lr_scale=2+magnification=2:4`, or a kind
    and then settings, joined by plus signs.

    Raises:
      ValueError: the name is no arm; one sentence that says what it could be.
    """
    kind, *changed = name.split("+")
    if kind not in KINDS:
        kind, changed = "diverse", name.split("+")
    if kind == "baseline" and changed:
        raise ValueError(f"--arms={name}: baseline has no fine-tuning to change")
    errors = [text for text in changed if text.startswith("depth_error=")]
    changed = [text for text in changed if text not in errors]
    for text in changed:
        setting, equals, _ = text.partition("=")
        if not equals or setting not in _LABEL_SETTINGS:
            raise ValueError(
                f"--arms={name}: {text} is neither an arm ({', '.join(KINDS)}) nor a setting of "
                f"labels with a value ({', '.join(sorted(_LABEL_SETTINGS | {'depth_error'}))}): "
                "change other settings of the whole sweep with --set"
            )
    if kind == "test_time":
        preset = dataclasses.replace(preset, labels=preset.target_labels)
    of_kind = with_settings(preset, NAMED_ARMS.get(kind, ()))
    labels = with_settings(of_kind, changed, flag=f"--arms={name}: ").labels
    depth_error = _depth_error(name, errors)
    changes_depth = (
        depth_error is not None or labels.expected_depth != of_kind.labels.expected_depth
    )
    if kind in ARMS_IN_TURN and changes_depth:
        raise ValueError(
            f"--arms={name}: {kind} takes no other depth: leave out expected_depth and depth_error"
        )
    if labels.label == "residual" and changes_depth:
        raise ValueError(f"--arms={name}: label=residual has its own depth: add +label=warp")
    if labels.label != of_kind.labels.label and kind not in ("diverse", "test_time"):
        raise ValueError(
            f"--arms={name}: {kind} has one kind of labels: change label of diverse or test_time"
        )
    if None not in (labels.expected_depth, depth_error):
        raise ValueError(f"--arms={name}: expected_depth and depth_error do not go together")
    return Arm(name, kind, labels, depth_error)


def _depth_error(name: str, texts: list[str]) -> float | None:
    """Return the share of the depth's error in `depth_error=share`; None without such a text."""
    if not texts:
        return None
    try:
        (share,) = (float(text.partition("=")[2]) for text in texts)
        if not share >= 0:
            raise ValueError
    except ValueError:
        raise ValueError(
            f"--arms={name}: depth_error is a share of the error, once, as in depth_error=0.5"
        ) from None
    return share


def why_not(arm: Arm, scene: Scene) -> str | None:
    """Return why a scene cannot have an arm, or None."""
    if scene.surface is None and arm.kind in ("oracle", "resolved"):
        return "the true pixels of its close-ups are not known"
    if scene.surface is None and arm.depth_error is not None:
        return "its true depth is not known"
    if scene.test is None and arm.kind == "test_time":
        return "it has no close-ups to label"
    return None


def check_possible(names: Sequence[str], preset: Preset, scenes: Sequence[Scene]) -> None:
    """Refuse arms of which a scene can have none.

    Raises:
      ValueError: one sentence that names the flag.
    """
    for scene in scenes:
        reasons = [why_not(make_arm(name, preset), scene) for name in names]
        if all(reasons):
            raise ValueError(
                f"--arms={','.join(names)}: {scene.name} can have none of them, for {reasons[0]}: "
                "name others"
            )


def describe(arms: list[Arm]) -> dict[str, Any]:
    """Return arms by name as JSON can hold them, for a sweep's identity."""
    return {arm.name: str({**vars(arm.labels), "depth_error": arm.depth_error}) for arm in arms}
