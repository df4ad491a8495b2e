import pathlib
import warnings

import numpy as np
import pytest
from tiny_capture import POSE, frame, paper_capture, single_file, write_json

from jaxcloseup.captures.load import SceneError, SceneWarning, load_scene
from jaxcloseup.photos.scene import UnknownKeyWarning


@pytest.fixture
def capture(tmp_path):
    return paper_capture(tmp_path)


@pytest.mark.parametrize("downscale", [0, -1, 0.5, True, "2"])
def test_downscale_must_be_a_whole_number(capture, downscale):
    with pytest.raises(SceneError, match="downscale must be a whole number"):
        load_scene(capture, downscale=downscale)


def test_downscale_too_large(capture):
    with pytest.raises(SceneError, match="8 x 6 pixels, and downscale 7 leaves nothing"):
        load_scene(capture, downscale=7)


@pytest.mark.parametrize(
    ("size", "message"), [((16, 8), "correct w and h"), ((6, 8), "EXIF orientation")]
)
def test_cropped_or_rotated_images_are_refused(capture, size, message):
    frames = [frame("train/a.png", w=size[0], h=size[1])]
    write_json(capture / "transforms_train.json", frames)
    with pytest.raises(SceneError, match=message):
        load_scene(capture)


ROTATED = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def without(key, **changes):
    return {name: value for name, value in frame("train/a.png", **changes).items() if name != key}


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], '"frames" is empty'),
        ({}, '"frames" must be a list'),
        (["a"], '"frames" must be a list of objects'),
        ([without("file_path")], "a frame has no file_path"),
        ([frame("")], r"a frame has no file_path \(got ''\)"),
        ([frame(3)], r"a frame has no file_path \(got 3\)"),
        ([without("transform_matrix")], "no transform_matrix"),
        ([frame("train/a.png", mask_path=3)], "mask_path is 3"),
        (
            [frame("train/a.png"), frame("x.png"), frame("y.png")],
            r"2 of 3 listed images do not exist \(x\.png, y\.png\)",
        ),
        (
            [frame(f"r_{i}") for i in range(4)],
            r"4 of 4 listed images do not exist \(r_0, r_1, r_2, \.\.\.\)",
        ),
        ([frame("train/a.png", transform_matrix=[[1, 2], [3]])], "must be a 4x4 matrix"),
        ([frame("train/a.png", transform_matrix="x")], "must be a 4x4 matrix"),
        ([frame("train/a.png", transform_matrix=np.eye(3).tolist())], "must be a 4x4 matrix"),
        ([frame("train/a.png", transform_matrix=(np.eye(4) * np.nan).tolist())], "not finite"),
        ([frame("train/a.png", transform_matrix=POSE.T.tolist())], "may be transposed"),
        ([frame("train/a.png", transform_matrix=(POSE * [[2]] * 3 + [[1]]).tolist()[:3])], "rigid"),
        (
            [frame("train/a.png", transform_matrix=(ROTATED * [1, 1, 1.01, 1]).tolist())],
            "off by 0.02",
        ),
        ([frame("train/a.png", transform_matrix=(ROTATED * [1, 1, -1, 1]).tolist())], "mirrors"),
        (
            [frame("train/a.png", transform_matrix=[[10**400] * 4] * 4)],
            "transform_matrix must be a 4x4 matrix",
        ),
        ([frame("train/a.png", fx=10**400)], "fx has 401 digits"),
        ([frame("train/a.png", w=0.5, h=6)], "w must be at least 1 pixel, got 0.5"),
        ([frame("train/a.png", k1=-1e6)], "undistortion leaves nothing of the photograph"),
        ([frame("train/a.png", fx=0)], "fx must be greater than 0, got 0"),
        ([frame("train/a.png", fy=-3.0)], "fy must be greater than 0"),
        ([frame("train/a.png", fx=np.nan)], "fx must be a finite number, got nan"),
        ([frame("train/a.png", cx=np.inf)], "cx must be a finite number, got inf"),
        ([frame("train/a.png", cy="3")], "cy must be a finite number, got '3'"),
        ([frame("train/a.png", cy=True)], "cy must be a finite number, got True"),
        ([frame("train/a.png", w=8)], "w and h belong together"),
        ([frame("train/a.png", w=8, h=0)], "h must be greater than 0"),
        ([frame("train/a.png", k1=0.1, k4=-0.1)], r"distortion \(non-zero k4\).*FULL_OPENCV if"),
        ([frame("train/a.png", camera_model="RADIAL", k6=1)], r"non-zero k6\).*with RADIAL"),
        (
            [frame("train/a.png", is_fisheye=True, p1=1)],
            r"p1\) is not supported with OPENCV_FISHEYE",
        ),
        ([frame("train/a.png", camera_model="FOV")], "camera_model 'FOV'.*undistort"),
        ([frame("train/a.png", k1=np.nan)], "k1 must be a finite number"),
        ([{k: v for k, v in frame("train/a.png").items() if k not in ("fx", "fy")}], "no focal"),
        (
            [without("fx", fy=None, camera_angle_x=4.0) | {"fy": 1.0}],
            "camera_angle_x must be in radians, below pi",
        ),
    ],
)
def test_wrong_frames(capture, frames, message):
    write_json(capture / "transforms_train.json", frames)
    with pytest.raises(SceneError, match=message) as error:
        load_scene(capture)
    assert "transforms_train.json" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"near": 0}, "near must be greater than 0"),
        ({"near": 9.0}, "near 9 is not less than far 9"),
        ({"far": "9"}, "far must be a finite number"),
        ({"applied_transform": [[1]]}, "applied_transform must be a 4x4"),
        ({"applied_transform": [[0.0] * 4] * 3}, "applied_transform flattens space"),
        ({"applied_scale": 0}, "applied_scale must be greater than 0"),
    ],
)
def test_wrong_fields(capture, fields, message):
    write_json(capture / "transforms_train.json", [frame("train/a.png")], **fields)
    with pytest.raises(SceneError, match=r"transforms_train\.json: " + message):
        load_scene(capture)


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        ({"train_filenames": "images/000.png"}, "train_filenames must be a list"),
        ({"test_filenames": ["000.png"]}, r"test_filenames names '000\.png', which is no frame's"),
        ({"val_filenames": [f"images/00{i}.png" for i in range(2)]}, "every frame is held out"),
    ],
)
def test_wrong_lists(tmp_path, lists, message):
    single_file(tmp_path, 2, **lists)
    with pytest.raises(SceneError, match=message):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b'{"frames": [\n}', "not JSON at line 2"),
        (b"[]", "not an object"),
        (b'{"frames": "\xff"}', "not UTF-8"),
        (b"", "not JSON at line 1"),
        (b"[" * 100_000, "nested too deep"),
        (b'{"near": ' + b"9" * 5000 + b"}", "a number has thousands of digits"),
    ],
)
def test_wrong_json(capture, data, message):
    (capture / "transforms_train.json").write_bytes(data)
    with pytest.raises(SceneError, match=message):
        load_scene(capture)


@pytest.mark.parametrize("background", [-0.1, 2, np.nan])
def test_background_is_a_gray_level(capture, background):
    with pytest.raises(SceneError, match=r"background must be a gray level in \[0, 1\], got "):
        load_scene(capture, background=background)


def test_operating_system_errors_become_one_sentence(capture, monkeypatch):
    write_json(capture / "transforms_train.json", [frame("a" * 5000)])
    with pytest.raises(SceneError, match=r"a cannot be read \(File name too long\)") as error:
        load_scene(capture)
    assert len(str(error.value)) < 400

    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(pathlib.Path, "is_file", refuse)
    with pytest.raises(SceneError, match=r"\.json cannot be read \(Permission denied\): make it"):
        load_scene(capture)


def test_unknown_keys_warn_once_per_file(capture):
    frames = [frame("train/a.png", time=0, sharpness=3), frame("train/b.png", time=1)]
    write_json(capture / "transforms_train.json", frames, aabb_scale=4, color="red")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_scene(capture)
    assert [warning.category for warning in caught] == [UnknownKeyWarning]
    assert str(caught[0].message).endswith("transforms_train.json: these fields are ignored: "
                                           "color, time.")  # fmt: skip
    assert issubclass(UnknownKeyWarning, SceneWarning)


def test_empty_folder_and_no_folder(tmp_path):
    with pytest.raises(SceneError, match=r"holds no capture: add transforms_train\.json, transf"):
        load_scene(tmp_path)
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(SceneError, match="is not a folder: give the folder"):
        load_scene(tmp_path / "transforms.json")
    with pytest.raises(SceneError, match="is not a folder"):
        load_scene(tmp_path / "none")
