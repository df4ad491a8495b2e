"""Presets from the JSON of stored runs, including those that earlier versions stored."""

import dataclasses
import math
import typing
from collections.abc import Mapping
from typing import Any

from jaxcloseup.app.methods import METHODS, Preset
from jaxcloseup.app.methods.settings import check_value, is_plain, plain_config


def preset_from_config(
    stored: Mapping[str, Any], method: str | None = None
) -> tuple[Preset, dict[str, Any]]:
    """The preset whose `plain_config` a run stored.

    A setting that the run's version lacked has its default: every setting that is added later must
    do by default what programs did before.

    Args:
      stored: the configuration in the run's JSON.
      method: the run's method, which version 0.1.0 stored beside the configuration.

    Returns:
      The preset, and the absent settings by name with the values they have.

    Raises:
      ValueError: the configuration has another form, or a value that `--set` would refuse; names
        the field.
    """
    if "method" not in stored:
        stored = from_version_0_1(stored, method)
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


# Settings of version 0.1.0 under the names that they have now.
_FIELD_NAMES = {
    "colour_ridge": "color_ridge",
    "regularise_from": "regularize_from",
    "means_rate": "means_lr",
    "decay_steps": "means_lr_steps",
    "late_rate": "late_lr_scale",
    "sh_rate": "sh_lr",
    "opacity_rate": "opacity_lr",
    "scale_rate": "scale_lr",
    "rotation_rate": "rotation_lr",
}
_LABEL_NAMES = {"label_share": "label_loss_weight"} | {
    name: name
    for name in (
        *("magnification", "max_angle", "anchor_tolerance", "rgb_tolerance", "depth_tolerance"),
        *("forward_label", "leave_out_source", "source_tolerance"),
    )
}
_NERF_NAMES = {
    "learning_rate": "initial_lr",
    "decay_rate": "lr_decay",
    "decay_steps": "lr_decay_steps",
    "normalise": "normalize",
    "test_time_steps": "target_steps",
}
_LABEL_RULES = {
    (False, False, False): "paper",
    (False, False, True): "pooled",
    (True, True, True): "released",
}


def from_version_0_1(stored: Mapping[str, Any], method: str | None) -> dict[str, Any]:
    """The configuration of a run of version 0.1.0 in today's form.

    Raises:
      ValueError: it is not of that version.
    """
    try:
        field, train = dict(stored["field"]), stored["train"]
        if method == "surfels":
            field = {_FIELD_NAMES.get(name, name): value for name, value in field.items()}
            field["steps_per_target"] = stored["test_time_steps"]
        else:
            field |= {new: stored[old] for old, new in _NERF_NAMES.items()}
        quirks = "perturbed_depth", "undivided_depth", "pooled_loss"
        return {
            "method": method,
            "field": field,
            "train": {
                **{name: train[name] for name in ("num_rays", "num_label_rays")},
                "label_rule": _LABEL_RULES[tuple(train[name] for name in quirks)],
            },
            "labels": {new: stored[old] for old, new in _LABEL_NAMES.items()},
            **{
                name: stored[name]
                for name in ("baseline_steps", "closeup_steps", "downscale", "gated")
            },
        }
    except (KeyError, TypeError) as error:
        raise ValueError(f"config lacks {error.args[0]}") from None
