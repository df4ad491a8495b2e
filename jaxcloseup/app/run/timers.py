"""The wall time of a run's parts, and of compiling; what parts leave in memory."""

import contextlib
import gc
import time
from collections.abc import Iterator

import jax

from jaxcloseup.app import progress
from jaxcloseup.io.memory import give_back_memory


_COMPILING = tuple(
    f"/jax/core/compile/{part}_duration" for part in ("jaxpr_to_mlir_module", "backend_compile")
)


@contextlib.contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Record under `name` how long the body takes, which is a part of the run."""
    start = time.perf_counter()
    with progress.part(name):
        yield
    seconds[name] = time.perf_counter() - start
    give_back_memory()


@contextlib.contextmanager
def timed_compiling(seconds: dict[str, float]) -> Iterator[None]:
    """Record under "compile" how much of the body's time, in whatever thread, goes to XLA."""
    seconds["compile"] = 0.0

    def add(event: str, duration_secs: float, **_: str | int) -> None:
        if event in _COMPILING:
            seconds["compile"] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(add)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(add)


def forget_compiled() -> None:
    """Drop the programs of the parts before: a gigabyte, of which later parts need little again."""
    jax.clear_caches()
    gc.collect()  # what they held through cycles of references
    give_back_memory()
