"""Add the detail of photographs to a render of a model that learned too little.

The model is a wall at z = 0 without its stripes.

Output:

    render: wrong by 0.10 on average
    with detail: wrong by 0.01 on average
"""

import jax
import jax.numpy as jnp

from jaxcloseup import Camera, Rendering, Views
from jaxcloseup.detail import add_to_rendering, known_weights, make_detail
from jaxcloseup.geometry import pixel_grid, pixels_to_rays
from jaxcloseup.photos import photograph_pyramid


HEIGHT, WIDTH = 48, 64


def camera_at(x, distance):
    """Return a camera in front of the wall."""
    position, target = jnp.array([x, 0, -distance]), jnp.array([x, 0, 0])
    return Camera.look_at(position, target, 0.8, height=HEIGHT, width=WIDTH, up=(0, -1, 0))


def wall(camera, fine):
    """Return colors and z-depths of the wall, whose stripes have a share `fine` of contrast."""
    origins, directions = pixels_to_rays(camera, pixel_grid(camera.height, camera.width))
    depth = -origins[..., 2] / directions[..., 2]
    x, y, _ = jnp.moveaxis(origins + depth[..., None] * directions, -1, 0)
    coarse = 0.5 + 0.2 * jnp.sin(jnp.stack([2 * x, 3 * y, x + y], axis=-1))
    return coarse + fine * 0.15 * jnp.sin(12 * (x + y))[..., None], depth


def render(camera):
    """Render the model: the right depth, without the stripes."""
    rgb, depth = wall(camera, fine=0.0)
    return Rendering(rgb, depth, jnp.ones_like(depth))


def main():
    """Compare a close-up of the model, without and with detail, with the truth."""
    cameras = jax.vmap(camera_at, (0, None))(jnp.linspace(-0.5, 0.5, 7), 2.0)
    rgb, depths = jax.vmap(wall, (0, None))(cameras, 1.0)
    views = Views(cameras, jnp.round(255 * rgb).astype(jnp.uint8), jnp.ones(depths.shape))
    detail = make_detail(render, views, photograph_pyramid(views), known_weights())

    closeup = camera_at(0.1, 1.0)
    (truth, _), rendering = wall(closeup, 1.0), render(closeup)
    sharper = add_to_rendering(detail, closeup, rendering)
    for name, rgb in (("render", rendering.rgb), ("with detail", sharper.rgb)):
        print(f"{name}: wrong by {jnp.mean(jnp.abs(rgb - truth)):.2f} on average")


if __name__ == "__main__":
    main()
