"""Warp a photograph into a close-up, backward and forward, and keep the pixels where both agree.

Output:

    backward warp: 100% of the close-up
    forward warp: 25% of the close-up
    both agree: 25% of the close-up, wrong by 0.001 on average
"""

import jax.numpy as jnp

from jaxcloseup.geometry import (
    Camera,
    pixel_grid,
    pixels_to_points,
    rgb_consistent,
    warp_forward_to,
    warp_to,
)


HEIGHT, WIDTH = 48, 64


def photograph(camera):
    """Return colors and z-depths of a wall at z = 0, seen by a camera that looks straight at it."""
    depth = jnp.full((camera.height, camera.width), -camera.position[2])
    points = pixels_to_points(camera, pixel_grid(camera.height, camera.width), depth)
    x, y = points[..., 0], points[..., 1]
    return 0.5 + 0.4 * jnp.sin(jnp.stack([8 * x, 9 * y, 6 * (x + y)], axis=-1)), depth


def main():
    """Label a camera that stands half as far from the wall as the photograph's."""
    size = {"height": HEIGHT, "width": WIDTH, "up": (0.0, -1.0, 0.0)}
    far = Camera.look_at((0.0, 0.0, -2.0), (0.0, 0.0, 0.0), 0.8, **size)
    near = Camera.look_at((0.2, 0.0, -1.0), (0.2, 0.0, 0.0), 0.8, **size)
    photo, photo_depth = photograph(far)
    truth, depth = photograph(near)  # a radiance field would render this depth

    backward = warp_to(photo, far, near, depth, source_depth=photo_depth)
    forward = warp_forward_to(photo, far, near, photo_depth)
    agree = rgb_consistent(backward.values, forward.values, 0.05)
    label = backward.hit & forward.hit & agree
    error = jnp.mean(jnp.abs(backward.values - truth), where=label[..., None])
    print(f"backward warp: {backward.hit.mean():.0%} of the close-up")
    print(f"forward warp: {forward.hit.mean():.0%} of the close-up")
    print(f"both agree: {label.mean():.0%} of the close-up, wrong by {error:.3f} on average")


if __name__ == "__main__":
    main()
