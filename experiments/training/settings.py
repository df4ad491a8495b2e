"""Settings by name: `--set name=value` in programs, `name=value` in the arms of a sweep.

A setting is a number, a word or a range in a preset. Its name is its path without the groups that
hold it (`field`, `train` or `labels`): `capacity`, `density.growth`, `rgb_tolerance`.
"""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from experiments.methods import METHODS, Method, Preset
from jaxcloseup.label_rules import LABEL_RULES
from jaxcloseup.splats.rasterize import COMPOSITORS


_GROUPS = ("field", "train", "labels")
# Other numbers lie between 0 and infinity.
BOUNDS = {
    "label_loss_weight": (0, 1),
    "magnification": (1, math.inf),
    **dict.fromkeys(("num_sources", "baseline_steps", "closeup_steps", "downscale"), (1, math.inf)),
    **dict.fromkeys(
        ("num_rays", "num_label_rays", "num_windows", "chunk", "capacity"), (1, math.inf)
    ),
    **dict.fromkeys(("finest", "steps"), (1, math.inf)),
    **dict.fromkeys(("width", "num_coarse", "num_fine"), (1, math.inf)),
    **dict.fromkeys(("whole_share", "initial_opacity", "ssim_weight", "background"), (0, 1)),
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
        in_train = path[0] == "train"
        if path == ("method",) or (in_train and not method.renders_pixels):
            continue
        if path == ("labels", "expected_depth") and method.with_expected_depth is None:
            continue
        name = ".".join(part for part in path if part not in _GROUPS)
        found[name] = Setting(path, kind, value)
    return found


def _leaves(record, before=()):
    kinds = typing.get_type_hints(type(record))
    for field in dataclasses.fields(record):
        value, path = getattr(record, field.name), (*before, field.name)
        if dataclasses.is_dataclass(value):
            yield from _leaves(value, path)
        elif _is_plain(kinds[field.name]):
            yield path, kinds[field.name], value


def _is_plain(kind):
    """Whether texts can give its values; records come with a preset."""
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
            raise ValueError(
                f"{flag}{text}: method {preset.method} has no setting {name}: choose one of "
                + ", ".join(sorted(known))
            )
        if name in changed:
            raise ValueError(f"{flag}{text} sets {name} twice: leave one out")
        changed.add(name)
        try:
            preset = _replaced(preset, known[name].path, _parse(name, value, known[name].kind))
        except ValueError as error:
            raise ValueError(f"{flag}{text}: {name} must be {error}") from None
    return preset


def _replaced(record, path, value):
    if len(path) > 1:
        value = _replaced(getattr(record, path[0]), path[1:], value)
    return dataclasses.replace(record, **{path[0]: value})


def _parse(name, text, kind):
    """The value of a text, or a ValueError that says what it must be."""
    kinds = _choices(kind)
    if type(None) in kinds and text.lower() == "none":
        return None
    (kind,) = (choice for choice in kinds if choice is not type(None))
    or_none = " or none" if len(kinds) > 1 else ""
    if kind is str:
        choices = _CHOICES[name.rpartition(".")[2]]
        if text not in choices:
            raise ValueError(" or ".join(choices))
        return text
    if kind is bool:
        if text.lower() not in _TRUTH:
            raise ValueError(f"true or false{or_none}")
        return _TRUTH[text.lower()]
    low, high = BOUNDS.get(name.rpartition(".")[2], (0, math.inf))
    between = f"between {low:g} and {high:g}{or_none}"
    if typing.get_origin(kind) is tuple:
        return _range(text, low, high, between, rising=name == "magnification")
    try:
        number = kind(text)
    except ValueError:
        what = "a whole number" if kind is int else "a number"
        raise ValueError(f"{what} {between}") from None
    if not low <= number <= high:
        raise ValueError(between)
    return number


def _range(text, low, high, between, *, rising):
    try:
        first, second = map(float, text.split(":"))
    except ValueError:
        raise ValueError(f"two numbers {between}, as in 2:4") from None
    if not (low <= first <= high and low <= second <= high) or (rising and first > second):
        raise ValueError(f"two numbers {between}, as in 2:4{', rising' if rising else ''}")
    return first, second


def describe_settings(methods: Mapping[str, Method]) -> str:
    """The names of all settings, for `--help`: those that methods share, then each method's own.

    Values are those of the preset `quick`.
    """
    by_method = {
        name: settings_of(next(iter(method.presets.values())), method)
        for name, method in methods.items()
    }
    shared = set.intersection(*(set(settings) for settings in by_method.values()))
    first = next(iter(by_method.values()))
    shared = [name for name in first if name in shared and first[name].path[0] != "field"]
    parts = ["settings of every method: " + ", ".join(shared)]
    for name, settings in by_method.items():
        own = (f"{key}={_text(s.value)}" for key, s in settings.items() if key not in shared)
        parts.append(f"settings of {name}, with the values of its first preset: " + ", ".join(own))
    return "; ".join(parts)


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
