import cv2
import numpy as np
import pytest
from tiny_capture import image_line, own_points, write_image, write_json, write_model

from jaxcloseup.app.methods.shared.sightings import find_sightings
from jaxcloseup.captures import folder as folder_module
from jaxcloseup.captures.load import load_scene
from jaxcloseup.captures.triangulation import triangulate
from jaxcloseup.photos.scene import DuplicateFileWarning


WIDTH, HEIGHT, FOCAL = 240, 180, 200.0
LENS = np.array([FOCAL, FOCAL, 118.0, 91.0])
DEPTH = 5.0


@pytest.fixture(scope="module")
def views():
    """Four photographs of the textured plane z = 5, and their OpenCV poses."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (90, 120, 3), np.uint8)
    texture = cv2.GaussianBlur(
        cv2.resize(noise, (480, 360), interpolation=cv2.INTER_CUBIC), (0, 0), 1
    )
    # A texel is 0.025 wide, like a pixel at that distance; the middle one lies at x = y = 0.
    plane = np.array([[0.025, 0, -6.0], [0, 0.025, -4.5], [0, 0, DEPTH]])
    images, poses = [], []
    for i in range(4):
        rotation = cv2.Rodrigues(np.array([0.03 * i, -0.1 * i + 0.15, 0.05 * i]))[0]
        position = np.array([0.6 * i - 0.9, 0.1 * i, 0.2 * i])
        center = [[FOCAL, 0, LENS[2] - 0.5], [0, FOCAL, LENS[3] - 0.5], [0, 0, 1]]
        towards = plane - np.array([[0, 0, 1.0]]) * position[:, None]
        images.append(cv2.warpPerspective(texture, center @ rotation.T @ towards, (WIDTH, HEIGHT)))
        poses.append(np.column_stack([rotation, position]))
    return images, np.array(poses)


def test_points_lie_on_a_plane(views):
    images, poses = views
    masks = [np.full((HEIGHT, WIDTH), 255, np.uint8)] * 4
    points, rgb, seen_by = triangulate(images, masks, poses, np.array([LENS] * 4))
    assert len(points) > 300 and points.dtype == rgb.dtype == np.float32
    error = np.abs(points[:, 2] / DEPTH - 1)
    assert np.mean(error < 0.01) > 0.98 and np.median(error) < 0.002
    assert rgb.min() >= 0 and rgb.max() <= 1
    assert seen_by.shape == (len(points), 2) and set(np.unique(seen_by)) == {0, 1, 2, 3}
    for i, pose in enumerate(poses):
        seen = (points[(seen_by == i).any(axis=1)] - pose[:, 3]) @ pose[:, :3]
        pixels = FOCAL * seen[:, :2] / seen[:, 2:] + LENS[2:]
        assert ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all()


def test_masked_features_are_ignored(views):
    images, poses = views
    masks = [np.zeros((HEIGHT, WIDTH), np.uint8) for _ in images]
    lenses = np.array([LENS] * 4)
    assert triangulate(images, masks, poses, lenses)[0].shape == (0, 3)
    masks[0][:, :120] = masks[1][:, :120] = 255
    points = triangulate(images, masks, poses, lenses).points
    column = ((points - poses[0, :, 3]) @ poses[0, :, :3])[:, :2].T[0]
    assert len(points) and (column < 0.1).all()


def test_one_position_gives_no_points(views):
    images, poses = views
    masks = [np.full((HEIGHT, WIDTH), 255, np.uint8)] * 2
    points, *_ = triangulate(images[:2], masks, poses[[0, 0]], np.array([LENS] * 2))
    assert points.shape == (0, 3)


def test_a_capture_without_points_gets_triangulated_ones(tmp_path, views):
    """The points come from training photographs only, and give near and far."""
    frames = []
    for i, (image, pose) in enumerate(zip(*views, strict=True)):
        write_image(tmp_path / f"{i}.png", image)
        matrix = np.vstack([pose * [1, -1, -1, 1], [0, 0, 0, 1]]).tolist()
        frames.append({"file_path": f"{i}.png", "transform_matrix": matrix})
    lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), LENS.tolist(), strict=True))
    write_json(tmp_path / "transforms.json", frames, **lens, near=None, far=None)
    with pytest.warns(UserWarning, match="from the points"):
        scene = load_scene(tmp_path)
    assert scene.names["train"] == ["1", "2", "3"]
    assert np.median(np.abs(own_points(scene)[:, 2] - DEPTH)) < 0.02
    unit = scene.placement.scale
    assert 2 < scene.near / unit < 4.5 and 5 < scene.far / unit < 10
    assert "were triangulated from features of its 3 training" in scene.metadata["notes"][-1]
    write_json(tmp_path / "transforms.json", frames, **lens)
    closest = load_scene(tmp_path, split="closest")
    assert closest.names == {"train": ["1", "2"], "test": ["3"], "test_far": ["0"]}
    assert closest.metadata["times_nearer"] == pytest.approx([4.7 / 4.4], rel=0.03)
    again = load_scene(tmp_path, downscale=2)
    assert np.median(np.abs(own_points(again)[:, 2] - DEPTH)) < 0.05


@pytest.mark.parametrize("point", [False, True])
def test_triangulated_points_are_not_those_that_a_model_lists(tmp_path, views, point):
    """The only one, if any, is dropped, because but one training photograph sees it."""
    pytest.importorskip("pycolmap")
    lines = []
    for i, (image, pose) in enumerate(zip(*views, strict=True)):
        write_image(tmp_path / f"images/{i}.png", image)
        turn = -cv2.Rodrigues(pose[:, :3])[0][:, 0]  # to world-to-camera
        half = np.linalg.norm(turn) / 2
        quaternion = [np.cos(half), *(np.sin(half) * turn / (2 * half))]
        numbers = " ".join(map(str, [*quaternion, *(-pose[:, :3].T @ pose[:, 3])]))
        lines += [image_line(i + 1, f"{i}.png", numbers), "118 91 1" if point and i < 2 else ""]
    camera = f"1 PINHOLE {WIDTH} {HEIGHT} {' '.join(map(str, LENS))}"
    points = ["1 0 0 5 9 9 9 0.5 1 0 2 0"] if point else []
    write_model(tmp_path / "sparse/0", lines, [camera], points)
    scene = load_scene(tmp_path)
    assert any("dropped 1 of 1 points" in note for note in scene.metadata["notes"]) == point
    assert len(scene.points) > 300 and scene.metadata["point_errors"] is None
    assert "seen" not in scene.metadata and len(find_sightings(scene).view) > 300


def test_too_few_points_are_dropped(tmp_path, views, monkeypatch):
    few = np.ones((99, 3), np.float32)
    monkeypatch.setattr(folder_module, "triangulate", lambda *_: (few, few, few))
    write_image(tmp_path / "a.png", views[0][0])
    pose = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "fl_x": FOCAL}
    with pytest.warns(DuplicateFileWarning):
        write_json(tmp_path / "transforms_train.json", [pose, pose])
        assert load_scene(tmp_path).points.shape == (0, 3)
