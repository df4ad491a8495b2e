"""The mean of several draws of a training step: in one loop, in threads, or over devices.

A draw depends on its keys alone, so the three ways agree up to the order of their sums.
"""

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec


# `(keys, shared) -> tree of arrays` of one draw.
Draw = Callable[[Any, Any], Any]
# The mean of `draw(keys, shared)` over stacked keys.
Spread = Callable[[Draw, Any, Any], Any]


def in_a_loop(draw: Draw, keys: Any, shared: Any) -> Any:
    """Return the mean of `draw(keys, shared)`, one draw after the other in one compiled loop.

    Args:
      draw: function of the keys of one draw and of what all draws share, to a tree of arrays.
      keys: tree of random keys `[D]`, a row for each draw.
      shared: tree of arrays.
    """
    return jax.tree.map(lambda leaf: leaf / _count(keys), _sum(draw, keys, shared))


def in_threads(workers: int) -> Spread:
    """Return a spread that runs up to `workers` draws at once in threads of the host.

    It suits draws that `jax.jit` compiles in parts: XLA uses several cores for large arrays alone,
    and two draws at once keep two cores busier. Not for use inside `jax.jit`.
    """

    def spread(draw: Draw, keys: Any, shared: Any) -> Any:
        each = [jax.tree.map(lambda key, i=i: key[i], keys) for i in range(_count(keys))]
        if workers == 1:
            return _mean([draw(own_keys, shared) for own_keys in each])

        def wait(own_keys: Any) -> Any:
            return jax.block_until_ready(draw(own_keys, shared))

        with ThreadPoolExecutor(workers) as pool:
            return _mean(list(pool.map(wait, each)))

    return spread


def over_devices(mesh: Mesh) -> Spread:
    """Return a spread over the devices of a mesh of one axis, which must divide the draws.

    Every device holds what the draws share, whole.
    """
    (axis,) = mesh.axis_names

    def spread(draw: Draw, keys: Any, shared: Any) -> Any:
        total = jax.shard_map(
            lambda keys, shared: jax.lax.psum(_sum(draw, keys, shared), axis),
            mesh=mesh,
            in_specs=(PartitionSpec(axis), PartitionSpec()),
            out_specs=PartitionSpec(),
            check_vma=False,
        )(keys, shared)
        return jax.tree.map(lambda leaf: leaf / _count(keys), total)

    return spread


def _count(keys: Any) -> int:
    return len(jax.tree.leaves(keys)[0])


def _sum(draw: Draw, keys: Any, shared: Any) -> Any:
    def add(total: Any, keys: Any) -> tuple[Any, None]:
        return jax.tree.map(jnp.add, total, draw(keys, shared)), None

    shapes = jax.eval_shape(draw, jax.tree.map(lambda key: key[0], keys), shared)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.scan(add, zeros, keys)[0]


@jax.jit
def _mean(trees: Sequence[Any]) -> Any:
    total = functools.reduce(functools.partial(jax.tree.map, jnp.add), trees)
    return jax.tree.map(lambda leaf: leaf / len(trees), total)
