"""Render padded photographs without their padding."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera


def render_unpadded(
    render: Callable[..., Rendering], camera: Camera, size: tuple[int, int], *arguments: Any
) -> Rendering:
    """Render what is not padding of a camera's image; padding is 0 in the result.

    Args:
      render: `(camera, *arguments) -> Rendering` of a whole image.
      camera: camera of `[H, W]` pixels, padded at the right and the bottom.
      size: width and height without padding.
      *arguments: further arguments of `render`.

    Returns:
      The rendering `[H, W]`, without `aux` if there is padding.
    """
    width, height = size
    if (width, height) == (camera.width, camera.height):
        return render(camera, *arguments)
    seen = render(camera.replace(width=width, height=height), *arguments)
    border = (0, camera.height - height), (0, camera.width - width)
    images = {name: getattr(seen, name) for name in ("rgb", "depth", "alpha", "normal")}
    padded = {
        name: jnp.pad(image, (*border, *[(0, 0)] * (image.ndim - 2)))
        for name, image in images.items()
        if image is not None
    }
    return seen._replace(**padded, aux=())
