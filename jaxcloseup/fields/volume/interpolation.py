"""Interpolation between the vertices of grids whose features are trained."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.native import library


@functools.partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def weighted_rows(
    table: jax.Array,
    rows: jax.Array,
    weights: jax.Array,
    sizes: tuple[int, ...],
    native: bool | None = None,
) -> jax.Array:
    """Sum `weights` times the `rows` of a table over the corners of cells.

    Args:
      table: `[E, F]` trained features of vertices, grid after grid.
      rows: `[C, L, M]` int32 rows of the C corners, for M positions on each of L grids.
      weights: `[C, L, M]` what each corner weighs.
      sizes: rows of each grid, of sum E; `rows` are among those of their grid.
      native: whether to call the native library; None: where it is there and a program is
        compiled for CPUs.

    Returns:
      `[L, F, M]`.
    """
    return _either(native, _sum_natively, _sum_in_jax, (table, rows, weights), sizes)


def _either(
    native: bool | None,
    in_library: Callable[..., jax.Array],
    in_jax: Callable[..., jax.Array],
    arrays: tuple[jax.Array, ...],
    sizes: tuple[int, ...],
) -> jax.Array:
    """Call one of two functions of the same arrays, see `native` of `weighted_rows`."""
    in_library, in_jax = (functools.partial(call, sizes=sizes) for call in (in_library, in_jax))
    single = all(array.dtype in (jnp.float32, jnp.int32) for array in arrays)
    if library.available() and single and native is None:
        return jax.lax.platform_dependent(*arrays, cpu=in_library, default=in_jax)
    return (in_library if native else in_jax)(*arrays)


def _sum_natively(
    table: jax.Array, rows: jax.Array, weights: jax.Array, sizes: tuple[int, ...]
) -> jax.Array:
    _, levels, positions = rows.shape
    shape = jax.ShapeDtypeStruct((levels, table.shape[1], positions), jnp.float32)
    return _call("rows_sum", shape, (table, rows, weights), sizes)


def _sum_in_jax(
    table: jax.Array, rows: jax.Array, weights: jax.Array, sizes: tuple[int, ...]
) -> jax.Array:
    del sizes

    # On a CPU single numbers are gathered fastest.
    def feature(column: jax.Array) -> jax.Array:
        return sum(w * _at(column, r) for r, w in zip(rows, weights, strict=True))

    return jnp.stack([feature(column) for column in table.T], axis=1)


def _at(table: jax.Array, rows: jax.Array) -> jax.Array:
    return table.at[rows].get(mode="promise_in_bounds")


def _forward(
    table: jax.Array,
    rows: jax.Array,
    weights: jax.Array,
    sizes: tuple[int, ...],
    native: bool | None,
) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
    return weighted_rows(table, rows, weights, sizes, native), (table, rows, weights)


def _backward(
    sizes: tuple[int, ...],
    native: bool | None,
    residuals: tuple[jax.Array, jax.Array, jax.Array],
    cotangent: jax.Array,
) -> tuple[jax.Array, None, jax.Array]:
    table, rows, weights = residuals
    arrays = rows, weights, cotangent
    d_table = _either(native, _add_natively, _add_in_jax, arrays, sizes)
    # Dead code unless someone differentiates positions.
    each = _at(table, rows) * jnp.moveaxis(cotangent, 1, -1)[None]
    return d_table, None, jnp.sum(each, axis=-1)


def _add_natively(
    rows: jax.Array, weights: jax.Array, cotangent: jax.Array, sizes: tuple[int, ...]
) -> jax.Array:
    shape = jax.ShapeDtypeStruct((sum(sizes), cotangent.shape[1]), jnp.float32)
    return _call("rows_add", shape, (rows, weights, cotangent), sizes)


def _add_in_jax(
    rows: jax.Array, weights: jax.Array, cotangent: jax.Array, sizes: tuple[int, ...]
) -> jax.Array:
    # On a CPU whole rows are added up fastest. A loop over corners keeps XLA from computing rows
    # and weights anew for each number that it adds: it takes half the time of one sum over all.
    cotangent = jnp.moveaxis(cotangent, 1, -1)  # [L, M, F]

    def add_corner(total: jax.Array, corner: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        rows, weights = corner
        each = weights[..., None] * cotangent
        return total.at[rows].add(each, mode="promise_in_bounds"), None

    zeros = jnp.zeros((sum(sizes), cotangent.shape[-1]), cotangent.dtype)
    return jax.lax.scan(add_corner, zeros, (rows, weights))[0]


def _call(
    name: str, result: jax.ShapeDtypeStruct, arrays: tuple[jax.Array, ...], sizes: tuple[int, ...]
) -> jax.Array:
    function = jax.ffi.ffi_call(f"jaxcloseup_{name}", result, vmap_method="broadcast_all")
    return function(*arrays, of_grids=np.array(sizes, np.int64))


weighted_rows.defvjp(_forward, _backward)
