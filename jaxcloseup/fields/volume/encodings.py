"""Positional encoding. Arrays are features first, `[features, samples]`, as the networks want."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.numerics import matmul


def positional_encoding(x: jax.Array, num_octaves: int) -> jax.Array:
    """Return x, then sin and cos of 2^k x, k = 0, 1, ... (NeRF, eq. 4, input added, without pi).

    Args:
      x: `[C, M]` coordinates, roughly within [-1, 1].
      num_octaves: number of octaves k; 0 returns `x`.

    Returns:
      `[C * (1 + 2 num_octaves), M]`: x; sin x; cos x; sin 2x; cos 2x; ..., each for C coordinates.
    """
    chex.assert_rank(x, 2)
    if num_octaves == 0:
        return x
    # Phases are in turns: doubling them and dropping whole turns are exact, so the only error left
    # is the rounding of x. One product makes all phases and passes the input through.
    octaves = np.repeat(2.0 ** np.arange(num_octaves), 2)
    factors = np.concatenate([[2 * np.pi], octaves])
    lags = np.concatenate([[0.0], np.tile([0.25, 0.0], num_octaves)])  # sine lags a quarter turn
    phases = matmul(
        jnp.asarray(np.kron(factors[:, None], np.eye(len(x))), x.dtype), x / (2 * np.pi)
    )
    waves = _cos_of_turns(phases - jnp.asarray(np.repeat(lags, len(x))[:, None], x.dtype))
    is_input = np.arange(len(waves)) < len(x)
    return jnp.where(is_input[:, None], phases, waves)


def _cos_of_turns(turns: jax.Array) -> jax.Array:
    """Return cos(2 pi turns) to 1e-7; on a CPU `jnp.cos` is not vectorized: 20 times as slow."""
    # The sine of an angle in [-pi/2, pi/2], by its series up to the 11th power.
    angle = 2 * np.pi * (0.25 - jnp.abs(turns - jnp.round(turns)))
    square = angle * angle
    series = jnp.ones_like(angle)
    for power in (11, 9, 7, 5, 3):
        series = 1 - square * series / (power * (power - 1))
    return angle * series
