"""Strict numerics for every test, shared caches, and fixtures of captures and stored runs."""

import gc
import os
import pathlib
import shutil
import tempfile

import jax
import optimized  # noqa: F401
import pytest
from absl import flags
from absl.testing import flagsaver
from tiny_runs import keep_run, write_plane


# Arms of sweeps are spread over all devices. Tests compile more than they compute, so LLVM
# optimizes nothing, each program is one piece to it, and JAX 0.10 uses XLA's older, smaller code
# of fused loops, which 0.11 no longer has. Read when the first array is made.
QUICKLY = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
if jax.__version_info__ < (0, 11):
    QUICKLY += " --xla_cpu_use_fusion_emitters=false"
DEVICES = "--xla_force_host_platform_device_count=8"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICKLY} {DEVICES}".strip()
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

_CACHE = "JAXCLOSEUP_TEST_CACHE"


def pytest_configure(config):
    """Share compiled programs among all processes of this run, since many tests need the same.

    Other caches neither read nor write the user's folder. A folder in the environment variable
    JAXCLOSEUP_TEST_CACHE keeps the programs for later runs too.
    """
    if not hasattr(config, "workerinput"):
        os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp()
        os.environ.setdefault(_CACHE, os.environ["XDG_CACHE_HOME"])
    jax.config.update("jax_compilation_cache_dir", os.environ[_CACHE])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def pytest_collection_modifyitems(items):
    """Begin with the files that take longest, so that no process waits for one at the end."""
    first = ["test_sweep", "test_run", "test_render", "test_drawn_scenes", "test_rasterize"]
    first += ["test_volume_methods", "test_process", "test_detail", "test_gpu_bench", "test_view"]
    first += ["test_surfel_field", "test_process_real", "test_sanitizers", "test_interrupt"]
    first += ["test_closeup", "test_parallel", "test_run_arms", "test_steps", "test_examples"]
    ranks = {name: rank for rank, name in enumerate(first)}
    items.sort(key=lambda item: ranks.get(item.path.stem, len(first)))


def pytest_unconfigure(config):
    """Remove the caches of this run."""
    if not hasattr(config, "workerinput"):
        shutil.rmtree(os.environ.pop("XDG_CACHE_HOME"))


MOST_MAPS = 30_000  # of the 65,530 that Linux lets a process have; every program takes several
MAPS = pathlib.Path("/proc/self/maps")


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    """Drop compiled programs before memory maps run out: XLA would wait for one forever."""
    yield
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()


SHARED = pathlib.Path(__file__).parents[2] / "shared"


@pytest.fixture(scope="session")
def shared():
    """The folder of real captures and golden values beside the checkout."""
    if not (SHARED / "data" / "plush").is_dir():
        pytest.skip(f"needs the real captures in {SHARED}")
    return SHARED


@pytest.fixture
def key(request):
    """A key that differs from test to test and never from run to run."""
    return jax.random.key(sum(map(ord, request.node.name)) % 2**31)


@pytest.fixture
def parsed_flags():
    """Parsed flags of the programs that the test imports, which change no compilation cache."""
    flags.FLAGS(["a program"])
    with flagsaver.flagsaver(compilation_cache=""):
        yield


@pytest.fixture(scope="session")
def capture_folder(tmp_path_factory):
    """The plane as photographs in the paper's layout."""
    return write_plane(tmp_path_factory.mktemp("plane"))


@pytest.fixture(scope="session")
def kept(capture_folder, tmp_path_factory):
    """The folder of a run of surfels on the plane."""
    return keep_run(tmp_path_factory.mktemp("kept"), capture_folder)
