"""Strict numerics for every test, and where the shared reference data lies, if it is here."""

import pathlib

import jax
import pytest
from tiny_runs import write_plane


jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

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


@pytest.fixture(scope="session")
def capture_folder(tmp_path_factory):
    """The plane as photographs in the paper's layout."""
    return write_plane(tmp_path_factory.mktemp("plane"))
