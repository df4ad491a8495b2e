"""Imports point one way only: geometry knows nothing, the experiments know everything."""

import ast
import pathlib

import pytest


ROOT = pathlib.Path(__file__).parents[1]
PACKAGE = ROOT / "jaxcloseup"
MAY_IMPORT = {
    "version": set(),
    "files": set(),
    "ply": {"files"},
    "torch_file": set(),
    "numerics": set(),
    "geometry": {"numerics"},
    "field": set(),
    "photographs": {"geometry"},
    "scene": {"geometry", "photographs"},
    "rendered_loss": {"numerics", "field", "photographs"},
    "metrics": {"numerics"},
    "lpips": {"numerics", "torch_file"},
    "volume": {"numerics", "geometry", "field"},
    "splats": {"numerics", "geometry", "field", "metrics"},
    "pseudo": {"numerics", "geometry", "field", "photographs"},
    "support": {"numerics", "geometry", "photographs"},
    "train": {"numerics", "geometry", "field", "photographs", "pseudo", "rendered_loss"},
    "captures": {"files", "ply", "numerics", "geometry", "photographs", "scene"},
    "procedural": {"files", "numerics", "geometry", "photographs", "scene"},
    "scenes": {"captures", "procedural", "scene"},
    "artifacts": {"files", "ply", "numerics", "geometry", "photographs", "splats"},
}
LIBRARIES_OF_GEOMETRY = {"jax", "chex", "flax", "typing", "jaxcloseup"}


def imported(path):
    """Dotted names of the modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: str(p.name))
def test_imports_point_one_way(path):
    layer = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if layer == "__init__":
        return
    for name in imported(path):
        first, *rest = name.split(".")
        assert first not in ("absl", "experiments"), f"{path} imports {name}"
        if first == "jaxcloseup":
            assert rest[0] in MAY_IMPORT[layer] | {layer}, f"{path} imports {name}"
        if layer == "geometry":
            assert first in LIBRARIES_OF_GEOMETRY, f"{path} imports {name}"
