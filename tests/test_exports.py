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


# What other people's code may import from the package itself.
CONTRACTS = """
Camera pixel_grid pixels_to_rays pixels_to_points points_to_pixels euler_to_matrix matrix_to_euler
quaternion_to_matrix PoseSettings closeup_position sample_anchor perturb_rotation
sample_closeup_camera backward_warp ForwardWarp forward_warp in_bounds depth_consistent
rgb_consistent Surfels surfels_from_points render_surfels Rendering RadianceField Views
PseudoSettings PseudoLabel make_label best_source TrainState train_step pseudo_step load_scene
"""


def test_contracts_are_importable_from_the_package():
    assert set(CONTRACTS.split()) <= set(jaxcloseup.__all__)


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


HIDDEN = ("cv2", "absl", "orbax", "rich", "matplotlib", "imageio", "dm_pix", "PIL")
ROOMS = ("geometry", "photos", "fields", "labels", "detail", "training")
_IMPORT_ALL = """
import importlib, sys
hidden, modules = set(sys.argv[1].split()), sys.argv[2].split()
ours = lambda frame: frame.f_globals.get("__name__", "").startswith("jaxcloseup")

class Hide:
    def find_spec(self, name, path=None, target=None):
        frame = sys._getframe(1)
        while frame and frame.f_globals.get("__name__", "").startswith("importlib"):
            frame = frame.f_back  # other libraries may use what jaxcloseup may not
        if name.split(".")[0] in hidden and frame and ours(frame):
            raise ImportError(name)

sys.meta_path.insert(0, Hide())
for name in modules:
    try:
        importlib.import_module(name)
    except ImportError as error:
        print(name, error.args[0].split(".")[0])
"""


def test_geometry_imports_nothing_heavy():
    code = (
        "import sys, jaxcloseup.geometry\n"
        f"print(*(set({(*HIDDEN, 'optax')}) & {{m.split('.')[0] for m in sys.modules}}))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(run.stdout.split()) <= {"absl", "rich"}  # of chex, and of flax


def test_the_library_needs_few_libraries():
    """Rooms below the programs import with the programs' libraries hidden from them."""
    modules = [
        ".".join(path.relative_to(ROOT.parent).with_suffix("").parts)
        for room in ROOMS
        for path in sorted((ROOT / room).rglob("*.py"))
        if path.stem != "__init__"
    ]
    command = [sys.executable, "-c", _IMPORT_ALL, " ".join(HIDDEN), " ".join(modules)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    assert not run.stdout, run.stdout


def test_the_wheel_has_every_file_of_the_package_and_no_other_package():
    """The native library's sources are not in it, and the library is if it was built."""
    config = tomllib.loads((ROOT.parent / "pyproject.toml").read_text(encoding="utf-8"))
    settings = config["tool"]["setuptools"]
    assert settings["packages"]["find"]["include"] == ["jaxcloseup*"]
    data = {path for name in settings["package-data"]["jaxcloseup"] for path in ROOT.glob(name)}
    kinds = settings["exclude-package-data"]["jaxcloseup.native"]
    sources = {path for kind in kinds for path in (ROOT / "native").glob(kind)}
    built = set((ROOT / "native").glob("_native.lib.so"))
    assert len(sources) > 5 and len(built) <= 1
    for path in ROOT.rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts:
            assert path.suffix == ".py" or path in data | sources | built, path
            assert path.suffix != ".py" or (path.parent / "__init__.py").is_file(), path
