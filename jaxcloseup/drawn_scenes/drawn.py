"""Load the built-in scenes: far photographs, close-up test views, and the exact surface.

A scene's name determines everything: cameras are planned on the exact geometry with fixed seeds, at
full size, and scaled afterwards. Drawing a full-size capture takes minutes, so photographs are
cached on disk under a key that covers the source files that draw them.
"""

import functools
import math
import pathlib
import warnings
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.drawn_scenes import shading
from jaxcloseup.drawn_scenes.assembly import build_world
from jaxcloseup.drawn_scenes.builtin import SCENES
from jaxcloseup.drawn_scenes.lighting import bake_light
from jaxcloseup.drawn_scenes.planning import (
    FOCAL,
    HEIGHT,
    WIDTH,
    grid_rays,
    plan_closeups,
    plan_far,
)
from jaxcloseup.drawn_scenes.raycast import cast_rays
from jaxcloseup.drawn_scenes.threaded_map import map_in_threads
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.io.cache import Stored, cache_path, cached, hash_files
from jaxcloseup.photos.scene import Scene, Surface
from jaxcloseup.photos.views import Photograph, Views, camera_at, unpadded


DRAWN_SCENES: tuple[str, ...] = tuple(SCENES)
NUM_TEST, NUM_FAR = 12, 8
_SAMPLES = 8  # rays per pixel
_SOURCES = ("*.py", "builtin/*.py", "textures/*.py")  # any change may change the pixels


def draw_scene(name: str, *, downscale: int = 1) -> Scene:
    """Draw a built-in scene, or load it from the cache, with its exact surface at any pose.

    World units are meters and z is up. Full size is 960 x 540; sizes round up, and focal lengths
    scale with the exact ratio.

    Args:
      name: one of `DRAWN_SCENES`.
      downscale: positive integer divisor of the image size.

    Raises:
      ValueError: the name is unknown, or `downscale` is not a positive integer.
    """
    if name not in SCENES:
        raise ValueError(f"no built-in scene {name!r}: choose one of {', '.join(DRAWN_SCENES)}")
    if downscale < 1 or downscale != int(downscale):
        raise ValueError(f"downscale must be a positive integer, got {downscale}")
    width, height = -(-WIDTH // downscale), -(-HEIGHT // downscale)
    capture = _cached(f"{name}-{width}x{height}", lambda: _capture(name, width, height))
    splits = {}
    for split in ("train", "test", "test_far"):
        rgb = jnp.asarray(capture[f"{split}_rgb"])
        cameras = _cameras(capture[f"{split}_poses"], width, height)
        splits[split] = Views(cameras, rgb, jnp.ones(rgb.shape[:3], jnp.float32))

    def surface(camera: Camera) -> Surface:
        return _render_surface(_world(name), camera)

    def photographs_at(factor: int, split: str = "train") -> list[Photograph]:
        return unpadded(getattr(draw_scene(name, downscale=factor), split))

    return Scene(
        name=name,
        train=splits["train"],
        test=splits["test"],
        test_far=splits["test_far"],
        points=capture["points"],
        rgb=capture["colors"],
        near=float(capture["near"]),
        far=float(capture["far"]),
        names={
            split: [f"{split}_{i:03d}" for i in range(len(views))]
            for split, views in splits.items()
        },
        metadata={
            "downscale": downscale,
            "own_sizes": {split: [(WIDTH, HEIGHT)] * len(views) for split, views in splits.items()},
            "magnification": capture["magnification"].tolist(),
            "subjects": capture["subjects"].tolist(),
        },
        surface=surface,
        photographs_at=photographs_at,
    )


_render_surface = jax.jit(shading.render_surface, static_argnames="samples")
_render_rgb = jax.jit(shading.render_rgb, static_argnames="samples")


@functools.lru_cache(maxsize=2)
def _world(name: str) -> shading.World:
    model = SCENES[name]()

    def bake(*scene: Any) -> np.ndarray:
        return _cached(f"{name}-light", lambda: {"light": bake_light(*scene)})["light"]

    # The first call may come from inside a trace, whose arrays must not be cached.
    with jax.ensure_compile_time_eval():
        return build_world(model, bake)


def _rng(name: str, stream: int) -> np.random.Generator:
    return np.random.default_rng([zlib.crc32(name.encode()), stream])


def _cameras(poses: np.ndarray, width: int, height: int) -> Camera:
    """Stack the cameras of `poses[V, 3, 4]`."""
    intrinsics = [FOCAL * width / WIDTH, FOCAL * height / HEIGHT, width / 2, height / 2]
    return Camera(
        camtoworld=jnp.asarray(poses, jnp.float32),
        intrinsics=jnp.tile(jnp.asarray(intrinsics, jnp.float32), (len(poses), 1)),
        height=height,
        width=width,
    )


def _cached(stem: str, make: Callable[[], dict[str, np.ndarray]]) -> Mapping[str, np.ndarray]:
    """Return `make()`, or its result from the cache if the same sources made it before.

    A cache that cannot be read or written only costs time and a warning.
    """
    name = f"{stem}-{_sources_digest()}"
    return cached(
        cache_path(f"{name}.npz"),
        name,
        make,
        pack=Stored,
        unpack=lambda stored: stored.arrays,
        report=warnings.warn,
    )


@functools.cache
def _sources_digest() -> str:
    folder = pathlib.Path(__file__).parent
    return hash_files(file for pattern in _SOURCES for file in sorted(folder.glob(pattern)))[:16]


def _capture(name: str, width: int, height: int) -> dict[str, np.ndarray]:
    """Draw the arrays of a capture that the cache holds."""
    world, rig = _world(name), SCENES[name]().rig
    rng = _rng(name, 0)
    far = plan_far(world.solids, rig, rng, rig.photographs + NUM_FAR)
    held_out = np.s_[2 :: math.ceil(len(far) / NUM_FAR)]  # evenly among the others
    train, test_far = np.delete(far, held_out, axis=0), far[held_out]
    closeups = plan_closeups(world.solids, rig, train, rng, NUM_TEST)

    every = np.concatenate([train, test_far, closeups.poses])
    depths = cast_rays(world.solids, *grid_rays(every, 64, 36)).depth
    capture: dict[str, Any] = {
        "train_poses": train,
        "test_far_poses": test_far,
        "test_poses": closeups.poses,
        "magnification": closeups.magnification,
        "subjects": closeups.subjects,
        "near": 0.8 * depths.min(),
        "far": 1.1 * depths.max(),
    }
    cameras = _cameras(every, width, height)

    def photograph(index: int) -> np.ndarray:
        rgb = _render_rgb(world, camera_at(cameras, index), samples=_SAMPLES)
        return np.round(np.asarray(rgb) * 255).astype(np.uint8)

    photographs = map_in_threads(photograph, range(len(every)))
    for split, stop in (("test", NUM_TEST), ("test_far", NUM_FAR), ("train", len(train))):
        capture[f"{split}_rgb"] = np.stack(photographs[-stop:])
        del photographs[-stop:]
    capture["points"], capture["colors"] = _sparse_points(
        world, train, capture["train_rgb"], _rng(name, 1)
    )
    return capture


def _sparse_points(
    world: shading.World, poses: np.ndarray, rgb: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Sample about 5000 surface points `[P, 3]` at training pixels, with their colors `[P, 3]`."""
    views, height, width = rgb.shape[:3]
    count = 5000 // views * views
    view = np.repeat(np.arange(views), count // views)
    y, x = rng.integers(height, size=count), rng.integers(width, size=count)
    xy = np.stack([((x + 0.5) / width - 0.5) * WIDTH, ((y + 0.5) / height - 0.5) * HEIGHT], -1)
    in_camera = np.column_stack([xy / FOCAL, np.ones(count)])
    directions = np.einsum("pj,pij->pi", in_camera, poses[view, :, :3])
    depth = cast_rays(world.solids, poses[view, :, 3], directions).depth
    found = np.isfinite(depth)
    points = poses[view, :, 3] + np.where(found, depth, 0)[:, None] * directions
    return points[found].astype(np.float32), rgb[view, y, x][found].astype(np.float32) / 255
