"""Presets and a capture on which a whole run takes seconds."""

import dataclasses
import functools
import json

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import plane

from jaxcloseup.app.methods import gaussians, mip_gaussians
from jaxcloseup.app.methods.nerf import QUICK
from jaxcloseup.app.methods.settings import plain_config
from jaxcloseup.app.methods.surfels import REDUCED
from jaxcloseup.app.run.manifest import about_scene, write_manifest
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.captures.load import load_scene
from jaxcloseup.fields.splats import RasterizeConfig
from jaxcloseup.training.config import TrainConfig
from jaxcloseup.training.state import init_state


TINY = dataclasses.replace(
    QUICK,
    field=dataclasses.replace(
        QUICK.field,
        depth=2,
        width=16,
        skip_after=0,
        direction_width=8,
        num_coarse=8,
        num_fine=8,
        chunk=512,
    ),
    train=TrainConfig(num_rays=64, num_label_rays=64),
    baseline_steps=30,
    closeup_steps=3,
    downscale=1,
)
TINY_SURFELS = dataclasses.replace(
    REDUCED,
    field=dataclasses.replace(
        REDUCED.field,
        capacity=600,
        means_lr_steps=20,
        density=None,
        steps_per_target=2,
        raster=RasterizeConfig(capacity=2**14, tile=8, chunk=4, block=12),
    ),
    baseline_steps=20,
    closeup_steps=2,
    downscale=1,
)
TINY_MIP = mip_gaussians.with_filters(gaussians.of_gaussians(TINY_SURFELS))
KEPT = dataclasses.replace(TINY_SURFELS, gated=False)
HALF = 1.4  # the surfels of a kept run reach so far from the middle of the plane
OPENGL = np.diag([1.0, -1, -1])


def write_plane(folder):
    """Write photographs of the plane in the paper's layout."""
    splits = {
        "train": [plane.camera_above(x, 0.1 * x, 4.0, tilt=0.1 * x) for x in (-1, -0.5, 0, 0.5, 1)],
        "test": [plane.camera_above(0.2, 0.1, 1.5, tilt=0.3)],
        "test_far": [plane.camera_above(0.3, 0.0, 4.0)],
    }
    for split, cameras in splits.items():
        (folder / split).mkdir()
        frames = []
        for i, camera in enumerate(cameras):
            rgb, _, _ = plane.photograph(camera)
            name = f"{split}/{i}.png"
            cv2.imwrite(str(folder / name), np.rint(rgb[..., ::-1] * 255).astype(np.uint8))
            pose = np.eye(4)
            pose[:3] = camera.camtoworld
            pose[:3, :3] = pose[:3, :3] @ OPENGL
            fx, fy, cx, cy = map(float, camera.intrinsics)
            intrinsics = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
            frames.append({"file_path": name, "transform_matrix": pose.tolist()} | intrinsics)
        text = json.dumps({"near": 1.0, "far": 8.0, "frames": frames})
        (folder / f"transforms_{split}.json").write_text(text)
    return folder


@functools.cache
def programs_of(preset, capture_folder):
    """Programs on the plane, which all tests of a process share once they are compiled."""
    return Programs(preset, load_scene(str(capture_folder)))


def keep_run(folder, capture_folder):
    """Write the folder of a run that was interrupted after its closeup; surfels cover the plane."""
    with jax.numpy_dtype_promotion("standard"):
        programs = programs_of(KEPT, capture_folder)
        scene, bound = programs.scene, {"field": programs.field, "optimizer": programs.optimizer}
        side = np.linspace(-HALF, HALF, 24)
        points = np.stack([*np.meshgrid(side, side), np.zeros((24, 24))], -1).reshape(-1, 3)
        placed = scene.placement.to_scene(points)
        data = (jnp.asarray(x, jnp.float32) for x in (placed, plane.texture(points)))
        state = init_state(jax.random.key(0), *data, **bound)
        flat = {
            "opacity_logits": jnp.full_like(state.params.opacity_logits, 3.0),
            "quaternions": jnp.zeros_like(state.params.quaternions).at[:, 0].set(1),
        }
        state = state.replace(params=state.params.replace(**flat))
    write_manifest(folder, about_scene(scene, {"downscale": 1}) | {"seed": 0})
    size = [plane.WIDTH, plane.HEIGHT]
    identity = {"scene": scene.name, "config": plain_config(KEPT), "resolution": size, "seed": 0}
    checkpoints = Checkpoints(folder / "checkpoints", identity | {"version": "1"})
    for stage in ("baseline", "closeup"):
        checkpoints.save(stage, 3, state, {"history": [], "growth": 1})
    return folder


def path_file(folder, **changes):
    """Write a camera path of two cameras; a change to None leaves the field out."""
    pose = np.eye(4)
    pose[:3] = plane.camera_above(0.3, 0.1, 2.0, tilt=0.2).camtoworld
    pose[:3, 1:3] *= -1  # OpenCV to OpenGL
    entry = {"camera_to_world": pose.ravel().tolist(), "fov": 40, "aspect": 4 / 3}
    fields = {
        "camera_type": "perspective",
        "render_height": 24,
        "render_width": 32,
        "camera_path": [entry, entry | {"fov": 20.0}],
        "fps": 24,
        "seconds": 2.0,
    }
    for key, value in changes.items():
        target = fields if key in fields else fields["camera_path"][1]
        target.pop(key) if value is None else target.update({key: value})
    file = folder / "path.json"
    file.write_text(json.dumps(fields))
    return file


def copy_of(kept, folder, name, change):
    """Write a run without states whose file `name` is changed."""
    (folder / "checkpoints" / "closeup" / "3").mkdir(parents=True)
    for file in ("manifest.json", "checkpoints/run.json"):
        fields = json.loads((kept / file).read_text())
        if file == name:
            fields = change(fields)
        (folder / file).write_text(fields if isinstance(fields, str) else json.dumps(fields))
    return str(folder)
