"""Sums of rows of a table, natively and in JAX, against float64 and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.fields.volume.interpolation import weighted_rows
from jaxcloseup.native import library


def drawn(features, sizes, corners, positions):
    """Draw a table, rows of its grids, weights, and cotangents of the sums."""
    rng = np.random.default_rng(0)
    starts = np.cumsum([0, *sizes[:-1]])
    rows = [
        start + rng.integers(0, size, (corners, positions))
        for start, size in zip(starts, sizes, strict=True)
    ]
    shape = (corners, len(sizes), positions)
    return (
        rng.normal(size=(sum(sizes), features)).astype(np.float32),
        np.stack(rows, axis=1).astype(np.int32),
        rng.normal(size=shape).astype(np.float32),
        rng.normal(size=(len(sizes), features, positions)).astype(np.float32),
    )


def reference(table, rows, weights, cotangent):
    """Return sums and derivatives by loops in float64."""
    table, weights, cotangent = (x.astype(np.float64) for x in (table, weights, cotangent))
    out, d_table, d_weights = np.zeros_like(cotangent), np.zeros_like(table), 0 * weights
    for corner, level, position in np.ndindex(rows.shape):
        at = corner, level, position
        out[level, :, position] += weights[at] * table[rows[at]]
        d_table[rows[at]] += weights[at] * cotangent[level, :, position]
        d_weights[at] = table[rows[at]] @ cotangent[level, :, position]
    return out, d_table, d_weights


def with_derivatives(table, rows, weights, cotangent, sizes, native):
    def call(table, weights):
        return weighted_rows(table, rows, weights, sizes, native)

    out, pull = jax.vjp(call, jnp.asarray(table), jnp.asarray(weights))
    return out, *pull(jnp.asarray(cotangent))


@pytest.mark.parametrize("native", [True, False, None])
@pytest.mark.parametrize(
    ("features", "sizes", "corners", "positions"),
    # Features by eights, pairs and singly; more positions than a thread takes at once.
    [(2, (5, 7, 100), 8, 33), (13, (9, 9, 9), 4, 17), (1, (1,), 2, 3000), (2, (3,), 8, 0)],
)
def test_rows_are_summed_and_their_derivatives_added(features, sizes, corners, positions, native):
    if native and not library.available():
        pytest.skip(library.missing())
    arrays = drawn(features, sizes, corners, positions)
    found = with_derivatives(*arrays, sizes, native)
    for value, truth in zip(found, reference(*arrays), strict=True):
        np.testing.assert_allclose(value, truth, rtol=1e-5, atol=1e-4)


def test_tables_of_several_arms_are_summed_at_once():
    sizes = (4, 6)
    table, rows, weights, cotangent = drawn(3, sizes, 4, 5)
    tables = np.stack([table, -2 * table])

    def gradient(table):
        return with_derivatives(table, rows, weights, cotangent, sizes, None)[:2]

    out, d_table = jax.vmap(gradient)(tables)
    for arm in range(2):
        truth = reference(tables[arm], rows, weights, cotangent)
        np.testing.assert_allclose(out[arm], truth[0], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(d_table[arm], truth[1], rtol=1e-5, atol=1e-5)


def test_other_processors_and_types_need_no_library():
    """A program for a GPU calls nothing of the library, nor does one in 64 bits."""
    sizes = (4,)
    table, rows, weights, _ = drawn(2, sizes, 8, 5)
    traced = jax.jit(lambda t: weighted_rows(t, rows, weights, sizes)).trace(table)
    assert "jaxcloseup_rows" not in traced.lower(lowering_platforms=("cuda",)).as_text()
    if library.available():
        assert "jaxcloseup_rows" in traced.lower(lowering_platforms=("cpu",)).as_text()
    with jax.enable_x64():
        double = (table.astype(np.float64), rows, weights.astype(np.float64))
        assert weighted_rows(*map(jnp.asarray, double), sizes).dtype == jnp.float64
