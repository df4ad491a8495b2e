"""Fields of configurations that carry their bounds, choices and help.

A program that changes settings by name, checks stored ones or lists them reads all this from the
field, so a new setting is one line of its dataclass.
"""

import dataclasses
import math
from typing import Any


INT_MAX = 2**31 - 1  # what an int32 counts
_KEY = "setting"  # of a field's metadata


@dataclasses.dataclass(frozen=True)
class Limits:
    """What a setting may be, and what it does.

    Attributes:
      help: what the setting does, one sentence without a full stop.
      low: smallest number.
      high: largest number; None: `INT_MAX` for whole numbers, infinity for others.
      choices: the words it may be.
      rising: whether the second number of a range must not be below the first.
    """

    help: str = ""
    low: float = 0
    high: float | None = None
    choices: tuple[str, ...] = ()
    rising: bool = False

    def bounds(self, kind: type) -> tuple[float, float]:
        """Return the smallest and the largest number of a type, int or float."""
        largest = INT_MAX if kind is int else math.inf
        return self.low, largest if self.high is None else self.high


def setting(
    default: Any = dataclasses.MISSING,
    help: str = "",
    *,
    low: float = 0,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    rising: bool = False,
) -> Any:
    """Return a dataclass field with this default; the arguments are those of `Limits`."""
    limits = Limits(help, low, high, choices, rising)
    return dataclasses.field(default=default, metadata={_KEY: limits})


def limits_of(record: type, name: str) -> Limits:
    """Return the limits of a dataclass's field; a subclass that changes the default keeps them."""
    for base in record.__mro__:
        field = base.__dict__.get("__dataclass_fields__", {}).get(name)
        if field is not None and _KEY in field.metadata:
            return field.metadata[_KEY]
    return Limits()
