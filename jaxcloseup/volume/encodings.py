"""Positional encoding. Arrays here are features first, `[features, ...]`, as the network wants."""

import chex
import jax
import jax.numpy as jnp


def positional_encoding(x: jax.Array, num_octaves: int) -> jax.Array:
    """`x`, then sin and cos of `2^k x` for k = 0, 1, ... (NeRF, eq. 4, with the input, without pi).

    Args:
      x: `[C, ...]` coordinates, roughly within [-1, 1].
      num_octaves: how many k; 0 returns `x`.

    Returns:
      `[C * (1 + 2 num_octaves), ...]`.
    """
    chex.assert_rank(x, {*range(1, 5)})
    if num_octaves == 0:
        return x
    octaves = 2.0 ** jnp.arange(num_octaves, dtype=x.dtype).reshape((-1,) + (1,) * x.ndim)
    angles = octaves * x[None]
    waves = jnp.stack([jnp.sin(angles), jnp.cos(angles)], axis=1)  # [K, 2, C, ...]
    return jnp.concatenate([x, waves.reshape((-1, *x.shape[1:]))])
