"""Multiresolution hash encoding (Müller et al., "Instant neural graphics primitives", 2022).

Levels of cubic grids, each finer than the last by one factor, hold trained features at their
vertices. A grid with more vertices than a level has entries shares these by a hash.
"""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.fields.volume.config import HashGridConfig
from jaxcloseup.fields.volume.interpolation import weighted_rows
from jaxcloseup.geometry.numerics import matmul


_PRIMES = (1, 2_654_435_761, 805_459_861)  # eq. 4
_INITIAL = 1e-4  # features begin uniform within this of 0
_CORNERS = np.array(list(np.ndindex(2, 2, 2)), np.uint32)  # [8, 3]


def init_hash_grid(key: jax.Array, config: HashGridConfig) -> jax.Array:
    """Initialize the table `[sum of entries, features]`, level after level; `key` is consumed."""
    shape = (sum(config.entries), config.features)
    return jax.random.uniform(key, shape, minval=-_INITIAL, maxval=_INITIAL)


def hash_features(table: jax.Array, config: HashGridConfig, positions: jax.Array) -> jax.Array:
    """Interpolate features of positions between the vertices of their cells on every level.

    Args:
      table: from `init_hash_grid`.
      config: sizes.
      positions: `[3, M]` in [0, 1]; others are taken to the nearest such position.

    Returns:
      `[levels, features, M]`.
    """
    chex.assert_shape(table, (sum(config.entries), config.features))
    chex.assert_shape(positions, (3, None))
    return weighted_rows(table, *grid_rows(config, positions), tuple(config.entries))


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
