"""The arms of a sweep: the rows of the paper's Table 1, ceilings, and any setting with a value."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.pseudo import PseudoSettings
from jaxcloseup.scenes import Scene


# The paper's Table 1, its two test-time rows, and what they are to be held against.
_FIXED_POSES = {"fixed_anchors": 1.0, "magnification": [4.0, 4.0], "max_angle": 0.0}
NAMED_ARMS: dict[str, dict[str, Any]] = {
    "control": {"label_loss_weight": 0.0},
    "labels": {"use_mask": 0.0, **_FIXED_POSES},
    "mask": _FIXED_POSES,
    "diverse": {},
}
ARMS_IN_TURN = ("oracle", "resolved", "test_time")  # labeled once, before their first step
KINDS = ("baseline", *NAMED_ARMS, *ARMS_IN_TURN)

# Of settings that may not be any number from 0 on.
BOUNDS = {
    "label_loss_weight": (0.0, 1.0),
    "magnification": (1.0, np.inf),
    "num_sources": (1.0, np.inf),
}


class Arm(NamedTuple):
    """One arm.

    Attributes:
      name: as it was asked for.
      kind: what it is before it is changed: `baseline`, `diverse`, one in turn, ...
      settings: of its labels.
      expected_depth: whether these are made with the expected depth or the median one; None for
        what the field has by itself.
      depth_error: part of the depth's error that is left in them; None for depth as it is.
    """

    name: str
    kind: str
    settings: PseudoSettings
    expected_depth: bool | None = None
    depth_error: float | None = None

    @property
    def in_turn(self) -> bool:
        """Whether it is trained alone, on views that are labeled before its first step."""
        return self.kind in ARMS_IN_TURN or self.depth_error is not None

    @property
    def outlook(self) -> str:
        """What decides, beside the seed, which virtual cameras it has and what is warped there."""
        settings = self.settings
        seen_from = settings.pose, settings.fixed_anchors, settings.leave_out_source
        return str(jax.device_get((seen_from, self.expected_depth)))


def make_arm(name: str, settings: PseudoSettings) -> Arm:
    """An arm by its name: the preset's settings, changed as the name says.

    That is one of `KINDS`, settings with values as in `rate=2+magnification=2:4`, or the former
    and then the latter, with a plus between them.

    Raises:
      ValueError: the name is none, with what it could be.
    """
    kind, *changed = name.split("+")
    if kind not in KINDS:
        kind, changed = "diverse", name.split("+")
    if kind == "baseline" and changed:
        raise ValueError(f"--arms={name}: baseline has no fine-tuning to change")
    changes = NAMED_ARMS.get(kind, {}) | _parse(name, changed)
    expected_depth, depth_error = (changes.pop(k, None) for k in ("expected_depth", "depth_error"))
    for field, value in changes.items():
        settings = _change(settings, name, field, value)
    if expected_depth not in (None, 0.0, 1.0):
        raise ValueError(f"--arms={name}: expected_depth is 0 (labels from median depth) or 1")
    if kind in ARMS_IN_TURN and (expected_depth, depth_error) != (None, None):
        raise ValueError(f"--arms={name}: {kind} takes no other depth than its own")
    if None not in (expected_depth, depth_error):
        raise ValueError(f"--arms={name}: expected_depth and depth_error do not go together")
    if depth_error is not None and not (np.ndim(depth_error) == 0 and depth_error >= 0):
        raise ValueError(f"--arms={name}: depth_error is a part, as in 0.5, and not negative")
    expected_depth = None if expected_depth is None else bool(expected_depth)
    return Arm(name, kind, settings, expected_depth, depth_error)


def _parse(name, changed):
    changes = {}
    for change in changed:
        field, equals, value = change.partition("=")
        try:
            values = [float(number) for number in value.split(":")]
        except ValueError:
            equals = ""
        if not equals:
            raise ValueError(
                f"--arms={name} is not an arm: name {', '.join(KINDS)}, or setting=number, more "
                "of them after a plus"
            )
        if field in changes:
            raise ValueError(f"--arms={name} sets {field} twice: leave one out")
        changes[field] = values[0] if len(values) == 1 else values
    return changes


def _change(settings, arm, field, value):
    holder = settings if field in vars(settings) else settings.pose
    old = vars(holder).get(field)
    known = field != "pose" and old is not None and jnp.shape(old) == np.shape(value)
    if not known or not np.all(np.diff(np.atleast_1d(value)) >= 0) or np.any(np.isnan(value)):
        fields = {*vars(settings), *vars(settings.pose), "expected_depth", "depth_error"} - {"pose"}
        raise ValueError(
            f"--arms={arm}: {field} takes no such value; settings are "
            + ", ".join(sorted(fields))
            + ", of which magnification is a range as in 2:8"
        )
    low, high = BOUNDS.get(field, (0.0, np.inf))
    if np.min(value) < low or np.max(value) > high:
        raise ValueError(f"--arms={arm}: {field} lies between {low:g} and {high:g}")
    changed = holder.replace(**{field: jnp.asarray(value, old.dtype)})
    return changed if holder is settings else settings.replace(pose=changed)


def why_not(arm: Arm, scene: Scene) -> str | None:
    """Why a scene cannot have an arm, or None."""
    if scene.surface is None and arm.kind in ("oracle", "resolved"):
        return "nobody knows the true pixels"
    if scene.surface is None and arm.depth_error is not None:
        return "nobody knows the true depth"
    if scene.test is None and arm.kind == "test_time":
        return "it has no close-ups to label"
    return None
