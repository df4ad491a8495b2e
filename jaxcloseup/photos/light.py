"""Light that colors of sRGB, or of a camera with a curve of its own, encode."""

import jax
import jax.numpy as jnp


def to_light(rgb: jax.Array) -> jax.Array:
    """Return the light of float colors; what is below black is black."""
    rgb = jnp.maximum(rgb, 0)
    return jnp.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def to_colors(light: jax.Array) -> jax.Array:
    """Return the float colors of light, which may be more than white's."""
    above = jnp.maximum(light, 0.0031308)  # the root has no derivative at 0
    return jnp.where(light <= 0.0031308, 12.92 * light, 1.055 * above ** (1 / 2.4) - 0.055)


def light_by_curve(rgb: jax.Array, curves: jax.Array, row: int | jax.Array) -> jax.Array:
    """Return the light of float colors by measured curves.

    Args:
      rgb: `[..., 3]` float colors.
      curves: `[C, L]` the light of L colors from black to white.
      row: which curve, one or `[...]`.
    """
    most = curves.shape[-1] - 1
    place = jnp.clip(rgb, 0, 1) * most
    below = jnp.minimum(place.astype(jnp.int32), most - 1)
    share = place - below.astype(place.dtype)
    start = jnp.asarray(row, jnp.int32)[..., None] * (most + 1)
    below = jnp.broadcast_to(start, below.shape) + below
    values = curves.reshape(-1)
    return values[below] * (1 - share) + values[below + 1] * share


def colors_by_curve(light: jax.Array, curve: jax.Array) -> jax.Array:
    """Return the float colors that a curve `[L]` gives to light; white for more than its last."""
    colors = jnp.linspace(0, 1, len(curve), dtype=light.dtype)
    return jnp.interp(light, curve, colors)


def change_exposure(rgb: jax.Array, gain: jax.Array) -> jax.Array:
    """Return float colors `[..., 3]` with `gain` times their light; it has as many axes."""
    return to_colors(to_light(rgb) * gain)
