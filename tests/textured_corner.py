"""A capture with real features: three textured walls that meet in a corner, seen by a few cameras.

Ray casting in NumPy, so nothing of the package draws what the package checks.
"""

import functools
import json

import cv2
import jax.numpy as jnp
import numpy as np

from jaxcloseup import Camera, Views


WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
COUNT = 12
# Walls are the planes WALLS @ point = OFFSETS, slanted so that no turn by quarters maps one onto
# another.
WALLS = np.array([[1, 0.3, 0], [0, 1, -0.2], [0.2, 0.1, 1]])
OFFSETS = np.array([0.0, -0.3, -0.1])
SMALL, SMALL_LENS = (72, 54), np.array([180.0, 182.0, 36.2, 26.9])  # of `corner_views`
LENS = np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])


@functools.cache
def texture(seed, size=1024):
    """Gray and colored blobs of several sizes, `[S, S, 3]` uint8."""
    rng = np.random.default_rng(seed)
    total = np.zeros((size, size, 3), np.float32)
    for cells in (16, 48, 128, 300):
        noise = rng.normal(size=(cells, cells, 3)).astype(np.float32)
        total += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * total, 0, 255).astype(np.uint8)


def poses(count=COUNT):
    """OpenCV poses `[V, 3, 4]` that look at the corner from places around it."""
    rng = np.random.default_rng(0)
    found = []
    for i in range(count):
        angle = 0.25 + 1.0 * i / count
        eye = 4 * np.array([np.cos(angle), np.sin(angle), 0.45]) + rng.normal(scale=0.15, size=3)
        forward = np.array([0.5, 0.5, 0.4]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.1 * np.sin(7 * i), 0, 1.0])
        right /= np.linalg.norm(right)
        found.append(np.column_stack([right, np.cross(forward, right), forward, eye]))
    return np.stack(found)


def draw(pose, lens=LENS, size=(WIDTH, HEIGHT)):
    """The photograph `[H, W, 3]` uint8 and the world points `[H, W, 3]` that it shows."""
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = np.stack([(columns - lens[2]) / lens[0], (rows - lens[3]) / lens[1]], -1)
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1) @ pose[:, :3].T
    with np.errstate(divide="ignore"):
        depths = (OFFSETS - WALLS @ pose[:, 3]) / (rays @ WALLS.T)
    depths = np.where(depths > 0, depths, np.inf)
    wall, depth = depths.argmin(-1), depths.min(-1)
    points = pose[:, 3] + rays * depth[..., None]
    image = np.zeros((size[1], size[0], 3), np.uint8)
    for axis in range(3):
        across = np.delete(points, axis, axis=-1)
        seen = np.where((wall == axis)[..., None], across, 0)
        u, v = np.moveaxis(150 * (seen % 6), -1, 0).astype(np.float32)
        painted = cv2.remap(texture(axis), u, v, cv2.INTER_LINEAR)
        image[wall == axis] = painted[wall == axis]
    return image, points


def corner_views(count=5):
    """Photographs of three walls in a corner, and their exact points `[V, H, W, 3]`."""
    width, height = SMALL
    chosen = poses(12)[1::2][:count]
    images, points = [], []
    for pose in chosen:  # three rays across a pixel, so that nothing aliases
        image, world = draw(pose, 3 * SMALL_LENS, (3 * width, 3 * height))
        images.append(image.reshape(height, 3, width, 3, 3).mean((1, 3)).round().astype(np.uint8))
        points.append(world[1::3, 1::3])
    cameras = Camera(
        *(jnp.asarray(array, jnp.float32) for array in (chosen, np.tile(SMALL_LENS, (count, 1)))),
        height,
        width,
    )
    rgb = jnp.asarray(np.stack(images))
    return Views(cameras, rgb, jnp.ones(rgb.shape[:3])), np.stack(points)


def write_corner(folder, cameras=None, **fields):
    """Write the capture as `transforms.json` with its points, and return its fields."""
    (folder / "images").mkdir(parents=True)
    frames, points = [], []
    for i, pose in enumerate(poses() if cameras is None else cameras):
        image, world = draw(pose)
        name = f"images/{i:02d}.png"
        cv2.imwrite(str(folder / name), image[..., ::-1])
        matrix = np.eye(4)
        matrix[:3] = pose * [1, -1, -1, 1]
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
        points.append(world[7::24, 5::24].reshape(-1, 3))
    points = np.concatenate(points)
    lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), LENS.tolist(), strict=True))
    written = lens | {"near": 1.0, "far": 20.0} | fields | {"frames": frames}
    (folder / "transforms.json").write_text(json.dumps(written))
    write_points(folder, points)
    return written


def write_points(folder, points):
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    header += [*(f"property double {axis}" for axis in "xyz"), "end_header"]
    rows = [" ".join(f"{value:.9g}" for value in point) for point in points]
    (folder / "points3d.ply").write_text("\n".join([*header, *rows, ""]))


def project(points, cameras, view):
    """Return the pixels `[N, 2]` of world points in one of several cameras."""
    pose, lens = cameras.camtoworld[view], cameras.intrinsics[view]
    local = (points - pose[:, 3]) @ pose[:, :3]
    return local[:, :2] / local[:, 2:] * lens[:2] + lens[2:]
