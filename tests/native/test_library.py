"""Where the native library cannot be built, everything runs without it and says so once."""

import dataclasses
import importlib.metadata
import os
import pathlib
import pkgutil
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest
from absl import flags
from absl.testing import flagsaver
from tiny_runs import TINY_SURFELS

import jaxcloseup
from jaxcloseup.app.cli import run
from jaxcloseup.app.methods.shared import splat_training
from jaxcloseup.app.run.scene_input import load_scene
from jaxcloseup.fields.splats.config import RasterizeConfig
from jaxcloseup.fields.splats.raster_plan import plan_raster
from jaxcloseup.fields.volume.config import HashGridConfig
from jaxcloseup.fields.volume.hash_grid import hash_features
from jaxcloseup.native import library


PACKAGE = pathlib.Path(jaxcloseup.__file__).parent


def test_without_a_compiler_nothing_is_built(tmp_path):
    """The library is optional: the build says that it failed, and goes on."""
    if int(importlib.metadata.version("setuptools").split(".")[0]) < 77:
        pytest.skip("needs the setuptools that pyproject.toml asks for")
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(PACKAGE.parent / name, tmp_path)
    native = tmp_path / "jaxcloseup" / "native"
    shutil.copytree(PACKAGE / "native", native, ignore=shutil.ignore_patterns("*.so"))
    for name in ("__init__.py", "version.py"):
        shutil.copy(PACKAGE / name, native.parent)
    (tmp_path / "empty").mkdir()
    environment = {k: v for k, v in os.environ.items() if k not in ("CC", "CXX")}
    done = subprocess.run(
        [sys.executable, "setup.py", "build_ext", "--inplace"],
        cwd=tmp_path,
        env={**environment, "PATH": str(tmp_path / "empty")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert 'extension "jaxcloseup.native._native" failed' in done.stdout + done.stderr
    assert not list(tmp_path.rglob("*.so"))


def test_no_tool_takes_the_library_for_a_module():
    """Makers of API pages import every module that they find in a folder."""
    names = [found.name for found in pkgutil.iter_modules([str(PACKAGE / "native")])]
    assert names == ["library"]


@pytest.fixture
def hidden(monkeypatch):
    """No library, as if it had not been built."""
    monkeypatch.setattr(library, "path", lambda: None)
    monkeypatch.setattr(library, "missing", library.missing.__wrapped__)
    splat_training._say_that_it_is_slow.cache_clear()


def field_of(compositor, scene):
    raster = dataclasses.replace(TINY_SURFELS.field.raster, compositor=compositor)
    field = dataclasses.replace(TINY_SURFELS.field, raster=raster)
    with jax.numpy_dtype_promotion("standard"):
        return splat_training.make_field(field, scene, 1)


def test_programs_say_once_that_it_is_missing(hidden, capture_folder, capsys):
    scene = load_scene(str(capture_folder))
    capsys.readouterr()
    field_of("loops", scene)
    assert not capsys.readouterr().out
    for _ in range(2):
        field_of("auto", scene)
    (line,) = capsys.readouterr().out.splitlines()
    assert "was not built" in line and line.endswith(library.INSTALL)
    assert plan_raster(RasterizeConfig(platform="cpu"), height=9, width=9).compositor == "loops"


def test_programs_that_have_it_say_nothing(capture_folder, capsys):
    if not library.available():
        pytest.skip(library.missing())
    scene = load_scene(str(capture_folder))
    capsys.readouterr()
    splat_training._say_that_it_is_slow.cache_clear()
    for compositor in ("auto", "native"):
        field_of(compositor, scene)
    assert not capsys.readouterr().out


def test_to_ask_for_it_in_vain_is_one_sentence(hidden, capture_folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flags.FLAGS(["run"])
    given = {
        "scene": str(capture_folder),
        "output_dir": "out",
        "compilation_cache": "",
        "downscale": 1,
    }
    given |= {"method": "surfels", "set": ["raster.compositor=native"]}
    with (
        flagsaver.flagsaver(**given),
        jax.numpy_dtype_promotion("standard"),
        pytest.raises(SystemExit, match=r'^jaxcloseup run: compositor "native"') as error,
    ):
        run.main(["run"])
    assert "\n" not in error.value.code and library.INSTALL in error.value.code


def test_a_library_that_is_asked_for_and_missing_is_named(hidden):
    config = HashGridConfig(levels=2, log2_entries=4)
    table, x = jnp.zeros((sum(config.entries), config.features)), jnp.zeros((3, 1))
    with pytest.raises(library.LibraryError, match="was not built"):
        hash_features(table, config, x, native=True)
    assert not hash_features(table, config, x).any()
