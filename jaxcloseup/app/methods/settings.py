"""Settings by name: `--set name=value` in programs, `name=value` in the arms of a sweep.

A setting is a number, a word or a range in a preset; its field holds its bounds and its help, see
`jaxcloseup.setting`. Its name is its path without the groups that hold it (`field`, `train` or
`labels`): `capacity`, `density.growth`, `rgb_tolerance`.
"""

import dataclasses
import difflib
import math
import sys
import types
import typing
from collections.abc import Iterator, Sequence
from typing import Any

from jaxcloseup.app.methods.method import Method, Preset
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.io.messages import describe_option
from jaxcloseup.setting import Limits, limits_of


GROUPS = ("field", "train", "labels")
_TRUTH = {"true": True, "1": True, "false": False, "0": False}


@dataclasses.dataclass(frozen=True)
class Setting:
    """One setting of a preset."""

    path: tuple[str, ...]  # names of the fields that lead to it
    kind: Any  # its type: int, float, bool, str, a tuple of two floats, or one of these or None
    limits: Limits  # what it may be, and its help
    value: Any  # what the preset says

    @property
    def name(self) -> str:
        """Name by which `--set` changes it."""
        return ".".join(part for part in self.path if part not in GROUPS)

    @property
    def wanted(self) -> str:
        """Return what it must be, as the error about a wrong value says it."""
        try:
            check_value(object(), self.kind, self.limits)
        except ValueError as error:
            return str(error)
        raise AssertionError(f"{self.name} takes anything")


def settings_of(preset: Preset, method: Method | None = None) -> dict[str, Setting]:
    """Return the settings of a preset by name.

    The method is the preset's by default; one that renders whole images has no settings of pixels.
    """
    method = METHODS[preset.method] if method is None else method
    found = {}
    for setting in _leaves(preset):
        group, name = setting.path[0], setting.path[-1]
        counts_pixels = group == "train" and name != "num_windows"
        if setting.path == ("method",) or (counts_pixels and not method.renders_pixels):
            continue
        if setting.path == ("labels", "expected_depth") and method.with_expected_depth is None:
            continue
        found[setting.name] = setting
    return found


def _leaves(record: Any, before: tuple[str, ...] = ()) -> Iterator[Setting]:
    kinds = typing.get_type_hints(type(record))
    for field in dataclasses.fields(record):
        value, path = getattr(record, field.name), (*before, field.name)
        if dataclasses.is_dataclass(value):
            yield from _leaves(value, path)
        elif is_plain(kinds[field.name]):
            yield Setting(path, kinds[field.name], limits_of(type(record), field.name), value)


def is_plain(kind: Any) -> bool:
    """Return whether settings can have values of this type; records come with a preset."""
    kinds = {typing.get_origin(choice) or choice for choice in _choices(kind)}
    return kinds <= {int, float, bool, str, tuple, type(None)}


def _choices(kind: Any) -> tuple[Any, ...]:
    return typing.get_args(kind) if isinstance(kind, types.UnionType) else (kind,)


def with_settings(preset: Preset, given: Sequence[str], *, flag: str = "--set=") -> Preset:
    """Return the preset with other values.

    `given` has texts such as `rgb_tolerance=0.02`; errors begin with `flag` and the text.

    Raises:
      ValueError: one sentence that names the setting and says what it may be.
    """
    known, changed = settings_of(preset), set()
    for text in given:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"{flag}{text} must be name=value, as in label_loss_weight=0.1")
        if name not in known:
            parts = [other for other in known if f".{name}." in f".{other}."]
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
            setting = known[name]
            checked = check_value(_parse(value, setting.kind), setting.kind, setting.limits)
            preset = _replaced(preset, setting.path, checked)
        except ValueError as error:
            raise ValueError(f"{flag}{text}: {name} must be {error}") from None
    return preset


def _replaced(record: Any, path: tuple[str, ...], value: Any) -> Any:
    if len(path) > 1:
        value = _replaced(getattr(record, path[0]), path[1:], value)
    return dataclasses.replace(record, **{path[0]: value})


def _parse(text: str, kind: Any) -> Any:
    """Return the value of a text; the text itself where it is no such value."""
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


def check_value(value: Any, kind: Any, limits: Limits) -> Any:
    """Return the value of a setting, with whole numbers as floats where these are wanted.

    Raises:
      ValueError: the setting has no such value; the message says what it must be.
    """
    kinds = _choices(kind)
    if value is None and type(None) in kinds:
        return None
    (kind,) = (choice for choice in kinds if choice is not type(None))
    or_none = " or none" if len(kinds) > 1 else ""
    if kind is str:
        if value not in limits.choices:
            raise ValueError(" or ".join(limits.choices) + or_none)
        return value
    if kind is bool:
        if not isinstance(value, bool):
            raise ValueError(f"true or false{or_none}")
        return value
    low, high = limits.bounds(kind)
    between = f"between {low} and {high}{or_none}"
    if typing.get_origin(kind) is tuple:
        if not (isinstance(value, tuple) and len(value) == 2 and all(map(_is_number, value))):
            raise ValueError(f"two numbers {between}, as in 2:4")
        inside = all(low <= number <= high for number in value)
        if not inside or (limits.rising and value[0] > value[1]):
            rising = ", rising" if limits.rising else ""
            raise ValueError(f"two numbers {between}, as in 2:4{rising}")
        return tuple(map(float, value))
    if not _is_number(value) or (kind is int and not isinstance(value, int)):
        what = "a whole number" if kind is int else "a number"
        raise ValueError(f"{what} {between}")
    if not low <= value <= high:
        raise ValueError(between)
    return kind(value)


def _is_number(value: Any) -> bool:
    """Return whether a value is a number that a float can hold; JSON has no limit."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return isinstance(value, float) or abs(value) <= sys.float_info.max


def describe_settings(preset: Preset) -> str:
    """Return what `--set=help` prints: each setting with its value, help and bounds."""
    lines = [f"--set name=value changes any of these, of the method {preset.method}:"]
    for name, setting in settings_of(preset).items():
        about = "; ".join(filter(None, (setting.limits.help, setting.wanted)))
        lines.append(describe_option(f"{name}={_text(setting.value)}", about))
    return "\n".join(lines)


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return ":".join(map(_text, value))
    if isinstance(value, float):
        return f"{value:g}"
    return str(value).lower() if value is None or isinstance(value, bool) else str(value)


def plain_config(preset: Preset) -> dict[str, Any]:
    """Return the configuration as JSON holds it, with "inf", which turns a setting off."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(inner) for key, inner in value.items()}
        if isinstance(value, tuple):
            return list(value)
        return "inf" if value == math.inf else value

    return plain(dataclasses.asdict(preset))
