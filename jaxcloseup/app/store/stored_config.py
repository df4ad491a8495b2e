"""Rebuild presets from the JSON of stored runs."""

import dataclasses
import math
import typing
from collections.abc import Mapping
from typing import Any

from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import check_value, is_plain, plain_config
from jaxcloseup.setting import Limits, limits_of


_RETIRED = {"score_downscale"}  # settings that said nothing about what was trained


def preset_from_config(stored: Mapping[str, Any]) -> tuple[Preset, dict[str, Any]]:
    """Return the preset whose `plain_config` a run stored.

    A setting that the run's version lacked has its default: every setting that is added later must
    do by default what programs did before.

    Args:
      stored: the configuration in the run's JSON.

    Returns:
      The preset, and the absent settings by name with the values they have.

    Raises:
      ValueError: the configuration has another form, or a value that `--set` would refuse; names
        the field.
    """
    stored = {name: value for name, value in stored.items() if name not in _RETIRED}
    if "method" not in stored:
        raise ValueError("config lacks method")
    if stored["method"] not in list(METHODS):  # which may be anything
        raise ValueError(f"there is no method {stored['method']}")
    records: dict[str, set[type]] = {}
    for preset in METHODS[stored["method"]].presets.values():
        _collect(preset, "config", records)
    absent: dict[str, Any] = {}
    preset = _rebuild(stored, "config", records, absent)
    again = plain_config(preset)
    for name in absent:
        _remove(again, name)
    if again != stored:
        raise ValueError("a value has another type")
    return preset, {name.split(".")[-1]: value for name, value in absent.items()}


def _collect(record: Any, name: str, records: dict[str, set[type]]) -> None:
    """Add the types of records in a preset, by the path where they are."""
    records.setdefault(name, set()).add(type(record))
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if dataclasses.is_dataclass(value):
            _collect(value, f"{name}.{field.name}", records)


def _remove(config: dict[str, Any], name: str) -> None:
    *path, last = name.split(".")[1:]
    for key in path:
        config = config[key]
    del config[last]


def _rebuild(
    value: Mapping[str, Any], name: str, records: Mapping[str, set[type]], absent: dict[str, Any]
) -> Any:
    if name not in records:
        raise ValueError(f"{name} holds fields")
    # The run stored one of these records: the one that shares most fields with it.
    choices = sorted(records[name], key=lambda record: record.__name__)
    choice = max(choices, key=lambda record: len(_names(record) & set(value)))
    if unknown := sorted(set(value) - _names(choice)):
        raise ValueError(f"{name} has {', '.join(unknown)}, which this version does not know")
    known: dict[str, Any] = {}
    kinds = typing.get_type_hints(choice)
    for field in dataclasses.fields(choice):
        path, kind = f"{name}.{field.name}", kinds[field.name]
        if field.name not in value:
            if field.default is dataclasses.MISSING:
                raise ValueError(f"{name} lacks {field.name}")
            absent[path] = field.default
        elif isinstance(value[field.name], Mapping):
            known[field.name] = _rebuild(value[field.name], path, records, absent)
        elif path == "config.method":
            known[field.name] = value[field.name]
        else:
            limits = limits_of(choice, field.name)
            known[field.name] = _checked(value[field.name], path, kind, limits)
    return choice(**known)


def _checked(value: Any, name: str, kind: Any, limits: Limits) -> Any:
    """Return the value of a field that holds no record, if `check_value` lets it through."""
    if is_plain(kind):
        try:
            return check_value(_from_json(value), kind, limits)
        except ValueError as error:
            raise ValueError(f"{name} must be {error}") from None
    if value is None and type(None) in typing.get_args(kind):
        return None
    raise ValueError(f"{name} must hold fields")


def _from_json(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_from_json, value))
    return math.inf if value == "inf" else value


def _names(record: type) -> set[str]:
    return {field.name for field in dataclasses.fields(record)}
