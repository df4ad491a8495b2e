"""A capture in any unit, anywhere and turned becomes the same scene, and is written as it was."""

import json

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_capture import LENS, own_points, own_poses, vertices, write_image, write_json, write_ply

from jaxcloseup.app.run.manifest import write_dataparser_transforms
from jaxcloseup.app.view import camera_files
from jaxcloseup.artifacts.mesh_files import Mesh, write_mesh
from jaxcloseup.artifacts.surfel_ply import read_surfels, write_surfels
from jaxcloseup.captures.load import load_scene
from jaxcloseup.captures.placing import SIZE, find_placement
from jaxcloseup.fields.splats.surfels import surfels_from_points
from jaxcloseup.io.placement import UNMOVED
from jaxcloseup.io.ply import read_vertices


COUNT = 9
UTM = np.array([500_000.0, 5_400_000, 300])
TURN = cv2.Rodrigues(np.array([0.4, -1.1, 2.0]))[0]
WORLDS = {
    "millimeters": (1e-3, np.zeros(3), np.eye(3)),
    "kilometers": (1e3, np.zeros(3), np.eye(3)),
    "a map": (1.0, UTM, np.eye(3)),
    "turned": (1.0, np.zeros(3), TURN),
    "all at once": (1e-3, UTM, TURN),
}
FLIP = np.diag([1.0, -1, -1, 1])


def written(folder, unit=1.0, origin=(0, 0, 0), turn=TURN @ TURN.T):
    """Write a capture with lengths times `unit`; return its OpenCV poses and points, float64."""
    rng = np.random.default_rng(5)
    poses = []
    for i in range(COUNT):
        write_image(folder / f"{i}.png", value=i)
        pose = np.eye(4)
        pose[:3, :3] = turn @ cv2.Rodrigues(rng.normal(size=3))[0]
        pose[:3, 3] = unit * turn @ rng.normal([1, 2, 3], 1.0) + origin
        poses.append(pose)
    lens = {name.replace("f", "fl_"): value for name, value in LENS.items()}
    frames = [
        {"file_path": f"{i}.png", "transform_matrix": (pose @ FLIP).tolist()}
        for i, pose in enumerate(poses)
    ]
    write_json(folder / "transforms.json", frames, **lens, near=0.5 * unit, far=9 * unit)
    types = [(name, "f8" if name in "xyz" else kind) for name, kind in vertices().dtype.descr]
    rows = vertices([(name, kind.lstrip("<|")) for name, kind in types], 40)
    points = unit * rng.normal(size=(40, 3)) @ turn.T + origin
    for i, axis in enumerate("xyz"):
        rows[axis] = points[:, i]
    write_ply(folder / "points3d.ply", rows)
    return np.stack(poses)[:, :3], points


@pytest.fixture(params=WORLDS)
def moved(request, tmp_path):
    """A capture that lies elsewhere: its scene, poses, points, and its world."""
    world = WORLDS[request.param]
    poses, points = written(tmp_path / "moved", *world)
    return load_scene(tmp_path / "moved"), poses, points, world


def test_scenes_are_the_same_in_any_world(tmp_path, moved):
    written(tmp_path / "here")
    here, (scene, poses, points, (unit, _, turn)) = load_scene(tmp_path / "here"), moved
    np.testing.assert_allclose(scene.points, here.points @ turn.T, atol=1e-5)
    ours, theirs = (np.asarray(each.train.cameras.camtoworld) for each in (scene, here))
    np.testing.assert_allclose(ours, turn @ theirs, atol=1e-5)
    np.testing.assert_allclose([scene.near, scene.far], [here.near, here.far], rtol=1e-6)
    distance = 1e-6 * unit
    train = [i for i in range(COUNT) if i % 8]
    np.testing.assert_allclose(own_poses(scene)[..., 3], poses[train, :, 3], rtol=0, atol=distance)
    np.testing.assert_allclose(own_points(scene), points, rtol=0, atol=distance)


def test_every_split_has_the_same_coordinates(tmp_path):
    written(tmp_path, 30.0, UTM)
    whole, few = load_scene(tmp_path), load_scene(tmp_path, photographs=3)
    np.testing.assert_array_equal(whole.placement.center, few.placement.center)
    assert whole.placement.scale == few.placement.scale
    finer = np.stack([photograph.camera.camtoworld for photograph in few.photographs_at(1)])
    np.testing.assert_array_equal(finer, few.train.cameras.camtoworld)


def test_a_stray_camera_and_point_move_nothing_much():
    rng = np.random.default_rng(0)
    positions = rng.normal(7, 2, (30, 3))
    whole = find_placement(positions, np.zeros((0, 3)))
    points = rng.normal(7, 2, (9, 3))
    positions[4] = points[2] = 1e6
    stray = find_placement(positions, points)
    assert np.linalg.norm(whole.to_scene(stray.center)) < 0.1 * SIZE
    assert abs(stray.scale / whole.scale - 1) < 0.1
    here = np.linalg.norm(whole.to_scene(np.delete(positions, 4, 0)), axis=1)
    assert np.median(here) == pytest.approx(SIZE, rel=0.1)


def test_files_have_the_coordinates_of_the_capture(tmp_path, moved):
    """Splats and a mesh of the scene's points lie at the capture's, less what headers say."""
    scene, _, points, (unit, origin, _) = moved
    surfels, alive = surfels_from_points(
        jnp.array([0, 1], jnp.uint32),
        jnp.asarray(scene.points),
        jnp.asarray(scene.rgb),
        capacity=40,
        sh_degree=0,
    )
    splats, mesh = tmp_path / "splats.ply", tmp_path / "mesh.ply"
    write_surfels(splats, surfels, alive, placement=scene.placement)
    faces = np.zeros((1, 3), np.int32)
    write_mesh(mesh, Mesh(scene.points, faces, np.zeros((40, 3), np.uint8)), scene.placement)
    for file in (splats, mesh):
        header = file.read_bytes().split(b"end_header")[0].decode()
        said = [line.split()[3:] for line in header.splitlines() if "comment add offset" in line]
        assert bool(said) == origin.any()
        offset = np.array(said[0], float) if said else np.zeros(3)
        rows = read_vertices(file)
        found = np.stack([rows[axis] for axis in "xyz"], axis=-1) + offset
        np.testing.assert_allclose(found, points, rtol=0, atol=1e-6 * unit * 8)
    sizes = jnp.exp(read_surfels(splats).log_scales - surfels.log_scales)
    np.testing.assert_allclose(sizes, 1 / scene.placement.scale, rtol=1e-5)


@pytest.mark.parametrize("applied_scale", [1.0, 2.5])
def test_a_camera_path_is_in_the_coordinates_of_the_capture(tmp_path, moved, applied_scale):
    """So is one that was made beside a run's files, whose offset the run's transform adds."""
    scene, poses, _, _ = moved
    scene.metadata["applied_scale"] = applied_scale
    write_dataparser_transforms(tmp_path, scene)
    transform = camera_files.read_camera_transform(tmp_path / "dataparser_transforms.json")
    for offset in (np.zeros(3), scene.placement.offset):
        pose = np.vstack([poses[1], [0, 0, 0, 1]])
        pose[:3, 3] -= offset
        camera = {"camera_to_world": (pose @ FLIP).ravel().tolist(), "fov": 40}
        file = tmp_path / "camera_path.json"
        path = {"render_height": 8, "render_width": 8, "camera_path": [camera]}
        file.write_text(json.dumps(path))
        shots = camera_files.read_camera_path(file)
        if offset.any():
            shots = camera_files.to_capture(shots, *transform, scene)
        found = camera_files.to_scene(shots, scene).cameras.camtoworld
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found[0], scene.train.cameras.camtoworld[0], atol=1e-6)


def test_offsets_are_round_and_only_where_needed():
    points = np.zeros((0, 3))
    cameras = np.array([[0.0, 0, 0], [20, 0, 0], [0, 20, 0], [0, 0, 20]])
    far = find_placement(cameras + np.array([500_123.4, 5_400_567.8, 300]), points)
    np.testing.assert_array_equal(far.offset, [500_127, 5_400_571, 303])
    near = find_placement(cameras + 1000, points)
    assert not near.offset.any() and not UNMOVED.offset.any()
