"""Settings by name: `--set name=value` in programs, `name=value` in the arms of a sweep.

A setting is a number, a word or a range in a preset. Its name is its path without the groups that
hold it (`field`, `train` or `labels`): `capacity`, `density.growth`, `rgb_tolerance`.
"""

import dataclasses
import difflib
import math
import sys
import types
import typing
from collections.abc import Sequence
from typing import Any, NamedTuple

from jaxcloseup.app.methods import METHODS, Method, Preset
from jaxcloseup.fields.splats.config import COMPOSITORS
from jaxcloseup.labels.rules import LABEL_RULES


GROUPS = ("field", "train", "labels")
_MOST = 2**31 - 1  # what an int32 counts
# Other whole numbers lie between 0 and _MOST, other numbers between 0 and infinity.
BOUNDS = {
    "magnification": (1, math.inf),
    "capacity": (1, 10**8),
    "sh_degree": (0, 3),
    "max_scale": (1e-6, math.inf),
    "depth": (1, 64),  # layers
    "tile": (1, 64),
    "spacing": (-100, 1),
    "density_shift": (-1e6, 1e6),
    "log2_entries": (1, 28),
    "color_layers": (0, 64),
    **dict.fromkeys(("levels", "features"), (1, 64)),
    **dict.fromkeys(("position_octaves", "direction_octaves", "octaves"), (0, 64)),
    **dict.fromkeys(("baseline_steps", "closeup_steps", "target_steps", "steps"), (1, _MOST)),
    **dict.fromkeys(("steps_per_target", "fewest_target_steps", "means_lr_steps"), (1, _MOST)),
    **dict.fromkeys(
        ("lr_decay_steps", "every", "sh_every", "reset_every", "grow_every"), (1, _MOST)
    ),
    **dict.fromkeys(("downscale", "score_downscale", "finest", "num_sources"), (1, _MOST)),
    "smoothed_at": (1, _MOST),
    **dict.fromkeys(("num_rays", "num_label_rays", "num_windows"), (1, _MOST)),
    **dict.fromkeys(
        ("width", "direction_width", "proposal_width", "num_coarse", "num_fine", "coarsest"),
        (1, _MOST),
    ),
    **dict.fromkeys(("density_components", "color_components", "appearance"), (1, _MOST)),
    **dict.fromkeys(("chunk", "block"), (1, _MOST)),
    **dict.fromkeys(
        ("label_loss_weight", "ssim_weight", "whole_share", "background", "depth_share"), (0, 1)
    ),
    **dict.fromkeys(("initial_opacity", "min_opacity", "reset_opacity"), (0, 1)),
}
_CHOICES = {
    "label": ("warp", "residual"),
    "depth": ("median", "expected"),
    "compute_dtype": ("float32", "bfloat16"),
    "label_rule": tuple(LABEL_RULES),
    "compositor": COMPOSITORS,
}
_TRUTH = {"true": True, "1": True, "false": False, "0": False}


class Setting(NamedTuple):
    """One setting of a preset.

    Attributes:
      path: names of the fields that lead to it.
      kind: its type: int, float, bool, str, a tuple of two floats, or one of these or None.
      value: what the preset says.
    """

    path: tuple[str, ...]
    kind: Any
    value: Any


def settings_of(preset: Preset, method: Method | None = None) -> dict[str, Setting]:
    """The settings of a preset by name.

    Args:
      preset: holds them.
      method: the preset's own by default. One that renders whole images alone has no settings of
        single pixels.
    """
    method = METHODS[preset.method] if method is None else method
    found = {}
    for path, kind, value in _leaves(preset):
        of_pixels = path[0] == "train" and path[1] != "num_windows"
        if path == ("method",) or (of_pixels and not method.renders_pixels):
            continue
        if path == ("labels", "expected_depth") and method.with_expected_depth is None:
            continue
        name = ".".join(part for part in path if part not in GROUPS)
        found[name] = Setting(path, kind, value)
    return found


def _leaves(record, before=()):
    kinds = typing.get_type_hints(type(record))
    for field in dataclasses.fields(record):
        value, path = getattr(record, field.name), (*before, field.name)
        if dataclasses.is_dataclass(value):
            yield from _leaves(value, path)
        elif is_plain(kinds[field.name]):
            yield path, kinds[field.name], value


def is_plain(kind: Any) -> bool:
    """Whether settings can have values of this type; records come with a preset."""
    kinds = {typing.get_origin(choice) or choice for choice in _choices(kind)}
    return kinds <= {int, float, bool, str, tuple, type(None)}


def _choices(kind):
    return typing.get_args(kind) if isinstance(kind, types.UnionType) else (kind,)


def with_settings(preset: Preset, given: Sequence[str], *, flag: str = "--set=") -> Preset:
    """The preset with other values.

    Args:
      preset: what is changed.
      given: texts such as `rgb_tolerance=0.02` and `magnification=2:4`.
      flag: what an error begins with, before the text.

    Raises:
      ValueError: one sentence that names the setting and says what it may be.
    """
    known, changed = settings_of(preset), set()
    for text in given:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"{flag}{text} must be name=value, as in label_loss_weight=0.1")
        if name not in known:
            parts = [one for one in known if f".{name}." in f".{one}."]
            near = parts or difflib.get_close_matches(name, known, n=3)
            meant = f"perhaps {' or '.join(near)} is meant; " if near else ""
            raise ValueError(
                f"{flag}{text}: method {preset.method} has no setting {name}: {meant}--set=help "
                "lists all"
            )
        if name in changed:
            raise ValueError(f"{flag}{text} sets {name} twice: leave one out")
        changed.add(name)
        try:
            kind = known[name].kind
            value = check_value(name, _parse(value, kind), kind)
            preset = _replaced(preset, known[name].path, value)
        except ValueError as error:
            raise ValueError(f"{flag}{text}: {name} must be {error}") from None
    return preset


def _replaced(record, path, value):
    if len(path) > 1:
        value = _replaced(getattr(record, path[0]), path[1:], value)
    return dataclasses.replace(record, **{path[0]: value})


def _parse(text, kind):
    """The value of a text; the text itself where it is no such value."""
    kinds = _choices(kind)
    if type(None) in kinds and text.lower() == "none":
        return None
    (kind,) = (choice for choice in kinds if choice is not type(None))
    if kind is bool:
        return _TRUTH.get(text.lower(), text)
    try:
        if typing.get_origin(kind) is tuple:
            return tuple(map(float, text.split(":")))
        return kind(text)
    except ValueError:
        return text


def check_value(name: str, value: Any, kind: Any) -> Any:
    """The value of a setting, with whole numbers as floats where these are wanted.

    Args:
      name: of the setting.
      value: as `--set` or the JSON of a stored run gives it.
      kind: as in `Setting`.

    Raises:
      ValueError: the setting has no such value; the message says what it must be.
    """
    kinds, name = _choices(kind), name.rpartition(".")[2]
    if value is None and type(None) in kinds:
        return None
    (kind,) = (choice for choice in kinds if choice is not type(None))
    or_none = " or none" if len(kinds) > 1 else ""
    if kind is str:
        if value not in _CHOICES[name]:
            raise ValueError(" or ".join(_CHOICES[name]))
        return value
    if kind is bool:
        if not isinstance(value, bool):
            raise ValueError(f"true or false{or_none}")
        return value
    low, high = BOUNDS.get(name, (0, _MOST if kind is int else math.inf))
    between = f"between {low} and {high}{or_none}"
    if typing.get_origin(kind) is tuple:
        rising = name == "magnification"
        if not (isinstance(value, tuple) and len(value) == 2 and all(map(_is_number, value))):
            raise ValueError(f"two numbers {between}, as in 2:4")
        inside = all(low <= number <= high for number in value)
        if not inside or (rising and value[0] > value[1]):
            raise ValueError(f"two numbers {between}, as in 2:4{', rising' if rising else ''}")
        return tuple(map(float, value))
    if not _is_number(value) or (kind is int and not isinstance(value, int)):
        what = "a whole number" if kind is int else "a number"
        raise ValueError(f"{what} {between}")
    if not low <= value <= high:
        raise ValueError(between)
    return kind(value)


def _is_number(value):
    """Whether a value is a number that a float can hold; JSON has no limit."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return isinstance(value, float) or abs(value) <= sys.float_info.max


def describe_settings(preset: Preset) -> str:
    """What `--set=help` prints: a line for each setting, with its value and what it may be."""
    lines = [f"--set name=value changes any of these, of the method {preset.method}:"]
    found = settings_of(preset)
    width = max(len(f"{name}={_text(setting.value)}") for name, setting in found.items())
    for name, setting in found.items():
        shown = f"{name}={_text(setting.value)}"
        lines.append(f"  {shown:{width}}  {_wanted(name, setting.kind)}")
    return "\n".join(lines)


def _wanted(name, kind):
    """What a setting must be, as the error of a wrong value says it."""
    try:
        check_value(name, object(), kind)
    except ValueError as error:
        return str(error)


def _text(value):
    if isinstance(value, tuple):
        return ":".join(map(_text, value))
    if isinstance(value, float):
        return f"{value:g}"
    return str(value).lower() if value is None or isinstance(value, bool) else str(value)


def plain_config(preset: Preset) -> dict[str, Any]:
    """The configuration as JSON holds it: infinity, which turns a setting off, becomes "inf"."""

    def plain(value):
        if isinstance(value, dict):
            return {key: plain(inner) for key, inner in value.items()}
        if isinstance(value, tuple):
            return list(value)
        return "inf" if value == math.inf else value

    return plain(dataclasses.asdict(preset))
