"""The packages' hand-written lists of public names, and what importing geometry costs."""

import importlib
import inspect
import pathlib
import subprocess
import sys
import tomllib

import pytest

import jaxcloseup
import jaxcloseup.geometry


ROOT = pathlib.Path(jaxcloseup.__file__).parent
PACKAGES = sorted(
    ".".join(path.relative_to(ROOT.parent).parts[:-1]) for path in ROOT.rglob("__init__.py")
)


def public_names(package):
    """Functions and classes without a leading underscore that the package's modules define."""
    for path in set(pathlib.Path(package.__file__).parent.glob("[a-z]*.py")):
        if path.stem in ("numerics", "flag_loops"):  # what geometry itself is built from
            continue
        module = importlib.import_module(f"{package.__name__}.{path.stem}")
        for name, value in vars(module).items():
            defined_here = getattr(value, "__module__", None) == module.__name__
            if defined_here and callable(value) and not name.startswith("_"):
                yield name


@pytest.mark.parametrize("name", PACKAGES)
def test_every_listed_name_resolves(name):
    package = importlib.import_module(name)
    names = getattr(package, "__all__", [])
    assert len(set(names)) == len(names)
    for attribute in names:
        assert getattr(package, attribute) is not None
        assert not inspect.ismodule(getattr(package, attribute)), attribute


def test_every_public_name_of_geometry_is_listed():
    package = jaxcloseup.geometry
    assert set(public_names(package)) == set(package.__all__)


def test_the_top_level_lists_its_names_and_refuses_others():
    assert set(jaxcloseup.__all__) <= set(dir(jaxcloseup))
    assert jaxcloseup.Camera is jaxcloseup.geometry.Camera
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = jaxcloseup.nothing


def test_geometry_imports_nothing_heavy():
    code = (
        "import sys, jaxcloseup.geometry\n"
        "print(*({'optax', 'cv2', 'orbax', 'dm_pix'} & {m.split('.')[0] for m in sys.modules}))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []


def test_the_wheel_has_every_file_of_the_package_and_no_other_package():
    config = tomllib.loads((ROOT.parent / "pyproject.toml").read_text(encoding="utf-8"))
    settings = config["tool"]["setuptools"]
    assert settings["packages"]["find"]["include"] == ["jaxcloseup*"]
    data = {path for name in settings["package-data"]["jaxcloseup"] for path in ROOT.glob(name)}
    for path in ROOT.rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts:
            assert path.suffix == ".py" or path in data, path
            assert path.suffix != ".py" or (path.parent / "__init__.py").is_file(), path
