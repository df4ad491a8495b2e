"""A simple world with known answers: a textured plane z = 0, photographed from above."""

import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_rays
from jaxcloseup.photos.scene import Scene, Surface
from jaxcloseup.photos.views import Views


HEIGHT, WIDTH, FOCAL = 24, 32, 30.0
STRIPES = 0.3  # their wavelength on the exact surface


def camera_above(x, y, height, *, tilt=0.0):
    """Return a camera that looks down on the plane, its right along +x, turned `tilt` about x."""
    c, s = np.cos(tilt), np.sin(tilt)
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    rotation = down @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    camtoworld = np.concatenate([rotation, [[x], [y], [height]]], axis=1)
    intrinsics = jnp.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])
    return Camera(jnp.asarray(camtoworld, jnp.float32), intrinsics, HEIGHT, WIDTH)


def texture(points):
    """Return smooth colors `[..., 3]` for points `[..., 3]` on the plane."""
    x, y = points[..., 0], points[..., 1]
    return 0.5 + 0.4 * np.stack([np.sin(2 * x), np.cos(3 * y), np.sin(x + 2 * y)], axis=-1)


def photograph(camera):
    """Return colors, depths and points, `[H, W, ...]` in float64, by intersecting each ray."""
    fx, fy, cx, cy = np.asarray(camera.intrinsics, np.float64)
    pose = np.asarray(camera.camtoworld, np.float64)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    directions = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1) @ pose[:, :3].T
    depth = -pose[2, 3] / directions[..., 2]
    points = pose[:, 3] + depth[..., None] * directions
    return texture(points), depth, points


def make_views(cameras):
    """Return `Views` of the plane, and their exact depths `[V, H, W]`."""
    shots = [photograph(camera) for camera in cameras]
    stacked = Camera(
        jnp.stack([camera.camtoworld for camera in cameras]),
        jnp.stack([camera.intrinsics for camera in cameras]),
        HEIGHT,
        WIDTH,
    )
    rgb, depths = (jnp.asarray(np.stack([s[i] for s in shots]), jnp.float32) for i in range(2))
    return Views(stacked, rgb, jnp.ones(depths.shape)), depths


def surface(camera):
    """Return the exact surface of the plane with stripes along y instead of the texture."""
    origins, directions = pixels_to_rays(camera, pixel_grid(camera.height, camera.width))
    depth = -origins[..., 2] / directions[..., 2]
    x = origins[..., 0] + depth * directions[..., 0]
    wave = 0.5 + 0.4 * jnp.sin(2 * jnp.pi * x / STRIPES)
    rgb = jnp.stack([wave] * 3, axis=-1)
    return Surface(rgb, depth, jnp.zeros_like(rgb).at[..., 2].set(1))


def make_scene(cameras, far=()):
    """Return a scene of the plane with its exact surface, and exact depths of its photographs."""
    train, depths = make_views(cameras)
    test_far = make_views(far)[0] if far else None
    names = {"train": [str(i) for i in range(len(cameras))]}
    names |= {"test_far": [f"far{i}" for i in range(len(far))]} if far else {}
    none = np.zeros((0, 3))
    scene = Scene("plane", train, None, test_far, none, none, 0.5, 9.0, names, surface=surface)
    return scene, depths
