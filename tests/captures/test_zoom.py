"""`split="zoom"`, on photographs whose colors are a function of the ray direction."""

import warnings

import jax
import numpy as np
import pytest
from ray_world import LENS, SIZE, photograph, seen, turned
from tiny_capture import frame, write_image, write_json

from jaxcloseup.captures.load import load_scene


@pytest.fixture
def capture(tmp_path):
    """19 photographs: 3 are held out, and the 1st and 9th of the rest have close-ups."""
    poses = [turned(0.05 * i) for i in range(19)]
    frames = [
        frame(f"images/{i:02d}.png", **LENS, transform_matrix=pose.tolist())
        for i, pose in enumerate(poses)
    ]
    for entry, pose in zip(frames, poses, strict=True):
        write_image(tmp_path / entry["file_path"], photograph(pose))
    write_json(tmp_path / "transforms.json", frames)
    return tmp_path


@pytest.mark.parametrize("zoom", [2, 3, 4])
def test_pixels_match_the_colors_along_their_rays(capture, zoom):
    """Pixels cover exactly `zoom` x `zoom` smaller ones, even if the sides are not multiples."""
    scene = load_scene(capture, split="zoom", zoom=zoom)
    assert scene.names["test_far"] == ["00", "08", "16"] and len(scene.train) == 16
    assert scene.names["test"] == [f"01_zoom{zoom}", f"10_zoom{zoom}"]
    width, height = SIZE[0] // zoom, SIZE[1] // zoom
    inner = (np.arange(zoom) + 0.5) / zoom - 0.5
    inner = [(x, y) for y in inner for x in inner]
    for views, offsets in ((scene.test, [(0, 0)]), (scene.train, inner), (scene.test_far, inner)):
        assert views.rgb.shape[1:] == (height, width, 3) and (np.asarray(views.weight) == 1).all()
        for index, rgb in enumerate(np.asarray(views.rgb)):
            np.testing.assert_allclose(rgb, seen(views.cameras, index, offsets), atol=1.2)
    train, test = (jax.tree.map(np.asarray, views.cameras) for views in (scene.train, scene.test))
    np.testing.assert_allclose(
        test.intrinsics[:, :2], zoom * train.intrinsics[[0, 8], :2], rtol=1e-6
    )
    np.testing.assert_array_equal(test.camtoworld, train.camtoworld[[0, 8]])
    assert scene.metadata["times_nearer"] == (zoom, zoom)


def test_zoom_multiplies_downscale(capture):
    scene = load_scene(capture, split="zoom", zoom=3, downscale=2)
    offsets = [(x, y) for y in (-0.25, 0.25) for x in (-0.25, 0.25)]
    assert scene.train.rgb.shape[1:] == scene.test.rgb.shape[1:] == (5, 7, 3)
    # 47 x 35 is not a multiple of 2, so downscaling averages 2.04 x 2.06 pixels.
    for index, rgb in enumerate(np.asarray(scene.test.rgb)):
        assert np.abs(rgb - seen(scene.test.cameras, index, offsets)).mean() < 3
    focal = np.asarray(scene.train.cameras.intrinsics)[0, :2]
    np.testing.assert_allclose(
        np.asarray(scene.test.cameras.intrinsics)[0, :2], 3 * focal, rtol=1e-6
    )


def test_each_photograph_is_decoded_once_without_warnings(capture, monkeypatch):
    from jaxcloseup.captures import photo_reading

    read, decode = [], photo_reading.decode_image
    monkeypatch.setenv("XDG_CACHE_HOME", str(capture / "cache"))
    monkeypatch.setattr(
        photo_reading,
        "decode_image",
        lambda path, *a, **k: read.append(path.name) or decode(path, *a, **k),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(capture, split="zoom")
    assert sorted(read) == [f"{i:02d}.png" for i in range(19)]
    assert scene.metadata["files"]["test"][0] == scene.metadata["files"]["train"][0]
    note = scene.metadata["notes"][1]
    assert "16 training photographs shrink 4 times" in note
    assert "every 8th of them, unshrunk, 2 in all, 4 times finer" in note


def test_the_close_up_is_the_crop_with_the_most_weighted_detail(tmp_path):
    rng = np.random.default_rng(0)
    image = np.full((24, 32, 3), 90, np.uint8)
    image[12:18, 8:16] = rng.integers(0, 256, (6, 8, 3))
    image[6:12, 24:32] = rng.integers(60, 120, (6, 8, 3))
    write_image(tmp_path / "images/a.png", image)
    write_json(tmp_path / "transforms.json", [frame("images/a.png")])
    scene = load_scene(tmp_path, split="zoom")
    assert scene.metadata["corners"] == [(8, 12)] and scene.test_far is None
    np.testing.assert_array_equal(scene.test.rgb[0], image[12:18, 8:16])
    mask = np.full((24, 32), 255, np.uint8)
    mask[12:18, 8:16] = 0
    mask[8, 26] = 0
    write_image(tmp_path / "masks/a.png", mask)
    scene = load_scene(tmp_path, split="zoom")
    assert scene.metadata["corners"] == [(24, 6)]
    np.testing.assert_array_equal(scene.test.weight[0] * 255, mask[6:12, 24:32])
