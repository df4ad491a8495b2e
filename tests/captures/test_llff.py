import numpy as np
import pytest
import reference
from tiny_capture import llff_capture, llff_rows, own_poses

from jaxcloseup.captures.load import load_scene


@pytest.fixture
def capture(tmp_path):
    return llff_capture(tmp_path)


def test_known_cameras(capture):
    _, poses = llff_rows(3)
    scene = load_scene(capture)
    assert scene.names == {"train": ["1", "2"], "test_far": ["0"]}
    assert scene.metadata["format"] == "llff"
    np.testing.assert_allclose(own_poses(scene), poses[1:], atol=1e-6)
    np.testing.assert_allclose(scene.train.cameras.intrinsics, [[9, 9, 4, 3]] * 2)
    limits = np.array([scene.near, scene.far]) / scene.placement.scale
    np.testing.assert_allclose(limits, [0.9 * 1.8, 22])
    # A point ahead, right of the axis and below it, projects right of the center and below it.
    point = poses[1] @ [1, 0.5, 3, 1]
    pixel, depth = reference.project(own_poses(scene)[0], [9, 9, 4, 3], point[None])
    np.testing.assert_allclose(pixel[0], [7, 4.5], atol=1e-5)
    np.testing.assert_allclose(depth, 3, rtol=1e-6)


def test_hidden_files_are_not_photographs(capture):
    (capture / "images/._0.png").write_bytes(b"metadata of macOS")
    assert len(load_scene(capture).train) == 2
