"""Time the forward warp of 50 views of 960 x 540 into one virtual close-up.

The suite compares it with a plain NumPy loop, which for each view projects all points, keeps the
nearest at each pixel, and merges the views. It also prints the time to copy the depth maps, which
any method without culling must read.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.timing import interleaved_medians
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, pixels_to_rays
from jaxcloseup.geometry.poses import PoseSettings, sample_closeup_camera
from jaxcloseup.geometry.union_warp import block_sources, union_warp


VIEWS, HEIGHT, WIDTH, FOCAL = 50, 540, 960, 800.0
CHOSEN = 1024
TARGETS = 3


def run() -> None:
    """Print milliseconds, ratios and the copy time."""
    cameras = _cameras()
    depths = jax.lax.map(_depth, cameras)
    rgb = jax.random.randint(jax.random.key(0), (*depths.shape, 3), 0, 256).astype(jnp.uint8)
    points = np.asarray(jax.vmap(pixels_to_points, (0, None, 0))(cameras, _grid(), depths))
    sources = jax.block_until_ready(jax.jit(block_sources)(cameras, depths))
    settings = PoseSettings(jnp.array([2.0, 8.0]), jnp.float32(np.pi / 4), jnp.float32(jnp.inf))
    warp = jax.jit(union_warp)

    print(f"{VIEWS} views of {WIDTH} x {HEIGHT} into one; {TARGETS} random close-ups")
    print(f"view  NumPy loop  {CHOSEN} pixels  all pixels  ratio  ratio for all")
    ratios = []
    for index in range(TARGETS):
        keys = jax.random.split(jax.random.key(index), 3)
        view = jax.random.randint(keys[0], (), 0, VIEWS)
        camera = jax.tree.map(lambda leaf, view=view: leaf[view], cameras)
        camera = sample_closeup_camera(keys[1], camera, depths[view], settings)
        size = jnp.array([[WIDTH, HEIGHT]])
        pixels = jax.random.randint(keys[2], (CHOSEN, 2), 0, size).astype(jnp.float32) + 0.5
        chosen = functools.partial(warp, sources, cameras, rgb, camera, pixels)
        everything = functools.partial(warp, sources, cameras, rgb, camera, _grid())
        loop = functools.partial(_numpy_loop, points, np.asarray(rgb), jax.device_get(camera))
        _check(everything(), loop())
        seconds = interleaved_medians({"loop": loop, "chosen": chosen, "all": everything}, 3)
        ratios.append(seconds["loop"] / seconds["chosen"])
        by_loop, few, many = (1e3 * seconds[name] for name in ("loop", "chosen", "all"))
        print(
            f"{index:>4}  {by_loop:>7.0f} ms  {few:>8.1f} ms  {many:>7.0f} ms"
            f"  {by_loop / few:>5.0f}  {by_loop / many:>13.1f}"
        )
    print(
        f"ratio at {CHOSEN} chosen pixels: median {np.median(ratios):.0f}, least {min(ratios):.0f}"
    )
    copy = interleaved_medians({"copy": functools.partial(jax.jit(lambda x: x + 1), depths)})
    print(
        f"reading and writing all {depths.nbytes / 1e6:.0f} MB of depth once takes "
        f"{copy['copy'] * 1e3:.0f} ms, the least that a method without culling needs"
    )


def _cameras():
    """Return cameras on an arc around a sphere on the ground, inside a large dome."""
    poses = []
    for turn in np.linspace(0, np.pi, VIEWS, endpoint=False):
        position = np.array([3 * np.cos(turn), 3 * np.sin(turn), 1.5 + 0.3 * np.sin(5 * turn)])
        forward = np.array([0, 0, 0.5]) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        poses.append(np.stack([right, down, forward, position], axis=1))
    intrinsics = np.tile([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], (VIEWS, 1))
    poses, intrinsics = (jnp.asarray(array, jnp.float32) for array in (poses, intrinsics))
    return Camera(poses, intrinsics, HEIGHT, WIDTH)


def _depth(camera):
    """Return the exact depth of ground, sphere and dome, whichever is nearest."""
    origins, directions = pixels_to_rays(camera, _grid())
    down = directions[..., 2]
    ground = jnp.where(down < 0, -origins[..., 2] / jnp.where(down < 0, down, -1), jnp.inf)

    def sphere(center, radius, sign):
        offset = origins - jnp.array(center).reshape(1, 1, 3)
        a = jnp.sum(directions**2, axis=-1)
        b = jnp.sum(offset * directions, axis=-1)
        c = jnp.sum(offset**2, axis=-1) - radius**2
        inside = b * b - a * c
        return jnp.where(inside > 0, (-b + sign * jnp.sqrt(jnp.maximum(inside, 0))) / a, jnp.inf)

    ball, dome = sphere([0.0, 0.0, 0.8], 0.8, -1), sphere([0.0, 0.0, 0.0], 8.0, 1)
    return jnp.minimum(jnp.minimum(ground, ball), dome)


def _grid():
    return pixel_grid(HEIGHT, WIDTH)


def _numpy_loop(points, rgb, camera):
    """Warp the views forward one at a time; keep the nearest point at each pixel."""
    fx, fy, cx, cy = camera.intrinsics
    image = np.zeros((HEIGHT * WIDTH, 3), np.uint8)
    depth = np.full(HEIGHT * WIDTH, np.inf, np.float32)
    for view_points, view_rgb in zip(points, rgb, strict=True):
        x, y, z = ((view_points.reshape(-1, 3) - camera.position) @ camera.rotation).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = fx * x / z + cx, fy * y / z + cy
        lands = (z > 0) & (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
        target = v[lands].astype(np.int64) * WIDTH + u[lands].astype(np.int64)
        z, colors = z[lands], view_rgb.reshape(-1, 3)[lands]
        nearest = depth.copy()
        np.minimum.at(nearest, target, z)
        wins = (z == nearest[target]) & (z < depth[target])
        image[target[wins]], depth = colors[wins], nearest
    return image.reshape(HEIGHT, WIDTH, 3), depth.reshape(HEIGHT, WIDTH)


def _check(union, by_loop):
    """Check that both agree except where rounding moves a point across a pixel's edge."""
    image, _ = by_loop
    agree = np.mean(np.all(np.asarray(union.values) == image, axis=-1))
    if agree < 0.99:
        raise AssertionError(f"union_warp and the NumPy loop agree on only {agree:.1%} of pixels")
