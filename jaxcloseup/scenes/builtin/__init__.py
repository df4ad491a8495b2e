"""The five built-in scenes, in metres with z up, each photographed mainly from -y."""

from collections.abc import Callable

from jaxcloseup.scenes.builtin.bench import bench
from jaxcloseup.scenes.builtin.counter import counter
from jaxcloseup.scenes.builtin.room import room
from jaxcloseup.scenes.builtin.stairs import stairs
from jaxcloseup.scenes.builtin.table import table
from jaxcloseup.scenes.modelling import Model


SCENES: dict[str, Callable[[], Model]] = {
    "counter": counter,
    "table": table,
    "room": room,
    "bench": bench,
    "stairs": stairs,
}
