"""The five built-in scenes, in meters with z up, photographed mainly from -y."""

from collections.abc import Callable

from jaxcloseup.procedural.builtin.bench import bench
from jaxcloseup.procedural.builtin.counter import counter
from jaxcloseup.procedural.builtin.room import room
from jaxcloseup.procedural.builtin.stairs import stairs
from jaxcloseup.procedural.builtin.table import table
from jaxcloseup.procedural.modeling import Model


SCENES: dict[str, Callable[[], Model]] = {
    "counter": counter,
    "table": table,
    "room": room,
    "bench": bench,
    "stairs": stairs,
}
