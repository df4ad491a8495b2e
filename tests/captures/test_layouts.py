"""The layouts of Blender's and the paper's datasets: photographs match the loaded cameras' rays."""

import warnings

import numpy as np
import pytest
from ray_world import LENS, SIZE, photograph, seen, turned
from tiny_capture import frame, write_image, write_json

from jaxcloseup.captures.load import load_scene
from jaxcloseup.photos.scene import NearFarWarning


def differences(views):
    """Largest difference, in levels of 0 to 255, of each photograph from its expected colors."""
    expected = [seen(views.cameras, i) for i in range(len(views))]
    return np.abs(np.asarray(views.rgb) - expected).max((1, 2, 3))


def test_blender(tmp_path):
    """Blender's files have an angle of view, no suffixes, alpha, and unlisted depth images."""
    angle = 0.9
    focal = SIZE[0] / 2 / np.tan(angle / 2)
    lens = {"fx": focal, "fy": focal, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2}
    for count, split in ((3, "train"), (2, "val"), (1, "test")):
        frames = []
        for i in range(count):
            pose = turned(0.3 * i + 0.01 * len(split))
            opaque = np.full((*SIZE[::-1], 1), 255, np.uint8)
            write_image(
                tmp_path / f"{split}/r_{i}.png",
                np.concatenate([photograph(pose, lens), opaque], -1),
            )
            write_image(tmp_path / f"{split}/r_{i}_depth_0000.png", opaque[..., 0])
            pose = {"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()}
            frames.append({**pose, "rotation": 0.012566370614359171})
        write_json(
            tmp_path / f"transforms_{split}.json", frames, camera_angle_x=angle, near=None, far=None
        )
    with pytest.warns(NearFarWarning, match="no near and far"):
        scene = load_scene(tmp_path)
    assert (len(scene.train), len(scene.test), len(scene.test_far)) == (3, 1, 2)
    for views in (scene.train, scene.test, scene.test_far):
        assert (differences(views) < 1.2).all()
        assert (np.asarray(views.weight) == 1).all()


def test_the_paper(tmp_path):
    """The paper's files have integer pixel centers, a lens per frame, and an ignored video file."""
    for count, split in ((3, "train"), (2, "test")):
        frames = []
        for i in range(count):
            pose, lens = turned(0.3 * i), {**LENS, "fx": LENS["fx"] * (1 + i), "cx": 20.0 + i}
            name = f"{split}/{i:04d}.png"
            write_image(tmp_path / name, photograph(pose, lens, first=0))
            frames.append(frame(name, **lens, transform_matrix=pose.tolist()))
        write_json(tmp_path / f"transforms_{split}.json", frames)
    write_json(tmp_path / "transforms_video.json", [{**frames[0], "file_path": ""}])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(tmp_path, half_pixel=True)
    assert scene.far == 9 * scene.near and scene.test_far is None
    assert (differences(scene.train) < 1.2).all() and (differences(scene.test) < 1.2).all()
    assert (differences(load_scene(tmp_path).test) > 4).all()  # half a pixel off
