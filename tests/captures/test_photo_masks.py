import numpy as np
import pytest
from tiny_capture import (
    HEIGHT,
    POSE,
    WIDTH,
    colmap_capture,
    llff_capture,
    paper_capture,
    single_file,
    write_image,
    write_json,
)

from jaxcloseup.captures.load import load_scene


HALF = np.zeros((HEIGHT, WIDTH), np.uint8)
HALF[:, :3] = 255


def single(folder):
    single_file(folder, 3)
    return folder


def weights(scene):
    """Mean weight of each photograph in all splits, by name."""
    found = {}
    for split, names in scene.names.items():
        views = getattr(scene, split)
        found |= dict(zip(names, np.asarray(views.weight).mean((1, 2)).tolist(), strict=True))
    return found


@pytest.mark.parametrize("make", [single, llff_capture, colmap_capture])
@pytest.mark.parametrize("name", ["{}.png", "{}.JPG", "{}.png.png", "{}.mask.png"])
def test_black_is_ignored_in_every_format(tmp_path, make, name):
    if make is colmap_capture:
        pytest.importorskip("pycolmap")
    make(tmp_path)
    for photograph in (tmp_path / "images").iterdir():
        write_image(tmp_path / "masks" / name.format(photograph.stem), HALF)
    scene = load_scene(tmp_path)
    assert "3 of 3 photographs have a mask" in scene.metadata["notes"][-1]
    np.testing.assert_allclose(list(weights(scene).values()), 3 / 8, atol=0.02)
    np.testing.assert_allclose(scene.train.weight[0, :, :2], 1, atol=0.02)
    assert (np.asarray(scene.train.weight[0, :, 6:]) == 0).all()


def test_some_masks_are_noted(tmp_path, caplog):
    single_file(tmp_path, 3)
    write_image(tmp_path / "masks/001.png", HALF)
    with caplog.at_level("INFO", "jaxcloseup"):
        scene = load_scene(tmp_path)
    assert weights(scene) == pytest.approx({"000": 1, "001": 3 / 8, "002": 1})
    words = "1 of 3 photographs have a mask (white is kept); the others are used whole"
    assert f"{tmp_path.name}: {words}" in caplog.messages


def test_folders_of_photographs_have_folders_of_masks(tmp_path):
    paper_capture(tmp_path)
    write_image(tmp_path / "masks/train/a.png", HALF)
    write_image(tmp_path / "masks/b.png", HALF)
    scene = load_scene(tmp_path)
    np.testing.assert_allclose(scene.train.weight.mean((1, 2)), [3 / 8, 3 / 8])
    np.testing.assert_allclose(scene.test.weight.mean(), 1)


@pytest.mark.parametrize("beside", ["ngp/masks", "masks"])
def test_photographs_outside_the_folder(tmp_path, beside):
    """A photograph is not used as its own mask."""
    write_image(tmp_path / "images/a.png")
    pose = {"file_path": "../images/a.png", "transform_matrix": POSE.tolist(), "fl_x": 9.0}
    write_json(tmp_path / "ngp/transforms.json", [pose])
    write_image(tmp_path / beside / "a.png", HALF)
    assert weights(load_scene(tmp_path / "ngp"))["a"] == pytest.approx(3 / 8)


@pytest.mark.parametrize("given", ["capture", "link"])
def test_absolute_paths_of_photographs(tmp_path, monkeypatch, given):
    """The capture itself may be given by another path, relative or through a link."""
    capture = tmp_path / "capture"
    write_image(capture / "images/left/a.png")
    write_image(capture / "masks/left/a.png", HALF)
    file = str(capture / "images/left/a.png")
    pose = {"file_path": file, "transform_matrix": POSE.tolist(), "fl_x": 9.0}
    write_json(capture / "transforms.json", [pose])
    (tmp_path / "link").symlink_to(capture)
    monkeypatch.chdir(tmp_path)
    assert weights(load_scene(given)) == pytest.approx({"a": 3 / 8})


def test_a_mask_is_undistorted_with_its_photograph(tmp_path):
    """A mask found by name gives the same weights as one that the frame names."""
    lens = {"fl_x": 30.0, "cx": 24.0, "cy": 20.0, "w": 48, "h": 40, "k1": -0.2, "p1": 0.01}
    mask = np.zeros((40, 48), np.uint8)
    mask[5:30, 10:40] = 255
    write_image(tmp_path / "images/a.png", np.random.default_rng(0).integers(0, 255, (40, 48, 3)))
    pose = {"file_path": "images/a.png", "transform_matrix": POSE.tolist()}
    write_image(tmp_path / "other/x.png", mask)
    write_json(tmp_path / "transforms.json", [{**pose, "mask_path": "other/x.png"}], **lens)
    named = np.asarray(load_scene(tmp_path).train.weight)
    assert (named[0] != mask / 255).any()
    write_json(tmp_path / "transforms.json", [pose], **lens)
    write_image(tmp_path / "masks/a.png", mask)
    np.testing.assert_array_equal(load_scene(tmp_path).train.weight, named)


@pytest.mark.parametrize("make", [single, llff_capture, colmap_capture])
@pytest.mark.parametrize("name", ["{0.name}.png", "{0.stem}.mask.png"])
def test_masks_beside_photographs(tmp_path, make, name):
    """Masks beside photographs are not loaded as photographs."""
    if make is colmap_capture:
        pytest.importorskip("pycolmap")
    make(tmp_path)
    for photograph in sorted((tmp_path / "images").iterdir()):
        write_image(tmp_path / "images" / name.format(photograph), HALF)
    scene = load_scene(tmp_path)
    assert "3 of 3 photographs have a mask" in scene.metadata["notes"][-1]
    np.testing.assert_allclose(list(weights(scene).values()), 3 / 8)


def test_a_listed_photograph_is_not_a_mask(tmp_path):
    names = ["a.png", "a.png.png", "b.mask.png"]
    for name in names:
        write_image(tmp_path / "images" / name, HALF)
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": POSE.tolist(), "fl_x": 9.0}
        for name in names
    ]
    write_json(tmp_path / "transforms_train.json", frames)
    scene = load_scene(tmp_path)
    assert len(scene.train) == 3 and (np.asarray(scene.train.weight) == 1).all()


def test_a_mask_without_a_photograph_is_a_photograph(tmp_path):
    llff_capture(tmp_path)
    (tmp_path / "images/1.png").rename(tmp_path / "images/1.mask.png")
    scene = load_scene(tmp_path, downscale=1)
    assert sorted(weights(scene)) == ["0", "1.mask", "2"]
    assert set(weights(scene).values()) == {1.0}


def test_inverted_masks(tmp_path):
    paper_capture(tmp_path)
    write_image(tmp_path / "masks/train/a.png", HALF)
    scene = load_scene(tmp_path, invert_masks=True)
    np.testing.assert_array_equal(scene.train.weight[0], 1 - np.asarray(HALF) / 255)
    assert (np.asarray(scene.train.weight[1]) == 1).all()  # photographs without a mask stay whole


def test_alpha_as_a_mask(tmp_path):
    """Colors are the file's own, and transparent pixels do not bleed when the image shrinks."""
    image = np.full((HEIGHT, WIDTH, 4), [200, 100, 50, 255], np.uint8)
    image[:, 3:, :3], image[:, 3:, 3] = 7, 0
    image[0, 0, 3] = 128
    single_file(tmp_path, 1)
    write_image(tmp_path / "images/000.png", image)
    scene = load_scene(tmp_path, alpha_mode="ignore")
    np.testing.assert_array_equal(scene.train.rgb[0], image[..., :3])
    assert (np.asarray(scene.train.weight) == 1).all()
    scene = load_scene(tmp_path, alpha_mode="mask")
    np.testing.assert_allclose(scene.train.weight[0], image[..., 3] / 255)
    np.testing.assert_allclose(scene.train.rgb[0, :, :3], image[:, :3, :3], atol=1)
    for options in ({"downscale": 2}, {"split": "zoom", "zoom": 2}):
        scene = load_scene(tmp_path, alpha_mode="mask", **options)
        weight = [[(3 + 128 / 255) / 4, 0.5, 0, 0], *[[1, 0.5, 0, 0]] * 2]
        np.testing.assert_allclose(scene.train.weight[0], weight, atol=3e-3)
        np.testing.assert_allclose(
            np.asarray(scene.train.rgb[0, :, :2], int), np.full((3, 2, 3), [200, 100, 50]), atol=2
        )
    write_image(tmp_path / "masks/000.png", np.flip(HALF))  # keeps columns 5 to 7
    scene = load_scene(tmp_path)
    assert (
        scene.train.rgb[0, 0].tolist() == [[227, 177, 152]] + [[200, 100, 50]] * 2 + [[255] * 3] * 5
    )
