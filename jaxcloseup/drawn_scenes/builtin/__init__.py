"""The built-in scenes, in meters with z up: five photographed mainly from -y, one all around."""

from collections.abc import Callable

from jaxcloseup.drawn_scenes.builtin.bench import bench
from jaxcloseup.drawn_scenes.builtin.counter import counter
from jaxcloseup.drawn_scenes.builtin.room import room
from jaxcloseup.drawn_scenes.builtin.stairs import stairs
from jaxcloseup.drawn_scenes.builtin.statue import statue
from jaxcloseup.drawn_scenes.builtin.table import table
from jaxcloseup.drawn_scenes.modeling import Model


SCENES: dict[str, Callable[[], Model]] = {
    "counter": counter,
    "table": table,
    "room": room,
    "bench": bench,
    "stairs": stairs,
    "statue": statue,
}
