"""How much splats show in views: the sums of the weights with which their colors are blended."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.geometry.cameras import Camera


_CONSTANT = 0.28209479  # the spherical harmonic of degree 0


def blending_weights(
    field: RadianceField, params: Surfels, buffers: Any, cameras: Camera
) -> jax.Array:
    """Return the weight of each splat, summed over the pixels of whole views, `[N]`.

    A pixel's color is the sum of its splats' colors, each times a weight, so the weights are its
    derivative. All weights together are the views' opacity, summed.

    Args:
      field: a field of splats.
      params: `N` splats.
      buffers: what the field needs beside them.
      cameras: stacked cameras `[V]` of the views.
    """
    # Gray, because colors that are cut at 0 have no derivative.
    gray = jnp.zeros_like(params.sh)

    def shown(sh: jax.Array, camera: Camera) -> jax.Array:
        return jnp.sum(field.render(params.replace(sh=sh), buffers, camera, None, None).rgb[..., 0])

    def add(total: jax.Array, camera: Camera) -> tuple[jax.Array, None]:
        return total + jax.grad(shown)(gray, camera)[:, 0, 0] / _CONSTANT, None

    total, _ = jax.lax.scan(add, jnp.zeros(len(gray), gray.dtype), cameras)
    return total
