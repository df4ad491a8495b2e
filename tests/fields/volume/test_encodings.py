"""Positional and hash encodings against slow oracles: values, rows, weights and gradients."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_volume as reference

from jaxcloseup.fields.volume.encodings import positional_encoding
from jaxcloseup.fields.volume.hash_grid import (
    HashGridConfig,
    grid_rows,
    hash_features,
    init_hash_grid,
)
from jaxcloseup.native import library


# The first levels hold all their vertices, the last ones share entries by the hash.
CONFIG = HashGridConfig(levels=4, features=2, log2_entries=9, coarsest=3, finest=40)
EDGES = np.array([[0, 1, 0.5, 1 / 3, -0.2], [0, 1, 0.25, 2 / 3, 1.2], [0, 1, 0.75, 1, 0.5]])


natively = pytest.mark.parametrize(
    "native",
    [
        False,
        pytest.param(
            True, marks=pytest.mark.skipif(not library.available(), reason=str(library.missing()))
        ),
    ],
)


def positions(numbers):
    """Random ones, ones on corners and faces of cells, and ones outside."""
    return np.concatenate([numbers.uniform(0, 1, (3, 12)), EDGES], axis=1)


@functools.cache
def case():
    """A table, positions, and the oracle's features `[L, F, M]` and shares of rows."""
    numbers = np.random.default_rng(0)
    table = numbers.normal(size=(sum(CONFIG.entries), CONFIG.features))
    x = positions(numbers)
    found = [reference.hash_encoding(table, CONFIG, p) for p in x.T]
    return table, x, np.stack([f for f, _ in found], -1), [shares for _, shares in found]


def test_levels_grow_by_one_factor_up_to_the_finest():
    paper = HashGridConfig()
    assert paper.resolutions[0] == 16 and paper.resolutions[-1] == 2048
    expected = [reference.resolution(level, 16, 16, 2048) for level in range(16)]
    assert list(paper.resolutions) == expected
    assert paper.entries[0] == 17**3 and paper.entries[-1] == 2**19
    assert HashGridConfig(levels=1, coarsest=7).resolutions == (7,)


def test_rows_and_weights_are_those_of_the_cells_corners():
    _, x, _, shares = case()
    rows, weights = map(np.asarray, jax.jit(functools.partial(grid_rows, CONFIG))(np.float32(x)))
    assert rows.shape == weights.shape == (8, CONFIG.levels, x.shape[1])
    for point, expected in enumerate(shares):
        ours = {}
        for level in range(CONFIG.levels):
            for row, weight in zip(*(a[:, level, point] for a in (rows, weights)), strict=True):
                ours[level, int(row)] = ours.get((level, int(row)), 0) + float(weight)
        # Rounding may put a point on a face into the cell beside it, with the same features.
        for at in set(ours) | set(expected):
            assert ours.get(at, 0) == pytest.approx(expected.get(at, 0), abs=1e-5)


@natively
def test_features_match_the_oracle(native):
    table, x, expected, _ = case()
    encode = jax.jit(functools.partial(hash_features, config=CONFIG, native=native))
    ours = encode(np.float32(table), positions=np.float32(x))
    np.testing.assert_allclose(ours, expected, atol=1e-5)
    lost = np.asarray(encode(np.float32(table), positions=np.full((3, 1), np.nan, np.float32)))
    assert np.all(np.isnan(lost))


@natively
def test_the_tables_gradient_is_the_sum_of_shares(native):
    table, x, _, shares = case()
    cotangent = np.random.default_rng(1).normal(size=(CONFIG.levels, CONFIG.features, x.shape[1]))
    expected = np.zeros_like(table)
    for point, of_point in enumerate(shares):
        for (level, row), share in of_point.items():
            expected[row] += share * cotangent[level, :, point]

    def total(table):
        features = hash_features(table, CONFIG, np.float32(x), native=native)
        return jnp.sum(np.float32(cotangent) * features)

    ours = jax.jit(jax.grad(total))(np.float32(table))
    np.testing.assert_allclose(ours, expected, atol=1e-5)


@pytest.mark.skipif(not library.available(), reason=str(library.missing()))
@pytest.mark.parametrize("features", [1, 3, 7])
def test_the_library_encodes_several_tables_as_jax_does(features):
    """More positions than a thread takes at once, any number of features, arms, and positions."""
    config = dataclasses.replace(CONFIG, features=features)
    numbers = np.random.default_rng(3)
    tables = numbers.normal(size=(2, sum(config.entries), features)).astype(np.float32)
    x = numbers.uniform(-0.1, 1.1, (3, 1500)).astype(np.float32)
    cotangent = numbers.normal(size=(config.levels, features, 1500)).astype(np.float32)

    @functools.partial(jax.jit, static_argnames="native")
    def both(native):
        def of_arm(table):
            def encode(table, x):
                return hash_features(table, config, x, native=native)

            ours, pull = jax.vjp(encode, table, jnp.asarray(x))
            return ours, *pull(jnp.asarray(cotangent))

        return jax.vmap(of_arm)(jnp.asarray(tables))

    for ours, theirs in zip(both(native=True), both(native=False), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-3)


def test_programs_for_other_processors_and_types_call_no_library():
    table, x, _, _ = case()
    encode = jax.jit(functools.partial(hash_features, config=CONFIG))
    traced = encode.trace(np.float32(table), positions=np.float32(x))
    assert "jaxcloseup_hash" not in traced.lower(lowering_platforms=("cuda",)).as_text()
    called = "jaxcloseup_hash" in traced.lower(lowering_platforms=("cpu",)).as_text()
    assert called == library.available()
    with jax.enable_x64(True):
        assert encode(jnp.asarray(table), positions=jnp.asarray(x)).dtype == jnp.float64


def test_the_gradient_of_positions_is_the_finite_difference():
    table, _, _, _ = case()
    numbers = np.random.default_rng(2)
    with jax.enable_x64(True):
        x, along = (numbers.uniform(0.1, 0.9, (3, 6)) for _ in range(2))
        cotangent = numbers.normal(size=(CONFIG.levels, CONFIG.features, 6))

        @jax.jit
        def total(step):
            features = hash_features(jnp.asarray(table), CONFIG, x + step * along)
            return jnp.sum(cotangent * features)

        slope = jax.jit(jax.grad(total))(0.0)
        np.testing.assert_allclose(slope, (total(1e-7) - total(-1e-7)) / 2e-7, rtol=1e-5)


def test_initial_features_are_small_and_even(key):
    table = np.asarray(init_hash_grid(key, CONFIG))
    assert np.abs(table).max() <= 1e-4
    np.testing.assert_allclose(table.std(), 1e-4 / 3**0.5, rtol=0.05)


@pytest.mark.parametrize("shape", [(3, 7), (2, 1)])
def test_encoding_matches_numpy(key, shape):
    x = jax.random.uniform(key, shape, minval=-1, maxval=1)
    wide = np.asarray(x, np.float64)
    parts = [wide]
    for k in range(10):
        parts += [np.sin(2**k * wide), np.cos(2**k * wide)]
    ours = jax.jit(positional_encoding, static_argnums=1)(x, 10)
    # x is rounded to half of 2^-24, and the highest octave multiplies that by 2^9.
    np.testing.assert_allclose(ours, np.concatenate(parts), atol=5e-5)
    low = 5 * shape[0]  # the input and two octaves
    np.testing.assert_allclose(ours[:low], np.concatenate(parts)[:low], atol=5e-7)


def test_zero_octaves_return_the_input(key):
    x = jax.random.normal(key, (3, 2))
    np.testing.assert_array_equal(positional_encoding(x, 0), x)
