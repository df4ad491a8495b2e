"""Already shrunk photographs in `images_2`, and the cache of photographs shrunk here."""

import shutil

import cv2
import numpy as np
import pytest
from tiny_capture import POSE, colmap_capture, llff_capture, single_file, write_image, write_json

from jaxcloseup.captures import photo_reading
from jaxcloseup.captures.load import SceneError, load_scene
from jaxcloseup.io import cache as cache_files


LENS = {"fl_x": 7.0, "fl_y": 9.0, "cx": 4.5, "cy": 2.5, "w": 9, "h": 7}


def picture(seed, width=9, height=7):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def write_capture(folder, names=("a.png", "b.png", "c.png"), **fields):
    for i, name in enumerate(names):
        write_image(folder / "images" / name, picture(i))
    frames = [{"file_path": f"images/{name}", "transform_matrix": POSE.tolist()} for name in names]
    write_json(folder / "transforms_train.json", frames, **{**LENS, **fields})


def load(folder, **options):
    scene = load_scene(folder, **options)
    return np.asarray(scene.train.rgb), np.asarray(scene.train.weight), scene


@pytest.mark.parametrize("size", [(4, 3), (5, 4)])
def test_shrunk_photographs_are_used(tmp_path, size):
    """Either rounding of the size is accepted, and the intrinsics follow the actual size."""
    write_capture(tmp_path, ("sub/a.png", "b.png", "c.png"))
    mask = np.zeros((7, 9), np.uint8)
    mask[:, :5] = 255
    write_image(tmp_path / "masks/b.png", mask)
    for i, name in enumerate(["sub/a.jpg", "b.png", "c.png"]):
        write_image(tmp_path / "images_2" / name, np.full((*size[::-1], 3), 20 * i, np.uint8))
    rgb, weight, scene = load(tmp_path, downscale=2)
    assert rgb.shape == (3, *size[::-1], 3)
    assert (rgb == 20 * np.arange(3)[:, None, None, None]).all()
    x, y = size[0] / 9, size[1] / 7
    np.testing.assert_allclose(
        scene.train.cameras.intrinsics[0], [7 * x, 9 * y, 4.5 * x, 2.5 * y], rtol=1e-6
    )
    np.testing.assert_allclose(weight.mean((1, 2)), [1, 5 / 9, 1], atol=2e-3)
    assert scene.names["train"] == ["a", "b", "c"]
    assert scene.metadata["notes"][-2].endswith("using the shrunk photographs in images_2")
    assert (load(tmp_path)[0][1] == picture(1)).all()  # not used at full size


def test_shrunk_photographs_are_halves_of_photographs_not_of_what_intrinsics_are_for(tmp_path):
    doubled = {key: 2 * LENS[key] for key in ("fl_x", "fl_y", "cx", "cy")}
    write_capture(tmp_path, **doubled)
    for name in ("a.png", "b.png", "c.png"):
        write_image(tmp_path / "images_2" / name, np.zeros((3, 4, 3), np.uint8))
    scene = load(tmp_path, downscale=2, corrections=["size=2"])[2]
    assert scene.metadata["own_sizes"]["train"] == [(9, 7)] * 3
    write_capture(tmp_path / "right")
    right = np.asarray(load(tmp_path / "right")[2].train.cameras.intrinsics)
    scale = np.array([4 / 9, 3 / 7, 4 / 9, 3 / 7])
    np.testing.assert_allclose(scene.train.cameras.intrinsics, right * scale, rtol=1e-6)


@pytest.mark.parametrize("make", [llff_capture, colmap_capture])
def test_every_format_uses_shrunk_photographs(tmp_path, make):
    if make is colmap_capture:
        pytest.importorskip("pycolmap")
    make(tmp_path)
    for path in (tmp_path / "images").iterdir():
        write_image(tmp_path / "images_2" / path.name, np.full((3, 4, 3), 77, np.uint8))
    assert (load(tmp_path, downscale=2)[0] == 77).all()


def test_shrunk_photographs_are_used_only_if_complete(tmp_path):
    write_capture(tmp_path, ("a.png", "a.jpg", "c.png"))
    expected = load(tmp_path, downscale=2)[0]
    small = np.zeros((3, 4, 3), np.uint8)
    for name in ("a.png", "c.png"):
        write_image(tmp_path / "images_2" / name, small)
    rgb, _, scene = load(tmp_path, downscale=2)
    np.testing.assert_array_equal(rgb, expected)
    lacks = "images_2 is not used, because it lacks 2 of 3 photographs, such as a."
    assert lacks in scene.metadata["notes"][-1]
    write_image(tmp_path / "images_2/a.jpg", small)
    assert (load(tmp_path, downscale=2)[0] == 0).all()
    frames = [{"file_path": "images/c.png", "transform_matrix": POSE.tolist()}]
    write_json(tmp_path / "transforms_train.json", frames, fl_x=7.0)
    rgb, _, scene = load(tmp_path, downscale=2)
    notes = " ".join(scene.metadata["notes"])
    assert rgb.any() and "because the capture gives no w and h" in notes


@pytest.mark.parametrize(
    "make", [lambda folder: single_file(folder, 3), llff_capture, colmap_capture]
)
def test_shrunk_photographs_alone_are_the_photographs(tmp_path, make):
    """Their intrinsics follow the ratio of sizes, and masks of the full size shrink with them."""
    if make is colmap_capture:
        pytest.importorskip("pycolmap")
    make(tmp_path)
    lens = load(tmp_path)[2].train.cameras.intrinsics
    names = [path.name for path in (tmp_path / "images").iterdir()]
    shutil.rmtree(tmp_path / "images")
    for name in names:
        write_image(tmp_path / "images_2" / name, np.full((3, 4, 3), 77, np.uint8))
        write_image(tmp_path / "masks" / name, np.tile(np.uint8([0, 255]), (6, 4)))
    rgb, weight, scene = load(tmp_path)
    assert (rgb == 77).all()
    np.testing.assert_allclose(weight, 0.5, atol=0.01)
    np.testing.assert_allclose(scene.train.cameras.intrinsics, lens / 2, rtol=1e-6)
    words = "reading shrunk photographs, because images does not exist"
    assert any(note.endswith(words) for note in scene.metadata["notes"])


def test_shrunk_photographs_alone_need_sizes(tmp_path):
    write_capture(tmp_path)
    (tmp_path / "images").rename(tmp_path / "images_4")
    frames = [{"file_path": "images/a.png", "transform_matrix": POSE.tolist()}]
    write_json(tmp_path / "transforms_train.json", frames, camera_angle_x=0.6)
    assert (load(tmp_path)[0][0] == picture(0)).all()
    write_json(tmp_path / "transforms_train.json", frames, fl_x=7.0)
    with pytest.raises(SceneError, match=r"only .*images_4/a\.png exists, .*: give w and h of"):
        load_scene(tmp_path)


@pytest.mark.parametrize("place", ["images_4/capture", "images_4"])
def test_folders_above_a_capture_do_not_shrink_its_photographs(tmp_path, monkeypatch, place):
    image = {"file_path": "a.png", "transform_matrix": POSE.tolist()}
    write_image(tmp_path / place / "a.png", picture(0))
    write_json(tmp_path / place / "transforms_train.json", [image], fl_x=7.0)
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path / place, place):
        rgb, _, scene = load(folder)
        assert (rgb[0] == picture(0)).all() and "shrunk" not in " ".join(scene.metadata["notes"])


def test_folders_above_a_model_do_not_shrink_its_photographs(tmp_path, monkeypatch):
    """The folder of a model is given by its relative path, and its capture is found from there."""
    pytest.importorskip("pycolmap")
    colmap_capture(tmp_path / "images_4/capture")
    monkeypatch.chdir(tmp_path)
    for folder in ("images_4/capture", "images_4/capture/sparse/0"):
        assert "shrunk" not in " ".join(load(folder)[2].metadata["notes"])


# The cache.


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache/jaxcloseup/photographs"


@pytest.fixture
def capture(tmp_path, cache):
    write_capture(tmp_path / "capture", ("a.png", "b.png"))
    write_image(tmp_path / "capture/masks/a.png", np.tile(np.uint8([[0, 40, 255]]), (7, 3)))
    return tmp_path / "capture"


@pytest.fixture
def decoded(monkeypatch):
    """Collects the names of the images that are decoded."""
    names, read = [], photo_reading.decode_image

    def count(path, **options):
        names.append(path.name)
        return read(path, **options)

    monkeypatch.setattr(photo_reading, "decode_image", count)
    return names


@pytest.mark.parametrize("options", [{"downscale": 2}, {"split": "zoom", "zoom": 2}])
def test_the_cache_returns_what_was_made(capture, cache, decoded, options):
    first = load_scene(capture, **options)
    made = len(decoded)
    again = load_scene(capture, **options)
    assert made == 2 and len(decoded) == made and len(list(cache.iterdir())) == 2
    for split in first.names:
        a, b = getattr(first, split), getattr(again, split)
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.weight, b.weight)
        np.testing.assert_array_equal(a.cameras.intrinsics, b.cameras.intrinsics)
    assert first.metadata == again.metadata


def test_damaged_cache_files_are_made_again(capture, cache, decoded, caplog):
    expected = load(capture, downscale=2)
    for path in sorted(cache.iterdir()):
        arrays, record = cache_files.load(path, path.stem)
        whole = path.read_bytes()
        damages = [whole[:-1], b"", b"x" * 40]
        damages += [
            whole[:i] + bytes([whole[i] ^ 1]) + whole[i + 1 :] for i in range(0, len(whole), 97)
        ]
        others = {"other": np.zeros(3)}, {"rgb0": np.zeros((3, 4)), "mask0": np.zeros(2)}
        for other in (*((other, record) for other in others), (arrays, []), (arrays, 2 * record)):
            cache_files.save(path, path.stem, cache_files.Stored(*other))
            damages.append(path.read_bytes())
        for damaged in damages:
            path.write_bytes(damaged)
            decoded.clear()
            caplog.clear()
            found = load(capture, downscale=2)
            assert [record.levelname for record in caplog.records] == ["WARNING"]
            assert "is damaged" in caplog.text
            assert len(decoded) == 1 and path.read_bytes() == whole
            np.testing.assert_array_equal(found[0], expected[0])
            np.testing.assert_array_equal(found[1], expected[1])


def test_the_key_covers_everything_that_matters(capture, decoded, monkeypatch):
    """Each change decodes again; `half_pixel` matters only for distorted lenses."""
    write_image(capture / "images/a.png", np.dstack([picture(0), picture(1)[..., :1]]))
    frames = [
        {"file_path": f"images/{name}.png", "transform_matrix": POSE.tolist()} for name in "ab"
    ]

    def bend(**lens):
        write_json(capture / "transforms_train.json", frames, **{**LENS, **lens})

    changes = [
        (lambda: None, {"downscale": 2}, 2),
        (lambda: None, {"downscale": 3}, 2),
        (lambda: None, {"downscale": 2, "background": 0.5}, 2),
        (lambda: None, {"downscale": 2, "half_pixel": True}, 0),
        (lambda: None, {"downscale": 1}, 2),
        (lambda: None, {"split": "zoom", "zoom": 2}, 2),
        (lambda: write_image(capture / "images/b.png", picture(9)), {"downscale": 2}, 1),
        (lambda: write_image(capture / "masks/a.png", picture(9)), {"downscale": 2}, 1),
        (lambda: bend(k1=-0.1), {"downscale": 2}, 2),
        (lambda: bend(k1=-0.2), {"downscale": 2}, 2),
        (lambda: bend(k1=-0.2, fl_x=8.0), {"downscale": 2}, 2),
        (lambda: None, {"downscale": 2, "half_pixel": True}, 2),
        (lambda: monkeypatch.setattr(photo_reading, "_code", str), {"downscale": 2}, 2),
    ]
    for change, options, count in changes:
        change()
        decoded.clear()
        load_scene(capture, **options)
        assert len(decoded) == count, options


def test_a_given_principal_point_is_not_confused_with_the_default(capture, decoded):
    """Before decoding the size is unknown, so the key must not mistake 0.5 for its middle."""
    frames = [{"file_path": "images/a.png", "transform_matrix": POSE.tolist()}]
    for center in ({"cx": 0.5, "cy": 0.5}, {}):
        write_json(capture / "transforms_train.json", frames, fl_x=7.0, k1=-0.1, **center)
        decoded.clear()
        load_scene(capture, downscale=2)
        assert decoded == ["a.png"]


def test_an_unwritable_cache_is_ignored(capture, monkeypatch, tmp_path):
    expected = load(capture, downscale=2)[0]
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    np.testing.assert_array_equal(load(capture, downscale=2)[0], expected)
    reduced = cv2.resize(picture(1), (4, 3), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(expected[1], reduced)
