"""Profile a training step of Instant-NGP: its encodings, natively and in JAX, and the optimizer.

A step has the rays and the sizes of the preset `quick`. What is no row of the table, the networks,
compositing and the sorting of proposals, is the rest of the step.
"""

import functools
from collections.abc import Callable
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import optax

from experiments.benchmarks.nerf import CAMERA, compiled
from experiments.benchmarks.timing import interleaved_medians
from jaxcloseup.app.methods.ngp import QUICK
from jaxcloseup.fields.volume import hash_grid
from jaxcloseup.fields.volume.config import HashGridConfig
from jaxcloseup.fields.volume.ngp import ngp_field
from jaxcloseup.fields.volume.rays import Extent
from jaxcloseup.native import library
from jaxcloseup.photos.views import Views
from jaxcloseup.training.state import TrainState, init_state
from jaxcloseup.training.steps import run_steps, train_step


CONFIG, RAYS = QUICK.field, QUICK.train.num_rays
EXTENT, STEPS = Extent(0.5, 4.0), 10
REACH = 0.5  # length of the rays, in the grid's cube of side 1


def run() -> None:
    """Print milliseconds of a step and of its parts, in JAX and natively, with their ratios."""
    if reason := library.missing():
        print(f"{reason}: {library.INSTALL}")
        return
    calls = {}
    for kind in ("JAX", "native"):
        with mock.patch.object(library, "available", return_value=kind == "native"):
            calls[f"{STEPS} steps {kind}"] = _steps()
        for name, grid, samples in (
            ("rendered grid", CONFIG.grid, CONFIG.num_fine),
            ("proposals' grid", CONFIG.proposal, CONFIG.num_coarse),
        ):
            forward, backward = _encodings(grid, samples, native=kind == "native")
            calls[f"{name}, forward {kind}"], calls[f"{name}, backward {kind}"] = forward, backward
    calls["Adam JAX"] = calls["Adam native"] = _adam()
    seconds = interleaved_medians(calls, repeats=15)
    print(f"\nInstant-NGP, {RAYS} rays, milliseconds{'JAX':>12}{'native':>10}{'ratio':>8}")
    for name in [name.removesuffix(" JAX") for name in calls if name.endswith(" JAX")]:
        in_jax, native = (1e3 * seconds[f"{name} {kind}"] for kind in ("JAX", "native"))
        print(f"{name:38}{in_jax:9.2f}{native:10.2f}{in_jax / native:8.2f}")


def _encodings(grid: HashGridConfig, samples: int, *, native: bool) -> list[Callable[[], Any]]:
    """Return calls of the encoding of positions on rays, and of its derivative by the table."""
    keys = jax.random.split(jax.random.key(0), 4)
    along = jax.random.normal(keys[0], (3, RAYS, 1))
    along *= jnp.linspace(0, REACH, samples) / jnp.linalg.norm(along, axis=0)
    start = jax.random.uniform(keys[1], (3, RAYS, 1))
    positions = jnp.clip(start + along, 0, 1).reshape(3, -1)
    table = hash_grid.init_hash_grid(keys[2], grid)
    cotangent = jax.random.normal(keys[3], (grid.levels, grid.features, positions.shape[1]))

    def forward(table: jax.Array, positions: jax.Array) -> jax.Array:
        return hash_grid.hash_features(table, grid, positions, native=native)

    def backward(table: jax.Array, positions: jax.Array, cotangent: jax.Array) -> Any:
        _, pull = jax.vjp(functools.partial(forward, positions=positions), table)
        return pull(cotangent)

    arrays = table, positions
    return [compiled(forward, *arrays)[0], compiled(backward, *arrays, cotangent)[0]]


def _steps() -> Callable[[], Any]:
    """Return a call of some training steps, as a run takes them."""
    field, optimizer = ngp_field(CONFIG, EXTENT), optax.adam(CONFIG.initial_lr)
    key = jax.random.key(0)
    shape = (8, CAMERA.height, CAMERA.width)
    cameras = jax.tree.map(lambda leaf: jnp.tile(leaf, (8,) + (1,) * leaf.ndim), CAMERA)
    views = Views(cameras, jax.random.uniform(key, (*shape, 3)), jnp.ones(shape))
    nothing = jnp.zeros((1, 3))
    state = init_state(key, nothing, nothing, field=field, optimizer=optimizer)

    def run(state: TrainState, views: Views) -> Any:
        step = functools.partial(
            train_step, field=field, optimizer=optimizer, config=QUICK.train, sequential=True
        )
        return run_steps(lambda state: step(state, views), state, count=STEPS)

    return compiled(run, state, views)[0]


def _adam() -> Callable[[], Any]:
    """Return a call of the optimizer on all parameters."""
    init = jax.jit(ngp_field(CONFIG, EXTENT).init)
    params, _ = init(jax.random.key(0), jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    optimizer = optax.adam(CONFIG.initial_lr)

    def update(params: Any, state: Any, gradient: Any) -> Any:
        updates, state = optimizer.update(gradient, state)
        return optax.apply_updates(params, updates), state

    return compiled(update, params, optimizer.init(params), params)[0]
