"""Imports point one way only, modules stay short, and only methods know types of fields."""

import ast
import pathlib
import re

import pytest


ROOT = pathlib.Path(__file__).parents[1]
PACKAGE, EXPERIMENTS = ROOT / "jaxcloseup", ROOT / "experiments"
MODULES = sorted([*PACKAGE.rglob("*.py"), *EXPERIMENTS.rglob("*.py")])
MAY_IMPORT = {
    "version": set(),
    "choices": set(),
    "messages": set(),
    "files": set(),
    "memory": set(),
    "ply": {"files", "messages"},
    "torch_file": {"files", "messages"},
    "numerics": set(),
    "geometry": {"numerics"},
    "field": set(),
    "photographs": {"geometry"},
    "scene": {"geometry", "messages", "photographs"},
    "rendered_loss": {"numerics", "field", "photographs"},
    "label_rules": {"field", "photographs"},
    "metrics": {"numerics"},
    "lpips": {"numerics", "torch_file"},
    "volume": {"numerics", "geometry", "field"},
    "splats": {"numerics", "geometry", "field", "metrics"},
    "pseudo": {"numerics", "geometry", "field", "photographs"},
    "support": {"numerics", "geometry", "photographs"},
    "pyramids": {"geometry", "photographs", "scene"},
    "windows": {"geometry", "photographs", "pyramids"},
    "gather": {"numerics", "geometry", "photographs", "pyramids"},
    "detail_weights": {"files", "numerics"},
    "holes": {"numerics", "geometry", "gather"},
    "detail": {"numerics", "geometry", "gather", "pyramids", "detail_weights", "holes"},
    "tsdf": {"numerics", "geometry", "gather", "photographs"},
    "draws": {"geometry", "photographs", "pseudo", "pyramids", "windows"},
    "train": {
        *("numerics", "geometry", "field", "photographs"),
        *("draws", "pseudo", "label_rules", "rendered_loss", "pyramids", "windows"),
    },
    "captures": {
        "choices",
        "files",
        "memory",
        "messages",
        "ply",
        "numerics",
        "geometry",
        "photographs",
        "scene",
    },
    "procedural": {"files", "numerics", "geometry", "photographs", "scene"},
    "scenes": {"captures", "procedural", "scene"},
    "artifacts": {"files", "messages", "ply", "numerics", "geometry", "photographs", "splats"},
}
# The rooms of `experiments`, and which others each may use; programs at the top may use all.
ROOMS = {
    "progress": set(),
    "methods": {"progress"},
    "evaluation": {"methods", "progress"},
    "training": {"methods", "evaluation", "progress", "command_line"},
    "reporting": {"methods", "evaluation", "training"},
    "viewing": {"methods", "evaluation", "progress", "training"},
    "benchmarks": {"methods", "evaluation", "training", "reporting", "viewing"},
    "processing": {"progress"},
    "jobs": {
        *("methods", "evaluation", "progress", "training", "reporting", "viewing", "processing"),
        "command_line",
    },
    "command_line": {"progress"},
}
LIBRARIES_OF_GEOMETRY = {"jax", "chex", "flax", "typing", "jaxcloseup"}
LONGEST_MODULE, LONGEST_FUNCTION, MOST_PROGRAMS = 400, 80, 10
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


def modules_of(package, layer):
    return [package / f"{layer}.py"] * (package / f"{layer}.py").exists() + sorted(
        (package / layer).rglob("*.py")
    )


def test_every_layer_has_its_line():
    assert {p.stem for p in PACKAGE.glob("*") if modules_of(PACKAGE, p.stem)} - {"__init__"} == set(
        MAY_IMPORT
    )


@pytest.mark.parametrize("layer", MAY_IMPORT)
def test_imports_of_the_library_point_one_way(layer):
    for path in modules_of(PACKAGE, layer):
        for name in imported(path):
            first, *rest = name.split(".")
            assert first not in ("absl", "experiments"), f"{path} imports {name}"
            if first == "jaxcloseup" and rest:
                assert rest[0] in MAY_IMPORT[layer] | {layer}, f"{path} imports {name}"
            if layer == "geometry":
                assert first in LIBRARIES_OF_GEOMETRY, f"{path} imports {name}"


@pytest.mark.parametrize("room", ROOMS)
def test_imports_of_the_experiments_point_one_way(room):
    for path in modules_of(EXPERIMENTS, room):
        for name in imported(path):
            first, *rest = name.split(".")
            if first == "experiments" and rest:
                assert rest[0] in ROOMS[room] | {room}, f"{path} imports {name}"
            if room == "training":
                assert first != "matplotlib", f"{path} plots"


def test_only_methods_and_their_fields_know_types_of_fields():
    for path in MODULES:
        if path.relative_to(ROOT).parts[1] not in ("volume", "splats", "methods", "benchmarks"):
            found = FIELD_TYPES.findall(path.read_text(encoding="utf-8"))
            assert not found, f"{path} asks what type a field is: {found}"


def test_modules_and_functions_stay_short():
    for path in MODULES:
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= LONGEST_MODULE, f"{path} is too long"
        if path.is_relative_to(EXPERIMENTS):
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    lines = node.end_lineno - node.lineno + 1
                    assert lines < LONGEST_FUNCTION, f"{path}: {node.name} has {lines} lines"


def test_programs_stay_few():
    assert len(list(EXPERIMENTS.glob("[!_]*.py"))) <= MOST_PROGRAMS
