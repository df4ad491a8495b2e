"""Multiresolution hash encoding (Müller et al., "Instant neural graphics primitives", 2022).

Levels of cubic grids, each finer than the last by one factor, hold trained features at their
vertices. A grid with more vertices than a level has entries shares these by a hash.
"""

import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.fields.volume.config import HashGridConfig
from jaxcloseup.fields.volume.interpolation import weighted_rows
from jaxcloseup.geometry.numerics import matmul
from jaxcloseup.native import library


_PRIMES = (1, 2_654_435_761, 805_459_861)  # eq. 4
_INITIAL = 1e-4  # features begin uniform within this of 0
_CORNERS = np.array(list(np.ndindex(2, 2, 2)), np.uint32)  # [8, 3]


def init_hash_grid(key: jax.Array, config: HashGridConfig) -> jax.Array:
    """Initialize the table `[sum of entries, features]`, level after level; `key` is consumed."""
    shape = (sum(config.entries), config.features)
    return jax.random.uniform(key, shape, minval=-_INITIAL, maxval=_INITIAL)


def hash_features(
    table: jax.Array, config: HashGridConfig, positions: jax.Array, *, native: bool | None = None
) -> jax.Array:
    """Interpolate features of positions between the vertices of their cells on every level.

    Args:
      table: from `init_hash_grid`.
      config: sizes.
      positions: `[3, M]` in [0, 1]; others are taken to the nearest such position.
      native: whether to call the native library; None: where it is there and a program is
        compiled for CPUs. Its derivative by the table has no further derivative; that of JAX has.

    Returns:
      `[levels, features, M]`.

    Raises:
      LibraryError: the library is to be called, and is not there.
    """
    chex.assert_shape(table, (sum(config.entries), config.features))
    chex.assert_shape(positions, (3, None))
    if native is None:
        single = table.dtype == positions.dtype == jnp.float32
        if not (single and library.available()):
            return _in_jax(config, table, positions)
        return jax.lax.platform_dependent(
            table,
            positions,
            cpu=functools.partial(_in_library, config),
            default=functools.partial(_in_jax, config),
        )
    if native:
        library.require("native=True", "leave it out")
    return (_in_library if native else _in_jax)(config, table, positions)


def _in_jax(config: HashGridConfig, table: jax.Array, positions: jax.Array) -> jax.Array:
    return weighted_rows(table, *grid_rows(config, positions))


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _in_library(config: HashGridConfig, table: jax.Array, positions: jax.Array) -> jax.Array:
    shape = (config.levels, config.features, positions.shape[1])
    return _call("hash_forward", shape, config, table, positions)


def _forward(
    config: HashGridConfig, table: jax.Array, positions: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return _in_library(config, table, positions), (table, positions)


def _backward(
    config: HashGridConfig, residuals: tuple[jax.Array, jax.Array], cotangent: jax.Array
) -> tuple[jax.Array, jax.Array]:
    table, positions = residuals
    d_table = _call("hash_backward", table.shape, config, positions, cotangent)
    # Dead code unless someone differentiates positions.
    _, pull = jax.vjp(functools.partial(_in_jax, config, table), positions)
    return d_table, *pull(cotangent)


_in_library.defvjp(_forward, _backward)


def _call(
    name: str, shape: tuple[int, ...], config: HashGridConfig, *arrays: jax.Array
) -> jax.Array:
    result = jax.ShapeDtypeStruct(shape, jnp.float32)
    return jax.ffi.ffi_call(f"jaxcloseup_{name}", result, vmap_method="sequential")(
        *arrays,
        cells=np.array(config.resolutions, np.int64),
        rows=np.array(config.entries, np.int64),
    )


def grid_rows(config: HashGridConfig, positions: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return rows of the table at the 8 corners of each position's cells, and trilinear weights.

    Args:
      config: sizes.
      positions: `[3, M]`, see `hash_features`.

    Returns:
      `[8, L, M]` int32 and weights of the positions' type; the last coordinate of a corner changes
      first.
    """

    def by_level(values: Any, dtype: Any) -> Any:
        return np.array(values, dtype)[None, :, None]  # [1, L, 1]

    cells = by_level(config.resolutions, positions.dtype)
    # A product of matrices, since XLA fuses anything else into what follows, and then computes each
    # position anew for every corner of every level.
    product = np.kron(np.eye(3), np.array(config.resolutions)[:, None])
    scaled = matmul(jnp.asarray(product, positions.dtype), jnp.clip(positions, 0, 1))
    scaled = scaled.reshape(3, config.levels, -1)
    low = jnp.clip(jnp.floor(scaled), 0, cells - 1)
    inside = scaled - low
    corners = _CORNERS.T[:, :, None, None]  # [3, 8, 1, 1]
    x, y, z = low.astype(jnp.uint32)[:, None] + corners  # [8, L, M]
    side = by_level(config.resolutions, np.uint32) + np.uint32(1)
    in_order = x + side * (y + side * z)
    hashed = (x * np.uint32(_PRIMES[0])) ^ (y * np.uint32(_PRIMES[1])) ^ (z * np.uint32(_PRIMES[2]))
    hashed &= np.uint32(2**config.log2_entries - 1)
    fits = by_level([(n + 1) ** 3 <= 2**config.log2_entries for n in config.resolutions], bool)
    starts = by_level(np.cumsum([0, *config.entries[:-1]]), np.uint32)
    rows = starts + jnp.where(fits, in_order, hashed)
    shares = jnp.where(corners == 1, inside[:, None], 1 - inside[:, None])  # [3, 8, L, M]
    return rows.astype(jnp.int32), shares[0] * shares[1] * shares[2]
