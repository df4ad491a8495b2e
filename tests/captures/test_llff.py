import numpy as np
import pytest
import reference
from tiny_capture import llff_capture, llff_rows

from jaxcloseup.captures.load import SceneError, load_scene


@pytest.fixture
def capture(tmp_path):
    return llff_capture(tmp_path)


def test_known_cameras(capture):
    _, poses = llff_rows(3)
    scene = load_scene(capture)
    assert scene.names == {"train": ["1", "2"], "test_far": ["0"]}
    assert scene.metadata["format"] == "llff"
    np.testing.assert_allclose(scene.train.cameras.camtoworld, poses[1:], atol=1e-6)
    np.testing.assert_allclose(scene.train.cameras.intrinsics, [[9, 9, 4, 3]] * 2)
    np.testing.assert_allclose([scene.near, scene.far], [0.9 * 1.8, 22])
    # A point ahead, right of the axis and below it, projects right of the center and below it.
    point = poses[1] @ [1, 0.5, 3, 1]
    pixel, depth = reference.project(scene.train.cameras.camtoworld[0], [9, 9, 4, 3], point[None])
    np.testing.assert_allclose(pixel[0], [7, 4.5], atol=1e-5)
    np.testing.assert_allclose(depth, 3, rtol=1e-6)


def change(rows, column, value):
    rows[1, column] = value
    return rows


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda rows: rows[:, :15], "has shape 3 x 15 instead of N x 17"),
        (lambda rows: rows[0], "has shape 17 instead of N x 17"),
        (lambda rows: rows[:0], "has shape 0 x 17 instead of N x 17"),
        (lambda rows: rows[:2], r"has 2 poses but .*images has 3 photographs"),
        (lambda rows: rows.astype(str), "instead of real numbers"),
        (lambda rows: change(rows, 3, np.nan), r"row of 1\.png: pose holds a value .* not finite"),
        (lambda rows: change(rows, 0, 5.0), r"row of 1\.png: pose is not rigid"),
        (lambda rows: change(rows, 14, -9.0), r"1\.png: focal length must be greater than 0"),
        (lambda rows: change(rows, 4, 0.0), r"1\.png: height must be greater than 0"),
        (lambda rows: change(rows, 15, 99.0), r"near bound 99 is not less than far bound 21"),
        (lambda rows: change(rows, 15, -1.0), "near bound must be greater than 0"),
        (lambda rows: change(rows, 4, 16.0), "but w and h are 8 x 16"),
    ],
)
def test_wrong_rows(capture, make, message):
    np.save(capture / "poses_bounds.npy", make(llff_rows(3)[0]))
    with pytest.raises(SceneError, match=message) as error:
        load_scene(capture)
    assert "poses_bounds.npy" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("data", [b"", b"hello", None])
def test_not_a_numpy_file(capture, data):
    whole = (capture / "poses_bounds.npy").read_bytes()
    (capture / "poses_bounds.npy").write_bytes(whole[:-9] if data is None else data)
    with pytest.raises(SceneError, match=r"poses_bounds\.npy is truncated or not a NumPy file"):
        load_scene(capture)


def test_hidden_files_are_not_photographs(capture):
    (capture / "images/._0.png").write_bytes(b"metadata of macOS")
    assert len(load_scene(capture).train) == 2


def test_a_height_of_less_than_a_pixel(capture):
    np.save(capture / "poses_bounds.npy", change(llff_rows(3)[0], 4, 0.3))
    with pytest.raises(SceneError, match="height must be at least 1 pixel"):
        load_scene(capture)
