"""Loops over the true flags of an array, a chunk at a time; their number may be traced."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp


Carry = TypeVar("Carry")
_WORD = 32  # bits per word


def for_each_hit(hit: jax.Array, count: int, body: Callable[..., Carry], carry: Carry) -> Carry:
    """Fold `body(row[count], column[count], live[count], carry)` over true flags `[N, P]`.

    `jnp.nonzero` would write an index for every flag. Here flags become bits, 32 to a word, and the
    k-th set bit is found in three steps: its row, its word, then its place by bisection.
    """
    bits = jnp.left_shift(jnp.uint32(1), jnp.arange(_WORD, dtype=jnp.uint32))
    words = jnp.where(hit.reshape(len(hit), -1, _WORD), bits, 0)
    words = jnp.sum(words, axis=-1, dtype=jnp.uint32)
    ends_in_row = jnp.cumsum(jax.lax.population_count(words).astype(jnp.int32), axis=-1)
    ends = jnp.cumsum(ends_in_row[:, -1])

    def step(i: jax.Array, carry: Carry) -> Carry:
        rank = i * count + jnp.arange(count, dtype=jnp.int32)
        live = rank < ends[-1]
        row = jnp.minimum(jnp.searchsorted(ends, rank, side="right"), len(hit) - 1)
        rank = rank - (ends[row] - ends_in_row[row, -1])
        word = jnp.sum(ends_in_row[row] <= rank[:, None], axis=-1, dtype=jnp.int32)
        word = jnp.minimum(word, words.shape[1] - 1)
        rank = rank - jnp.where(word > 0, ends_in_row[row, word - 1], 0)
        bit = _nth_set_bit(words[row, word], rank)
        return body(row, word * _WORD + bit, live, carry)

    return jax.lax.fori_loop(0, (ends[-1] + count - 1) // count, step, carry)


def _nth_set_bit(word: jax.Array, rank: jax.Array) -> jax.Array:
    """Return the position of the set bit of a uint32 that has `rank` set bits below it."""
    position = jnp.zeros_like(rank)
    for half in (16, 8, 4, 2, 1):
        low = (word >> position.astype(word.dtype)) & jnp.asarray(2**half - 1, word.dtype)
        below = jax.lax.population_count(low).astype(rank.dtype)
        above = rank >= below
        rank, position = (
            jnp.where(above, rank - below, rank),
            jnp.where(above, position + half, position),
        )
    return position


def for_each_true(flags: jax.Array, count: int, body: Callable[..., Carry], carry: Carry) -> Carry:
    """Fold `body(indices[count], live[count], carry)` over the true flags, in ascending order."""
    indices = jnp.nonzero(flags, size=flags.size, fill_value=0)[0].astype(jnp.int32)
    indices = jnp.pad(indices, (0, count))
    total = jnp.sum(flags, dtype=jnp.int32)

    def step(i: jax.Array, carry: Carry) -> Carry:
        start = i * count
        live = start + jnp.arange(count, dtype=jnp.int32) < total
        return body(jax.lax.dynamic_slice(indices, (start,), (count,)), live, carry)

    return jax.lax.fori_loop(0, (total + count - 1) // count, step, carry)
