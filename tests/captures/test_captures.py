import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from tiny_capture import (
    HEIGHT,
    POSE,
    WIDTH,
    frame,
    own_points,
    own_poses,
    paper_capture,
    single_file,
    vertices,
    write_image,
    write_json,
    write_ply,
)

from jaxcloseup.captures import load as load_module
from jaxcloseup.captures.load import SceneError, load_scene
from jaxcloseup.photos.scene import (
    DuplicateFileWarning,
    ImageSizeWarning,
    NearFarWarning,
    UnknownKeyWarning,
)


@pytest.fixture
def capture(tmp_path):
    return paper_capture(tmp_path)


def test_paper_layout(capture):
    write_json(capture / "transforms_video.json", [frame("")])
    scene = load_scene(capture)
    assert (len(scene.train), len(scene.test), scene.test_far) == (2, 1, None)
    assert scene.names == {"train": ["a", "b"], "test": ["a"]}
    assert (scene.near, scene.far, scene.name) == (1.0, 9.0, capture.name)
    assert scene.train.rgb.dtype == jnp.uint8 and scene.train.rgb.shape == (2, HEIGHT, WIDTH, 3)
    assert (np.asarray(scene.train.rgb) == 11).all() and (np.asarray(scene.test.rgb) == 10).all()
    assert (np.asarray(scene.train.weight) == 1).all() and scene.train.weight.dtype == jnp.float32
    np.testing.assert_allclose(scene.train.cameras.intrinsics, [[10, 11, 4, 3]] * 2)
    np.testing.assert_allclose(scene.test.cameras.intrinsics, [[30, 11, 4, 3]])
    assert (scene.train.cameras.width, scene.train.cameras.height) == (WIDTH, HEIGHT)
    assert scene.points.shape == scene.rgb.shape == (0, 3) and scene.surface is None
    assert scene.metadata["files"]["test"] == [capture / "test" / "a.png"]
    assert scene.metadata["sizes"]["test"] == [(WIDTH, HEIGHT)]
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(scene.train))


def test_opengl_pose_becomes_opencv(capture):
    """OpenGL's identity looks along -z with y up, so points above the axis land higher up."""
    scene = load_scene(capture)
    points = POSE[:3, 3] + [[0, 0, -2], [1, 0, -2], [0, 1, -2]]
    pixels, depth = reference.project(own_poses(scene)[0], [10, 11, 4, 3], points)
    np.testing.assert_allclose(depth, 2, atol=1e-6)
    np.testing.assert_allclose(pixels, [[4, 3], [9, 3], [4, 3 - 5.5]], atol=1e-6)


def test_half_pixel_moves_the_given_principal_point(capture):
    scene = load_scene(capture, half_pixel=True)
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0], [10, 11, 4.5, 3.5])
    scene = load_scene(capture, half_pixel=True, downscale=2)
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0], [5, 5.5, 2.25, 1.75])


def test_blender_layout(tmp_path):
    rgba = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    rgba[..., 0], rgba[:, 4:, 3], rgba[0, 0] = 200, 255, [200, 100, 0, 128]
    poses = [{"file_path": f"./train/r_{i}", "transform_matrix": POSE.tolist()} for i in range(2)]
    for i in range(2):
        write_image(tmp_path / f"train/r_{i}.png", rgba)
    for split in ("train", "test", "val"):
        write_json(
            tmp_path / f"transforms_{split}.json",
            [{**pose, "rotation": 0.01} for pose in poses],
            camera_angle_x=np.pi / 2,
        )
    with pytest.warns(DuplicateFileWarning, match=r"\./train/r_0 \(train and test\)"):
        scene = load_scene(tmp_path)
    assert (len(scene.train), len(scene.test), len(scene.test_far)) == (2, 2, 2)
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0], [4, 4, 4, 3], rtol=1e-6)
    assert scene.train.rgb[0, 0].tolist() == [[227, 177, 127]] + [[255] * 3] * 3 + [[200, 0, 0]] * 4
    assert (np.asarray(scene.train.weight) == 1).all()
    with pytest.warns(DuplicateFileWarning):
        scene = load_scene(tmp_path, background=0.0, half_pixel=True)
    assert scene.train.rgb[0, 0].tolist() == [[100, 50, 0]] + [[0] * 3] * 3 + [[200, 0, 0]] * 4
    # The file gives no principal point, so half_pixel moves none.
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0], [4, 4, 4, 3], rtol=1e-6)


def test_single_file_holds_out_every_eighth(tmp_path, caplog):
    single_file(tmp_path, 10, camera_model="OPENCV")
    with caplog.at_level("INFO", "jaxcloseup"):
        scene = load_scene(tmp_path)
    assert scene.test is None and scene.names["test_far"] == ["000", "008"]
    assert scene.names["train"] == [f"{i:03d}" for i in range(10) if i % 8]
    assert scene.train.rgb[:, 0, 0, 0].tolist() == [1, 2, 3, 4, 5, 6, 7, 9]
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0], [7, 9, 3.5, 2.5])
    assert "every 8th" in caplog.text


def test_single_file_with_lists(tmp_path):
    transform = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 2]]
    lists = {"test_filenames": ["./images/003.png"], "val_filenames": ["images/001.png"]}
    single_file(tmp_path, 4, applied_transform=transform, applied_scale=0.5, **lists)
    scene = load_scene(tmp_path)
    assert scene.names == {"train": ["002", "000"], "test": ["003"], "test_far": ["001"]}
    np.testing.assert_array_equal(scene.metadata["applied_transform"], transform)
    assert scene.metadata["applied_scale"] == 0.5
    single_file(tmp_path, 4, train_filenames=["images/000.png"], **lists)
    assert load_scene(tmp_path).names["train"] == ["000"]


def test_one_photograph(tmp_path):
    single_file(tmp_path, 1)
    scene = load_scene(tmp_path)
    assert len(scene.train) == 1 and scene.test is None and scene.test_far is None


def test_separate_files_win_over_a_single_one(capture, caplog):
    single_file(capture, 3)
    with caplog.at_level("INFO", "jaxcloseup"):
        assert load_scene(capture).names["train"] == ["a", "b"]
    assert "transforms_train.json and not transforms.json" in caplog.text


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        ({"camera_angle_y": np.pi / 2}, [3, 3, 4, 3]),
        ({"camera_angle_x": np.pi / 2, "camera_angle_y": np.pi / 2}, [4, 3, 4, 3]),
        ({"fl_x": 5.0, "camera_angle_x": 1.0, "cx": 1.0}, [5, 5, 1, 3]),
        ({"fl_y": 5, "cy": 0}, [5, 5, 4, 0]),
    ],
)
def test_lens_fields(tmp_path, lens, expected):
    write_image(tmp_path / "a.png")
    pose = {"file_path": "a.png", "transform_matrix": POSE.tolist()}
    write_json(tmp_path / "transforms.json", [pose], **lens)
    np.testing.assert_allclose(
        load_scene(tmp_path).train.cameras.intrinsics[0], expected, rtol=1e-6
    )
    # A frame's own lens wins over the file's, whichever fields they use.
    write_json(tmp_path / "transforms.json", [{**pose, **lens}], fx=99.0, fl_x=98.0)
    np.testing.assert_allclose(
        load_scene(tmp_path).train.cameras.intrinsics[0], expected, rtol=1e-6
    )


def test_mixed_sizes_are_padded(tmp_path):
    write_image(tmp_path / "a.png", np.full((6, 8, 3), 50, np.uint8))
    write_image(tmp_path / "b.png", np.full((8, 6, 3), 60, np.uint8))
    frames = [frame("a.png", w=8, h=6), frame("b.png", w=6, h=8, cx=3.0, cy=4.0)]
    write_json(tmp_path / "transforms_train.json", frames)
    scene = load_scene(tmp_path)
    assert scene.train.rgb.shape == (2, 8, 8, 3)
    expected = np.zeros((2, 8, 8))
    expected[0, :6, :], expected[1, :, :6] = 1, 1
    np.testing.assert_array_equal(scene.train.weight, expected)
    np.testing.assert_array_equal(
        scene.train.rgb[..., 0], expected * np.array([50, 60])[:, None, None]
    )
    np.testing.assert_allclose(scene.train.cameras.intrinsics, [[10, 11, 4, 3], [10, 11, 3, 4]])
    assert (scene.train.cameras.height, scene.train.cameras.width) == (8, 8)
    assert scene.metadata["sizes"]["train"] == [(8, 6), (6, 8)]


def test_masks_become_weights(capture):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :3] = 255
    write_image(capture / "masks/a.png", mask)
    frames = [frame("train/a.png", mask_path="masks/a.png"), frame("train/b.png", mask_path=None)]
    write_json(capture / "transforms_train.json", frames)
    scene = load_scene(capture, downscale=2)
    assert scene.train.weight[0, 0].tolist() == pytest.approx([1, 0.5, 0, 0], abs=2e-3)
    assert (np.asarray(scene.train.weight[1]) == 1).all()
    clear = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    clear[..., 3] = mask
    write_image(capture / "masks/a.png", clear)
    again = load_scene(capture, downscale=2)
    np.testing.assert_array_equal(again.train.weight, scene.train.weight)


def test_downscale_averages_areas(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    write_image(tmp_path / "a.png", image)
    write_json(tmp_path / "transforms_train.json", [frame("a.png")])
    scene = load_scene(tmp_path, downscale=2)
    expected = image.reshape(3, 2, 4, 2, 3).mean((1, 3))
    np.testing.assert_allclose(scene.train.rgb[0], expected, atol=0.51)
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0], [5, 5.5, 2, 1.5])
    # 8 x 6 becomes 2 x 2: each axis has its own ratio, and the image keeps its borders.
    scene = load_scene(tmp_path, downscale=3)
    assert scene.train.rgb.shape == (1, 2, 2, 3) and scene.train.cameras.width == 2
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0], [2.5, 11 / 3, 1, 1], rtol=1e-6)
    np.testing.assert_allclose(
        scene.train.rgb[0], image.reshape(2, 3, 2, 4, 3).mean((1, 3)), atol=0.51
    )


def test_resized_images_rescale_intrinsics(capture):
    frames = [frame("train/a.png", w=16, h=12), frame("train/b.png", w=16, h=12)]
    write_json(capture / "transforms_train.json", frames)
    with pytest.warns(ImageSizeWarning, match=r"a\.png is 8 x 6 pixels instead of 16 x 12 \(and 1"):
        scene = load_scene(capture)
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0], [5, 5.5, 2, 1.5])


def test_unicode_spaces_and_backslashes_in_paths(tmp_path):
    folder = tmp_path / "Büro 写真"
    write_image(folder / "train/één foto.png", value=7)
    write_json(folder / "transforms_train.json", [frame("train\\één foto.png")])
    scene = load_scene(str(folder))
    assert scene.names["train"] == ["één foto"] and int(scene.train.rgb[0, 0, 0, 0]) == 7


def test_names_are_unique(tmp_path):
    listed = ["c0/x.png", "c1/x.png", "c1/x.jpg", "c1_x.png"]
    for name in listed:
        write_image(tmp_path / name)
    write_json(tmp_path / "transforms_train.json", [frame(name) for name in [*listed, listed[0]]])
    with pytest.warns(DuplicateFileWarning, match=r"lists c0/x\.png in more than one frame: the"):
        names = load_scene(tmp_path).names["train"]
    assert names == ["c0_x", "c1_x", "c1_x_2", "c1_x_3"]


def test_names_become_names_of_files(tmp_path):
    """Long names are cut and stay apart; control characters reach neither terminals nor files."""
    long = [f"{'ä' * 120}{i}.png" for i in range(2)]
    listed = [*long, "a\n\x1b[31m.png", "b\udcff.png", "c\u202e.png", "写真 1.png"]
    for name in listed:
        write_image(tmp_path / name)
    write_json(tmp_path / "transforms_train.json", [frame(name) for name in listed])
    names = load_scene(tmp_path).names["train"]
    assert names[2:] == ["a__[31m", "b_", "c_", "写真 1"] and names[0] != names[1]
    assert all(name.startswith("ä" * 50) and len(name.encode()) <= 120 for name in names[:2])
    write_json(tmp_path / "transforms_train.json", [frame(name) for name in listed[1:]])
    assert load_scene(tmp_path).names["train"] == names[1:]


def test_messages_hold_no_control_characters(tmp_path):
    write_image(tmp_path / "a.png")
    listed = "b\n\x1b[31m\udcff\u2028.png"
    write_json(tmp_path / "transforms_train.json", [frame("a.png"), frame(listed)])
    with pytest.raises(SceneError) as error:
        load_scene(tmp_path)
    assert r"(b\n\x1b[31m\udcff\u2028.png)" in str(error.value)
    write_json(tmp_path / "transforms_train.json", [{**frame("a.png"), "\x1b]0;": 1}])
    with pytest.warns(UnknownKeyWarning, match=r"ignored: \\x1b\]0;\."):
        load_scene(tmp_path)
    folder = tmp_path / "c\n"
    single_file(folder, 10)
    scene = load_scene(folder)
    assert scene.name == r"c\n" and not any("\n" in note for note in scene.metadata["notes"])


def test_points_come_with_the_capture(capture):
    rows = vertices()
    write_ply(capture / "points3d.ply", rows)
    np.testing.assert_allclose(own_points(load_scene(capture))[:, 0], rows["x"], rtol=1e-6)
    write_ply(capture / "other.ply", rows[:2])
    frames = [frame("train/a.png")]
    write_json(capture / "transforms_train.json", frames, ply_file_path="other.ply")
    assert load_scene(capture).points.shape == (2, 3)


@pytest.mark.parametrize("given", [{"near": None, "far": None}, {"near": 0.5, "far": None}])
def test_missing_near_far_is_estimated(capture, given):
    write_json(capture / "transforms_train.json", [frame("train/a.png")], **given)
    with pytest.warns(
        NearFarWarning, match="far; estimated near 0\\.[15] and far 100 from the pos"
    ):
        scene = load_scene(capture)
    assert 0 < scene.near < scene.far == 100
    assert given["near"] in (None, scene.near)
    rows = vertices()
    rows["z"] = -7
    rows["x"], rows["y"] = 1, 2
    write_ply(capture / "points3d.ply", rows)
    with pytest.warns(NearFarWarning, match="from the points"):
        scene = load_scene(capture)
    limits = np.array([scene.near, scene.far]) / scene.placement.scale
    np.testing.assert_allclose(limits, [given["near"] or 7, 15])


def test_names_of_built_in_scenes(monkeypatch, tmp_path, capture):
    monkeypatch.setattr(load_module, "DRAWN_SCENES", ("table", "room"))

    def drawn(name, *, downscale):
        return types.SimpleNamespace(name=name, downscale=downscale, train=range(3))

    monkeypatch.setattr(load_module, "draw_scene", drawn)
    scene = load_scene("table", downscale=2)
    assert (scene.name, scene.downscale) == ("table", 2)
    with pytest.raises(SceneError, match=r"tabel is neither .* choose one of table, room"):
        load_scene("tabel")
    monkeypatch.chdir(capture.parent)
    assert load_scene(capture.name).names["train"] == ["a", "b"]
    assert load_scene(f"./{capture.name}").name == capture.name


# A real capture.


def test_plush(shared):
    """Points match the photographs where the oracle projects them, but not 4 pixels away."""
    scene = load_scene(shared / "data" / "plush")
    assert (len(scene.train), len(scene.test), len(scene.test_far)) == (49, 11, 7)
    assert scene.train.rgb.shape[1:] == (600, 800, 3) and scene.points.shape == (7548, 3)
    points, colors = scene.points[::8], scene.rgb[::8]
    shifts = [(0, 0), (4, 0), (-4, 0), (0, 4), (0, -4)]
    differences = {shift: [] for shift in shifts}
    for index in (0, 20, 40):
        camera = jax.tree.map(lambda leaf, i=index: np.asarray(leaf[i]), scene.train.cameras)
        pixels, depth = reference.project(camera.camtoworld, camera.intrinsics, points)
        inside = (depth > 0) & (pixels > 4).all(1) & (pixels < [796, 596]).all(1)
        assert inside.mean() > 0.4
        photo = np.asarray(scene.train.rgb[index])
        for shift in shifts:
            column, row = (pixels[inside] + shift).astype(int).T
            seen = photo[row, column] / 255
            differences[shift].append(np.abs(seen - colors[inside]).mean(1))
    medians = [np.median(np.concatenate(differences[shift])) for shift in shifts]
    assert medians[0] < 0.08  # about half of 0.15, the median for points in random order
    assert medians[0] < 0.75 * min(medians[1:]), medians


def test_plush_downscaled(shared):
    scene = load_scene(shared / "data" / "plush", downscale=4)
    assert scene.test.rgb.shape == (11, 150, 200, 3)
    np.testing.assert_allclose(
        scene.train.cameras.intrinsics[0],
        [670.93612 / 4, 667.77012 / 4, 400.56091 / 4, 302.70823 / 4],
        rtol=1e-6,
    )
