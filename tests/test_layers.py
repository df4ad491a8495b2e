"""Imports point one way only, and only methods know types of fields."""

import ast
import pathlib
import re

import pytest


ROOT = pathlib.Path(__file__).parents[1]
PACKAGE, EXPERIMENTS = ROOT / "jaxcloseup", ROOT / "experiments"
MODULES = sorted([*PACKAGE.rglob("*.py"), *EXPERIMENTS.rglob("*.py")])
# The rooms of the library, and which others each may use.
MAY_IMPORT = {
    "io": set(),
    "geometry": set(),
    "native": set(),
    "photos": {"geometry", "io", "native"},
    "metrics": {"geometry", "io", "native"},
    "stereo": {"geometry", "io", "native", "photos"},
    "fields": {"geometry", "metrics", "native", "photos"},
    "labels": {"geometry", "photos", "fields"},
    "detail": {"geometry", "io", "metrics", "native", "photos", "fields", "labels"},
    "training": {"geometry", "photos", "fields", "labels"},
    "drawn_scenes": {"geometry", "io", "photos"},
    "captures": {"geometry", "io", "photos", "drawn_scenes"},
    "checks": {"captures", "io", "photos"},
    "artifacts": {"geometry", "io", "fields"},
}
FREE = {"lazy", "setting", "version"}  # modules that every room may use
# The rooms of `jaxcloseup.app`, and which others each may use.
ROOMS = {
    "progress": set(),
    "methods": {"progress"},
    "score": {"methods", "progress"},
    "store": {"methods", "run"},
    "run": {"methods", "score", "progress"},
    "sweep": {"methods", "score", "progress", "run", "report"},
    "report": {"methods", "score", "progress", "run", "store", "view", "process"},
    "view": {"methods", "score", "progress", "run", "store"},
    "process": {"progress"},
    "share": {"methods", "progress", "run", "store", "view"},
    "cli": {
        *("methods", "score", "progress", "run", "report", "view", "process", "share", "store"),
        "sweep",
    },
}
LIBRARIES_OF_GEOMETRY = {"jax", "chex", "flax", "typing", "collections", "jaxcloseup"}
MOST_PROGRAMS, MOST_ROOMS = 11, 15
# What tells one type of field from another.
FIELD_TYPES = re.compile(
    r"isinstance\([^)]*(Surfel|Nerf|Mcmc|Adaptive|Buffers|Aux)"
    r"|aux, [\"']|\.aux\.|buffers\.(?!shape)\w+|hasattr\([^)]*(params|buffers|aux)"
)


def imported(path):
    """Dotted names of the modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_every_room_has_its_line():
    rooms = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert rooms == {*MAY_IMPORT, "app"}
    assert {path.parent.name for path in PACKAGE.glob("app/*/__init__.py")} == set(ROOMS)
    modules = {path.stem for path in PACKAGE.glob("*.py")}
    assert modules == {*FREE, "__init__", "__main__"}
    assert len(rooms) <= MOST_ROOMS


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_imports_of_the_library_point_one_way(room):
    for path in (PACKAGE / room).rglob("*.py"):
        for name in imported(path):
            first, *rest = name.split(".")
            assert first not in ("absl", "experiments"), f"{path} imports {name}"
            if first == "jaxcloseup" and rest:
                assert rest[0] in MAY_IMPORT[room] | {room} | FREE, f"{path} imports {name}"
            if room == "geometry":
                assert first in LIBRARIES_OF_GEOMETRY, f"{path} imports {name}"


@pytest.mark.parametrize("room", ROOMS)
def test_imports_of_the_app_point_one_way(room):
    for path in (PACKAGE / "app" / room).rglob("*.py"):
        for name in imported(path):
            first, second, *rest = [*name.split("."), "", ""][:3]
            assert first != "experiments", f"{path} imports {name}"
            if (first, second) == ("jaxcloseup", "app") and rest[0] and rest[0] in ROOMS:
                assert rest[0] in ROOMS[room] | {room}, f"{path} imports {name}"
            if room == "run":
                assert first != "matplotlib", f"{path} plots"


def test_only_methods_and_their_fields_know_types_of_fields():
    for path in MODULES:
        if not {"fields", "methods", "benchmarks"} & set(path.parts):
            found = FIELD_TYPES.findall(path.read_text(encoding="utf-8"))
            assert not found, f"{path} asks what type a field is: {found}"


def test_programs_stay_few():
    assert len(list(EXPERIMENTS.glob("[!_]*.py"))) <= MOST_PROGRAMS
