"""Light that colors of sRGB encode, relative to what white encodes."""

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


def change_exposure(rgb: jax.Array, gain: jax.Array) -> jax.Array:
    """Return float colors `[..., 3]` with `gain` times their light; it has as many axes."""
    return to_colors(to_light(rgb) * gain)
