"""Render photographs with known poses, run the program on them, and measure errors of poses."""

import json

import cv2
import jax
import numpy as np
import PIL.Image
from absl import flags
from absl.testing import flagsaver

from jaxcloseup.app.cli import process as program
from jaxcloseup.captures.load import load_scene
from jaxcloseup.drawn_scenes import assembly, drawn, planning
from jaxcloseup.drawn_scenes.builtin import SCENES
from jaxcloseup.photos.views import camera_at


WIDTH, HEIGHT, FRAMES, OTHERS = 480, 270, 20, 3
FOCAL = planning.FOCAL * WIDTH / planning.WIDTH
FOCAL_IN_EXIF = 31  # in mm of a frame 36 mm x 24 mm


def photograph(name, poses):
    """Render photographs `[V, H, W, 3]` of a drawn scene in flat light, which needs no baking."""
    world = assembly.build_world(SCENES[name](), lambda *scene: np.ones((len(scene[3]), 4)))
    cameras = drawn._cameras(poses, WIDTH, HEIGHT)
    with jax.numpy_dtype_promotion("standard"):
        rgb = [
            np.asarray(drawn._render_rgb(world, camera_at(cameras, i), samples=2))
            for i in range(len(poses))
        ]
    return np.rint(np.stack(rgb) * 255).astype(np.uint8)


def walk_around(name, count):
    """Return poses `[V, 3, 4]` of a camera that moves around a drawn scene."""
    rig, poses = SCENES[name]().rig, []
    center, distance = np.array(rig.target), np.mean(rig.distance)
    for turn in np.linspace(-1, 1, count):
        azimuth, elevation = np.deg2rad([40 * turn, 25 + 10 * np.sin(4 * turn)])
        away = [np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation)]
        position = center + distance * np.array([*away, np.sin(elevation)])
        target = center + 0.05 * np.array([np.sin(5 * turn), 0, np.cos(7 * turn)])
        poses.append(planning.pose_looking_at(position, target, (0, 0, 0.05 * np.sin(9 * turn))))
    return np.stack(poses)


def errors(solved, true):
    """Return errors of positions over the extent, and of rotations in degrees, after alignment.

    The alignment is a similarity whose rotation fits positions and axes at once (Umeyama 1991),
    because the positions of cameras near a line leave a turn about that line open.

    Args:
      solved: `[V, 3, 4]` poses.
      true: `[V, 3, 4]` poses.
    """
    solved, true = np.asarray(solved, np.float64), np.asarray(true, np.float64)
    a, b = (poses[:, :, 3] - poses[:, :, 3].mean(0) for poses in (solved, true))
    axes = np.einsum("vij,vkj->ik", true[:, :, :3], solved[:, :, :3]) / len(true) / 3
    u, _, v = np.linalg.svd(b.T @ a / np.linalg.norm(a) / np.linalg.norm(b) + axes)
    rotation = u * np.array([1, 1, np.linalg.det(u @ v)]) @ v
    turned = a @ rotation.T
    scale = (turned * b).sum() / (turned**2).sum()
    away = np.linalg.norm(scale * turned - b, axis=1)
    relative = true[:, :, :3].swapaxes(1, 2) @ (rotation @ solved[:, :, :3])
    cosine = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    extent = np.linalg.norm(np.ptp(true[:, :, 3], axis=0))
    return away / extent, np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


def run_process(**given):
    if not flags.FLAGS.is_parsed():
        flags.FLAGS(["process"])
    with flagsaver.flagsaver(compilation_cache="", **given):
        program.main(["process"])


def poses_by_name(folder):
    """Load a capture; return the scene, and its poses by name without ending."""
    scene = load_scene(folder)
    named = {}
    for split, names in scene.names.items():
        poses = np.asarray(getattr(scene, split).cameras.camtoworld)
        named |= dict(zip(names, poses, strict=True))
    return scene, named


def summary_of(folder):
    return json.loads((folder / "process.json").read_text())["summary"]


def save(path, rgb, *, turned=False):
    """Write a photograph with a focal length in EXIF; turned, it is stored sideways."""
    image = PIL.Image.fromarray(np.rot90(rgb) if turned else rgb)  # counterclockwise
    exif = image.getexif()
    exif[0x0112] = 6 if turned else 1  # to be shown turned by 90 degrees clockwise
    exif.get_ifd(0x8769)[0xA405] = FOCAL_IN_EXIF
    image.save(path, quality=97, subsampling=0, exif=exif)


def write_noise(folder, count):
    """Small photographs without anything in common."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for i in range(count):
        picture = rng.integers(0, 255, (60, 80, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{i}.png"), picture)
