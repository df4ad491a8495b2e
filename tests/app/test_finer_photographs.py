"""Photographs finer than training reads them: which sizes are read, enlarged and scored."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.run.photograph_sizes import describe_training
from jaxcloseup.app.run.residuals import enlarge
from jaxcloseup.app.score.targets import make_targets, targets_by_split
from jaxcloseup.captures.load import SceneError, load_scene
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.photos.pyramids import scene_pyramid


def test_an_enlarged_render_stays_in_its_place():
    pose = jnp.eye(3, 4)
    coarse = Camera(pose, jnp.array([20.0, 20.5, 15, 12]), 24, 30)
    fine = Camera(pose, jnp.array([61.0, 59.5, 45.5, 36.2]), 72, 91)

    def image(camera):
        x, y = np.moveaxis(np.asarray(pixel_grid(camera.height, camera.width)), -1, 0)
        fx, fy, cx, cy = np.asarray(camera.intrinsics)
        wave = 0.5 + 0.4 * np.sin(4 * (x - cx) / fx) * np.cos(3 * (y - cy) / fy)
        return np.stack([wave, wave**2, 1 - wave], axis=-1).astype(np.float32)

    rgb = enlarge(image(coarse), coarse, fine)
    inner = np.s_[6:-6, 6:-6]
    assert np.abs(rgb - image(fine))[inner].max() < 0.006  # a tenth of a coarse pixel


def test_a_scene_is_read_at_the_finest_size_that_fits(capture_folder):
    scene = load_scene(str(capture_folder), downscale=4)
    assert scene.train.rgb.shape[1:3] == (6, 8)
    pyramid, divisor = scene_pyramid(scene)
    assert divisor == 1 and pyramid.sizes == ((24, 32), (12, 16), (6, 8))
    whole = load_scene(str(capture_folder))
    finest = np.stack([pyramid.image(view, 0) for view in range(len(pyramid))])
    np.testing.assert_array_equal(finest[..., :3], whole.train.rgb)
    np.testing.assert_array_equal(pyramid.intrinsics[:, 0], whole.train.cameras.intrinsics)
    size = 5 * 24 * 32 * 4 * 4 / 3
    assert scene_pyramid(scene, budget=int(size) - 1)[1] == 2
    assert scene_pyramid(scene, budget=int(size / 4) - 1)[1] == 3
    assert scene_pyramid(scene, budget=1)[1] == 4  # what training reads anyway


def test_held_out_parts_of_photographs_are_not_read(capture_folder):
    scene = load_scene(str(capture_folder), split="zoom", zoom=2)
    assert scene.photographs_at is None
    assert scene_pyramid(scene)[0].sizes[0] == scene.train.rgb.shape[1:3]


def test_photographs_hold_no_finer_detail_than_is_read_of_them(capture_folder):
    """Half as large, and a further fourth with the split that holds their own pixels out."""
    scene = load_scene(str(capture_folder), split="zoom", zoom=2, downscale=2)
    flat = lambda camera: SimpleNamespace(depth=jnp.full((camera.height, camera.width), 3.0))  # noqa: E731
    depths = jnp.full(scene.train.weight.shape, 3.0)
    (found, *_) = make_targets(scene, "test", depths, flat)
    camera, whole = found.camera, dataclasses.replace(scene, metadata={**scene.metadata})
    whole.metadata["downscale"] = 1
    assert found.could_resolve == make_targets(whole, "test", depths, flat)[0].could_resolve > 2.5
    finer = dataclasses.replace(scene, photographs_at=lambda *_: [])
    held = make_targets(finer, "test", depths, flat)[0].could_resolve
    assert camera.width == 8 and held == max(2, found.could_resolve / 2)
    preset = METHODS["surfels"].presets["quick"]
    assert "photographs of 8 x 6, 1 / 4 of their size" in describe_training(preset, scene)


def test_views_are_scored_at_their_own_size_only_where_finer_photographs_are_kept(
    capture_folder, capsys
):
    scene = load_scene(str(capture_folder), downscale=4)
    depths = jnp.ones(scene.train.weight.shape)

    def score(scene):
        flat = lambda camera: SimpleNamespace(depth=jnp.ones((camera.height, camera.width)))  # noqa: E731
        targets = targets_by_split(scene, depths, None, flat, divisor=2)
        return {split: views[0].rgb.shape[:2] for split, views in targets.items()}

    sizes = score(scene)
    assert set(sizes.values()) == {(6, 8), (12, 16)}
    assert all(
        sizes[split] == ((6, 8) if split.endswith("_reduced") else (12, 16)) for split in sizes
    )

    def gone(factor, split):
        raise SceneError("images/000.png is not there")

    kept = score(dataclasses.replace(scene, photographs_at=gone))
    assert kept == {split: (6, 8) for split, size in sizes.items() if size == (12, 16)}
    assert "size of training alone: images/000.png is not there" in capsys.readouterr().out
