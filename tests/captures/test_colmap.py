import json
import re
import sys

import jax
import numpy as np
import pytest
import reference
from tiny_capture import (
    HEIGHT,
    POINTS,
    WIDTH,
    colmap_capture,
    image_line,
    own_points,
    own_poses,
    random_pose,
    single_file,
    write_image,
    write_model,
    write_ply,
)

from jaxcloseup.captures import folder as folder_module
from jaxcloseup.captures.load import SceneError, load_scene


pycolmap = pytest.importorskip("pycolmap")


def to_binary(model, *, rigs=True):
    """Rewrite a text model as a binary one, with or without the rigs and frames of COLMAP 3.12."""
    reconstruction = pycolmap.Reconstruction()
    reconstruction.read_text(str(model))
    for file in model.glob("*.txt"):
        file.unlink()
    reconstruction.write_binary(str(model))
    if not rigs:
        (model / "rigs.bin").unlink()
        (model / "frames.bin").unlink()


@pytest.mark.parametrize("model", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_folders(tmp_path, model, caplog):
    colmap_capture(tmp_path, 3, model=model)
    with caplog.at_level("INFO", "jaxcloseup"):
        scene = load_scene(tmp_path)
    assert f"{tmp_path.name}: reading the COLMAP model in {model}" in caplog.messages
    assert scene.metadata["notes"] == tuple(caplog.messages)
    assert scene.names == {"train": ["001", "002"], "test_far": ["000"]}
    np.testing.assert_allclose(scene.train.cameras.intrinsics, [[10, 11, 4, 3]] * 2)
    np.testing.assert_allclose(own_points(scene)[0], [-2, 0.5, 5], rtol=1e-6)
    np.testing.assert_allclose(scene.rgb[4], [50 / 255, 20 / 255, 1], rtol=1e-6)
    assert scene.train.rgb[:, 0, 0, 0].tolist() == [1, 2]
    assert scene.metadata["format"] == "colmap" and scene.name == tmp_path.name
    by_model = load_scene(tmp_path / model)
    assert by_model.name == tmp_path.name and by_model.names == scene.names


@pytest.mark.parametrize("rigs", [True, False])
def test_binary_and_text_models_agree(tmp_path, rigs):
    colmap_capture(tmp_path)
    text = load_scene(tmp_path)
    to_binary(tmp_path / "sparse/0", rigs=rigs)
    binary = load_scene(tmp_path)
    jax.tree.map(np.testing.assert_array_equal, binary.train, text.train)
    np.testing.assert_array_equal(binary.points, text.points)
    assert (binary.near, binary.far, binary.names) == (text.near, text.far, text.names)


def test_poses_are_world_to_camera(tmp_path):
    """Points project to where COLMAP's own formula, x = R X + t, puts them."""
    rng = np.random.default_rng(1)
    rotation, quaternion, position = random_pose(rng)
    pose = " ".join(map(str, [*quaternion, *position]))
    write_image(tmp_path / "images/deep/a.png")
    write_model(tmp_path / "sparse/0", [image_line(7, "deep/a.png", pose), ""], points=())
    with pytest.warns(UserWarning, match=r"images\.txt: no near and far; estimated .* from the"):
        scene = load_scene(tmp_path)
    inside = rng.uniform([-1, -1, 3], [1, 1, 5], (20, 3))
    pixels, depth = reference.project(
        own_poses(scene)[0], [10, 11, 4, 3], (inside - position) @ rotation
    )
    expected = inside[:, :2] / inside[:, 2:] * [10, 11] + [4, 3]
    np.testing.assert_allclose(pixels, expected, atol=1e-4)
    np.testing.assert_allclose(depth, inside[:, 2], rtol=1e-5)


@pytest.mark.parametrize(
    ("camera", "lens"),
    [
        ("SIMPLE_PINHOLE 8 6 10 4 3", [10, 10, 4, 3]),
        ("SIMPLE_RADIAL 8 6 10 4 3 0.1", [10, 10, 4, 3]),
        ("RADIAL 8 6 10 4 3 0.1 0.01", [10, 10, 4, 3]),
        ("OPENCV 8 6 10 11 4 3 0.1 0.01 0.02 0.03", [10, 11, 4, 3]),
        ("FULL_OPENCV 8 6 10 11 4 3 0.1 0.01 0.02 0.03 0.01 0.02 0.03 0.04", [10, 11, 4, 3]),
        ("OPENCV_FISHEYE 8 6 10 11 4 3 0.1 0.01 0.02 0.03", [10, 11, 4, 3]),
        ("SIMPLE_RADIAL_FISHEYE 8 6 10 4 3 0.1", [10, 10, 4, 3]),
        ("RADIAL_FISHEYE 8 6 10 4 3 0.1 0.01", [10, 10, 4, 3]),
    ],
)
def test_camera_models(tmp_path, camera, lens):
    """A distorted lens gives the same photographs as the same lens in transforms.json."""
    colmap_capture(tmp_path, cameras=[f"1 {camera}"])
    for i in range(3):
        ramp = np.arange(HEIGHT * WIDTH * 3, dtype=np.uint8).reshape(HEIGHT, WIDTH, 3)
        write_image(tmp_path / f"images/{i:03d}.png", ramp + i)
    scene = load_scene(tmp_path)
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0], lens)
    model, _, _, *values = camera.split()
    names = {"FULL_OPENCV": "k1 k2 p1 p2 k3 k4 k5 k6", "OPENCV": "k1 k2 p1 p2"}
    names = names.get(model, "k1 k2 k3 k4").split()
    values = [float(value) for value in values[2 + len(set(lens[:2])) :]]
    fields = dict(zip(["fl_x", "fl_y", "cx", "cy"], map(float, lens), strict=True))
    fields |= dict(zip(names, values, strict=False)) | {"camera_model": model}
    pixels = [(tmp_path / f"images/{i:03d}.png").read_bytes() for i in range(3)]
    single_file(tmp_path, 3)
    for i, data in enumerate(pixels):
        (tmp_path / f"images/{i:03d}.png").write_bytes(data)
    listing = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").write_text(json.dumps({**listing, **fields}))
    other = load_scene(tmp_path, format="transforms")
    np.testing.assert_array_equal(other.train.rgb, scene.train.rgb)
    np.testing.assert_array_equal(other.train.weight, scene.train.weight)


def test_two_formats_in_one_folder(tmp_path):
    colmap_capture(tmp_path)
    single_file(tmp_path, 3)
    name = tmp_path.name
    note = f"{name}: reading transforms.json and not the COLMAP model in sparse/0"
    assert load_scene(tmp_path).metadata["notes"][0] == note
    scene = load_scene(tmp_path, format="colmap")
    assert scene.metadata["notes"][0] == f"{name}: reading the COLMAP model in sparse/0"


def test_points_that_training_does_not_see_are_dropped(tmp_path):
    for i in range(3):
        write_image(tmp_path / f"images/{i:03d}.png")
    seen = ["4 3 1 4 3 2", "4 3 1", "4 3 1 4 3 2"]  # the first photograph is held out
    pose = "1 0 0 0 0.1 0 0"  # the point is well inside the image
    lines = [part for i in range(3) for part in (image_line(i + 1, f"{i:03d}.png", pose), seen[i])]
    points = [f"{POINTS[0]} 1 0 2 0 3 0", f"{POINTS[1]} 1 1 3 1"]
    write_model(tmp_path / "sparse", lines, points=points)
    scene = load_scene(tmp_path)
    np.testing.assert_allclose(own_points(scene), [[-2, 0.5, 5]], rtol=1e-6)
    assert "dropped 1 of 2 points, which fewer than two training" in scene.metadata["notes"][-1]


@pytest.mark.parametrize("rigs", [None, True])
def test_files_in_another_case(tmp_path, rigs):
    """RealityCapture writes such, beside the photographs; a byte order mark may come first."""
    colmap_capture(tmp_path)
    expected = load_scene(tmp_path)
    model = tmp_path / "sparse/0"
    if rigs:
        to_binary(model)
    else:
        (model / "images.txt").write_bytes(b"\xef\xbb\xbf" + (model / "images.txt").read_bytes())
    for path in [*model.iterdir(), *(tmp_path / "images").iterdir()]:
        (tmp_path / "flat").mkdir(exist_ok=True)
        path.rename(tmp_path / "flat" / path.name.capitalize())
    scene = load_scene(tmp_path / "flat")
    assert scene.name == "flat" and scene.names == expected.names
    jax.tree.map(np.testing.assert_array_equal, scene.train, expected.train)
    np.testing.assert_array_equal(scene.points, expected.points)


@pytest.mark.filterwarnings("ignore:.*no near and far")
def test_names_with_spaces(tmp_path):
    """A name is not what stands before its first space, and the last line may be missing."""
    names = ["my photos/a.png", "my photos/a.png edited.png", "my  photos/b é (1).png"]
    for i, name in enumerate(names):
        write_image(tmp_path / "images" / name, value=i)
    lines = [part for i, name in enumerate(names) for part in (image_line(9 - i, name), "")]
    write_model(tmp_path / "sparse/0", lines[:-1], points=())
    scene = load_scene(tmp_path, split="every8")
    files = [*scene.metadata["files"]["test_far"], *scene.metadata["files"]["train"]]
    assert files == [tmp_path / "images" / name for name in sorted(names)]
    assert scene.test_far.rgb[0, 0, 0, 0] == 2
    assert scene.train.rgb[:, 0, 0, 0].tolist() == [0, 1]


@pytest.mark.parametrize("binary", [False, True])
def test_the_largest_of_several_models_is_read(tmp_path, binary):
    for number, count in enumerate([3, 4, 2]):
        colmap_capture(tmp_path, count, model=f"sparse/{number}")
        if binary:
            to_binary(tmp_path / f"sparse/{number}")
    scene = load_scene(tmp_path)
    assert sum(map(len, scene.names.values())) == 4
    assert scene.metadata["notes"][0].endswith(
        "reading the COLMAP model in sparse/1 (4 photographs) and not the COLMAP model in sparse/0 "
        "(3 photographs) or the COLMAP model in sparse/2 (2 photographs)"
    )
    named = load_scene(tmp_path / "sparse/0")
    assert sum(map(len, named.names.values())) == 3
    assert f"{named.name}: not used: 1 images in images/" in named.metadata["notes"]


@pytest.mark.parametrize("ply", [False, True])
def test_points_that_no_image_observes(tmp_path, ply):
    """They are kept, and seen where they project: the nearest photograph is held out."""
    depths = [8.0, 8.2, 4.0, 8.6]
    poses = [f"1 0 0 0 0 0 {depth - 5}" for depth in depths]
    for i in range(4):
        write_image(tmp_path / f"images/{i}.png")
    lines = [
        part for i, pose in enumerate(poses) for part in (image_line(i + 1, f"{i}.png", pose), "")
    ]
    write_model(tmp_path / "sparse/0", lines)
    if ply:
        (tmp_path / "sparse/0/points3D.txt").unlink()
        rows = np.zeros(5, [(axis, "f4") for axis in "xyz"])
        rows["x"], rows["y"], rows["z"] = np.arange(5) - 2, 0.5, 5
        write_ply(tmp_path / "sparse/0/points3D.ply", rows)
    scene = load_scene(tmp_path, split="closest")
    points = scene.placement.to_capture(scene.points)
    np.testing.assert_allclose(points, [[i - 2, 0.5, 5] for i in range(5)], atol=1e-5)
    assert scene.names["test"] == ["2"] and "seen" not in scene.metadata
    about = [note.split(": ", 1)[1] for note in scene.metadata["notes"][1:3]]
    said = [
        "its points are those of points3D.ply",
        "points3D.ply has no colors: its points are gray",
    ]
    assert (about == said) is ply
    assert sum(map(len, load_scene(tmp_path).names.values())) == 4


def test_pycolmap_is_not_installed(tmp_path, monkeypatch):
    colmap_capture(tmp_path)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(SceneError, match=r"pycolmap.*pip install 'jaxcloseup\[colmap\]'"):
        load_scene(tmp_path)


# A real capture.


def test_plush_loads_three_ways(shared, monkeypatch):
    none = np.zeros((0, 3), np.float32)
    monkeypatch.setattr(
        folder_module, "triangulate", lambda *_: (none, none, none)
    )  # would take seconds
    folder = shared / "data" / "plush_raw"
    binary = load_scene(folder, format="colmap")
    text = load_scene(folder / "sparse_text")
    with pytest.warns(UserWarning, match="from the poses"):
        listed = load_scene(folder)
    assert listed.metadata["format"] == "transforms"
    unit = binary.placement.scale
    assert binary.near < 1.2 * unit and 10 * unit < binary.far < 30 * unit
    corners = np.array([[0.5, 0.5], [639.5, 0.5], [320, 240], [0.5, 479.5], [639.5, 479.5]])
    for other in (text, listed):
        assert other.names == binary.names
        for split, count in (("train", 49), ("test", 11), ("test_far", 7)):
            ours, theirs = jax.device_get((getattr(binary, split), getattr(other, split)))
            assert len(ours) == count
            for i in range(count):
                one = jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i], float), ours.cameras)
                two = jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i], float), theirs.cameras)
                rays = np.column_stack(
                    [(corners - one.intrinsics[2:]) / one.intrinsics[:2], [1] * 5]
                )
                for depth in (binary.near, binary.far):
                    points = depth * rays @ one.camtoworld[:, :3].T + one.camtoworld[:, 3]
                    pixels, _ = reference.project(two.camtoworld, two.intrinsics, points)
                    np.testing.assert_allclose(pixels, corners, atol=0.05)
            difference = abs(ours.rgb.astype(int) - theirs.rgb)
            assert difference.max() <= 1
            np.testing.assert_array_equal(ours.weight, theirs.weight)


def test_points_of_plush_project_to_where_they_were_measured(shared):
    """The model's points match the undistorted photographs where they project."""
    scene = load_scene(shared / "data" / "plush_raw", format="colmap")
    points, colors = scene.points[::8], scene.rgb[::8]
    differences = {shift: [] for shift in [(0, 0), (4, 0), (-4, 0), (0, 4), (0, -4)]}
    for index in (0, 20, 40):
        camera = jax.tree.map(lambda leaf, i=index: np.asarray(leaf[i]), scene.train.cameras)
        pixels, depth = reference.project(camera.camtoworld, camera.intrinsics, points)
        inside = (depth > 0) & (pixels > 4).all(1) & (pixels < [636, 476]).all(1)
        photo = np.asarray(scene.train.rgb[index])
        for shift, found in differences.items():
            column, row = (pixels[inside] + shift).astype(int).T
            found.append(np.abs(photo[row, column] / 255 - colors[inside]).mean(1))
    medians = [np.median(np.concatenate(found)) for found in differences.values()]
    assert medians[0] < 0.8 * min(medians[1:]), medians


def test_closest_of_plush_are_nearer(shared, monkeypatch):
    folder = shared / "data" / "plush_raw"
    scene = load_scene(folder, format="colmap", split="closest")
    assert (len(scene.train), len(scene.test), len(scene.test_far)) == (76, 10, 11)
    ratios = scene.metadata["times_nearer"]
    assert len(ratios) == 10 and min(ratios) > 1.5
    assert "test is the 10 nearest of 97 photographs, 1.9" in scene.metadata["notes"][1]
    # transforms.json lists no points, but the photographs' features give some.
    monkeypatch.setattr(folder_module, "_MEASURED_SIDE", 320)
    with pytest.warns(UserWarning, match="from the points"):
        by_features = load_scene(folder, split="closest", downscale=4)
    assert re.search(r"97 photographs by \d+ points triangulated", by_features.metadata["notes"][1])
    assert len(set(by_features.names["test"]) & set(scene.names["test"])) >= 8
    np.testing.assert_allclose(
        np.median(by_features.metadata["times_nearer"]), np.median(ratios), rtol=0.1
    )
