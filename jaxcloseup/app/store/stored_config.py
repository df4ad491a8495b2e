"""Rebuild presets from the JSON of stored runs."""

import dataclasses
import math
import typing
from collections.abc import Mapping
from typing import Any

from jaxcloseup.app.methods import METHODS, Preset
from jaxcloseup.app.methods.settings import check_value, is_plain, plain_config


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


def _collect(record, name, records):
    """The types of records in a preset, by the path where they are."""
    records.setdefault(name, set()).add(type(record))
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if dataclasses.is_dataclass(value):
            _collect(value, f"{name}.{field.name}", records)


def _remove(config, name):
    *path, last = name.split(".")[1:]
    for key in path:
        config = config[key]
    del config[last]


def _rebuild(value, name, records, absent):
    if name not in records:
        raise ValueError(f"{name} holds fields")
    # The run stored one of these records: the one that shares most fields with it.
    choices = sorted(records[name], key=lambda record: record.__name__)
    choice = max(choices, key=lambda record: len(_names(record) & set(value)))
    if unknown := sorted(set(value) - _names(choice)):
        raise ValueError(f"{name} has {', '.join(unknown)}, which this version does not know")
    known, kinds = {}, typing.get_type_hints(choice)
    for field in dataclasses.fields(choice):
        path = f"{name}.{field.name}"
        if field.name in value:
            known[field.name] = _value(value[field.name], path, kinds[field.name], records, absent)
        elif field.default is dataclasses.MISSING:
            raise ValueError(f"{name} lacks {field.name}")
        else:
            absent[path] = field.default
    return choice(**known)


def _value(value, name, kind, records, absent):
    """The value of a field: a record, or what `check_value` lets through."""
    if isinstance(value, Mapping):
        return _rebuild(value, name, records, absent)
    if name == "config.method":
        return value
    if is_plain(kind):
        value = _plain(value)
        try:
            return check_value(name, value, kind)
        except ValueError as error:
            raise ValueError(f"{name} must be {error}") from None
    if value is None and type(None) in typing.get_args(kind):
        return None
    raise ValueError(f"{name} must hold fields")


def _plain(value):
    if isinstance(value, list):
        return tuple(map(_plain, value))
    return math.inf if value == "inf" else value


def _names(record):
    return {field.name for field in dataclasses.fields(record)}
