"""Label a close-up from several photographs: choose its source, warp, and keep what agrees.

Output:

    source: photograph 1
    labels: 33% of the close-up, wrong by 0.001 on average
"""

import jax
import jax.numpy as jnp

from jaxcloseup import Camera, LabelConfig, Views, best_source, make_label, pseudo_settings
from jaxcloseup.geometry import pixel_grid, pixels_to_points


HEIGHT, WIDTH = 48, 64


def camera_at(x, distance):
    """Return a camera in front of a wall at z = 0."""
    position, target = jnp.array([x, 0.0, -distance]), jnp.array([x, 0.0, 0.0])
    return Camera.look_at(position, target, 0.8, height=HEIGHT, width=WIDTH, up=(0.0, -1.0, 0.0))


def photograph(camera):
    """Return colors and z-depths of the wall."""
    depth = jnp.full((HEIGHT, WIDTH), -camera.position[2])
    points = pixels_to_points(camera, pixel_grid(HEIGHT, WIDTH), depth)
    x, y = points[..., 0], points[..., 1]
    return 0.5 + 0.4 * jnp.sin(jnp.stack([8 * x, 9 * y, 6 * (x + y)], axis=-1)), depth


def main():
    """Label one close-up from five photographs."""
    cameras = jax.vmap(camera_at, (0, None))(jnp.linspace(-0.8, 0.8, 5), 2.0)
    rgb, depths = jax.vmap(photograph)(cameras)
    views = Views(cameras, rgb, jnp.ones(depths.shape))
    closeup = camera_at(0.1, 0.8)
    truth, depth = photograph(closeup)  # a radiance field would render this depth

    settings = pseudo_settings(LabelConfig(rgb_tolerance=0.1, depth_tolerance=0.05))
    source = best_source(closeup, views, depths, depth=depth)
    label = make_label(closeup, pixel_grid(HEIGHT, WIDTH), depth, source, views, depths, settings)
    error = jnp.mean(jnp.abs(label.rgb - truth), where=label.weight[..., None] > 0)
    print(f"source: photograph {source}")
    print(f"labels: {label.weight.mean():.0%} of the close-up, wrong by {error:.3f} on average")


if __name__ == "__main__":
    main()
