"""Arithmetic that stays finite, in values and in gradients, where the plain form does not."""

import jax
import jax.numpy as jnp


def safe_divide(numerator: jax.Array, denominator: jax.Array, *, fill: float = 0.0) -> jax.Array:
    """Divide; where the denominator is 0, the result is `fill` and its gradient 0."""
    zero = denominator == 0
    # The inner `where` keeps the unused branch finite: reverse mode would turn its inf into NaN.
    return jnp.where(zero, fill, numerator / jnp.where(zero, 1, denominator))


def safe_norm(x: jax.Array, *, axis: int = -1, keepdims: bool = False) -> jax.Array:
    """Return the Euclidean norm along `axis`; its gradient at the zero vector is zero, not NaN."""
    squared = jnp.sum(x * x, axis=axis, keepdims=keepdims)
    zero = squared == 0
    return jnp.where(zero, 0, jnp.sqrt(jnp.where(zero, 1, squared)))


def matmul(a: jax.Array, b: jax.Array) -> jax.Array:
    """Multiply matrices in full precision; accelerators would otherwise round geometry's inputs."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)
