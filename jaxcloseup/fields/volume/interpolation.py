"""Interpolation between the vertices of grids whose features are trained."""

import jax
import jax.numpy as jnp


@jax.custom_vjp
def weighted_rows(table: jax.Array, rows: jax.Array, weights: jax.Array) -> jax.Array:
    """Sum `weights` times the `rows` of a table over the corners of cells.

    On a CPU single numbers are gathered fastest, and whole rows are added up fastest. A loop over
    corners keeps XLA from computing rows and weights anew for each number that it adds: the
    derivative takes half the time of one sum over all corners.

    Args:
      table: `[E, F]` trained features of vertices.
      rows: `[C, L, M]` int32 rows of the C corners, for M positions on each of L grids.
      weights: `[C, L, M]` what each corner weighs.

    Returns:
      `[L, F, M]`.
    """

    def feature(column: jax.Array) -> jax.Array:
        return sum(w * _at(column, r) for r, w in zip(rows, weights, strict=True))

    return jnp.stack([feature(column) for column in table.T], axis=1)


def _at(table: jax.Array, rows: jax.Array) -> jax.Array:
    return table.at[rows].get(mode="promise_in_bounds")


def _forward(
    table: jax.Array, rows: jax.Array, weights: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
    return weighted_rows(table, rows, weights), (table, rows, weights)


def _backward(
    residuals: tuple[jax.Array, jax.Array, jax.Array], cotangent: jax.Array
) -> tuple[jax.Array, None, jax.Array]:
    table, rows, weights = residuals
    cotangent = jnp.moveaxis(cotangent, 1, -1)  # [L, M, F]

    def add_corner(total: jax.Array, corner: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        rows, weights = corner
        each = weights[..., None] * cotangent
        return total.at[rows].add(each, mode="promise_in_bounds"), None

    d_table, _ = jax.lax.scan(add_corner, jnp.zeros_like(table), (rows, weights))
    # Dead code unless someone differentiates positions.
    d_weights = jnp.sum(_at(table, rows) * cotangent[None], axis=-1)
    return d_table, None, d_weights


weighted_rows.defvjp(_forward, _backward)
