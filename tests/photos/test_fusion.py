"""Fused distances and meshes: planes and a sphere, whose distances are known, and a kept run."""

import dataclasses
import functools
import importlib.util
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from absl import flags
from absl.testing import flagsaver
from tiny_runs import HALF

from jaxcloseup.app.cli import mesh as program
from jaxcloseup.app.score import mesh_error
from jaxcloseup.app.store import stored_run
from jaxcloseup.app.view import meshing, surface
from jaxcloseup.artifacts.mesh_files import Mesh, surface_mesh, write_mesh
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_rays
from jaxcloseup.io.ply import read_vertices
from jaxcloseup.photos.fusion import fuse, fuse_grid, prepare_depth_maps
from jaxcloseup.photos.scene import Surface
from jaxcloseup.photos.views import camera_at


fuse_points, fuse_on_grid = jax.jit(fuse), jax.jit(fuse_grid, static_argnames="shape")


@pytest.fixture(scope="module")
def views():
    heights = ((-1.0, 4.0, 0.4), (0.0, 3.0, 0.0), (1.0, 5.0, -0.6))
    return plane.make_views([plane.camera_above(x, 0.0, z, tilt=tilt) for x, z, tilt in heights])


def pixels_of(camera, points):
    """Continuous pixels `[N, 2]` and z-depths `[N]` of points, in float64."""
    fx, fy, cx, cy = np.asarray(camera.intrinsics, np.float64)
    pose = np.asarray(camera.camtoworld, np.float64)
    x, y, z = ((points - pose[:, 3]) @ pose[:, :3]).T
    return np.stack([fx * x / z + cx, fy * y / z + cy], -1), z


def ray_of(camera, pixels):
    """Directions `[N, 3]` of unit camera-z through pixels, in float64."""
    fx, fy, cx, cy = np.asarray(camera.intrinsics, np.float64)
    x, y = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
    return np.stack([x, y, np.ones_like(x)], -1) @ np.asarray(camera.rotation, np.float64).T


def test_no_points_are_no_error(views):
    shots, depths = views
    maps = prepare_depth_maps(shots.cameras, depths, shots.weight)
    assert fuse_points(jnp.zeros((0, 3)), maps, 0.4, shots.rgb).distance.shape == (0,)


def test_distances_to_a_plane_are_exact_from_any_angle(views):
    shots, depths = views
    points = np.random.default_rng(0).uniform([-2, -2, -0.6], [2, 2, 0.6], (500, 3))
    maps = prepare_depth_maps(shots.cameras, depths, shots.weight)
    found = fuse_points(jnp.asarray(points, jnp.float32), maps, 0.4, shots.rgb)
    seen, sure = np.zeros(500, bool), np.ones(500, bool)
    for i in range(len(shots)):
        camera = camera_at(shots.cameras, i)
        pixels, z = pixels_of(camera, points)
        ends = np.array([[0.5, 0.5], [plane.WIDTH - 0.5, plane.HEIGHT - 0.5]])
        inside = ((pixels > ends[0]) & (pixels < ends[1])).all(1) & (z > 0)
        sure &= np.abs(pixels[:, None] - ends).min((1, 2)) > 0.01
        # The plane is so far behind the point, in z-depth.
        behind = -points[:, 2] / np.abs(ray_of(camera, pixels)[:, 2])
        seen, sure = seen | (inside & (behind <= 0.4)), sure & (np.abs(behind - 0.4) > 1e-3)
    distance = np.asarray(found.distance)
    np.testing.assert_array_equal(np.isfinite(distance)[sure], seen[sure])
    known, expected = seen & sure, np.clip(points[:, 2] / 0.4, -1, 1)
    np.testing.assert_allclose(distance[known], expected[known], atol=2e-4)
    # Colors are read beside the surface, where the ray through the point meets it.
    near = known & (np.abs(points[:, 2]) < 0.02)
    error = np.abs(np.asarray(found.values)[near] - plane.texture(points * [1, 1, 0])[near])
    assert near.sum() > 5 and error.mean() < 0.02
    assert not np.asarray(found.values)[~seen].any()


def test_views_that_disagree_are_weighed_by_the_cosine(views):
    shots, depths = views
    weight = shots.weight.at[0].set(0.5).at[2].set(0)
    # The second view sees a surface that is 0.1 nearer, which is again a plane: z = 0.1.
    depths = depths.at[1].add(-0.1)
    maps = prepare_depth_maps(shots.cameras, depths, weight)
    point = np.array([[-0.3, 0.2, 0.05]])
    found = fuse_points(jnp.asarray(point, jnp.float32), maps, 0.4, shots.rgb)
    cosines = []
    for position in ((-1.0, 0.0, 4.0), (0.0, 0.0, 3.0)):
        ray = point[0] - position
        cosines.append(abs(ray[2]) / np.linalg.norm(ray))
    weights = np.array([0.5, 1]) * cosines
    expected = np.sum(weights * [0.05, -0.05]) / weights.sum() / 0.4
    assert float(found.distance[0]) == pytest.approx(expected, abs=1e-3)
    assert abs(expected) > 0.02  # the mean with equal weights would be 0


@pytest.fixture(scope="module")
def ball():
    """Exact depth maps of the unit sphere, from its sides and corners."""
    size, poses = 64, []
    for side in itertools.product((-1.0, 0, 1), repeat=3):
        if np.count_nonzero(side) in (1, 3):
            forward = np.array(side) / np.linalg.norm(side)
            right = np.cross(forward, [0.6, 0.8, 0.1])
            right /= np.linalg.norm(right)
            rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
            poses.append(np.concatenate([rotation, -3.5 * forward[:, None]], axis=1))
    lens = jnp.tile(jnp.array([95.0, 95.0, 32.0, 32.0]), (len(poses), 1))
    cameras = Camera(jnp.asarray(np.stack(poses), jnp.float32), lens, size, size)
    depths = []
    for pose in poses:
        x, y = np.meshgrid(*2 * [(np.arange(size) + 0.5 - 32) / 95])
        ray = np.stack([x, y, np.ones_like(x)], -1) @ pose[:, :3].T
        half, power = ray @ pose[:, 3], (ray**2).sum(-1)
        root = half**2 - power * (pose[:, 3] @ pose[:, 3] - 1)
        depths.append(np.where(root > 0, (-half - np.sqrt(np.maximum(root, 0))) / power, 0))
    return cameras, jnp.asarray(np.stack(depths), jnp.float32)


def test_the_mesh_of_a_sphere_is_closed_and_lies_on_it(ball):
    cameras, depths = ball
    maps = prepare_depth_maps(cameras, depths, jnp.ones_like(depths))
    voxel, corner = 0.07, jnp.full(3, -1.22)
    distance = fuse_on_grid(corner, voxel, (35, 36, 37), maps, 4 * voxel)
    assert distance.shape == (35, 36, 37)
    mesh = surface_mesh(np.asarray(distance), np.asarray(corner), voxel, steepest=0.5)
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all() and len(mesh.vertices) - len(count) + len(mesh.faces) == 2
    off = np.linalg.norm(mesh.vertices, axis=1) - 1
    assert np.abs(off).mean() < 0.1 * voxel and np.abs(off).max() < 0.5 * voxel
    first, second, third = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    outward = np.cross(second - first, third - first)
    assert (np.sum(outward * first, axis=1) > 0).mean() > 0.999
    drawn = mesh_error.sample_mesh(np.random.default_rng(0), mesh, 4000)
    # Uniform over the area: each coordinate of a point on a sphere is uniform.
    assert np.histogram(drawn[:, 2], 4, (-1, 1))[0] == pytest.approx(1000, abs=120)


def test_a_mesh_ends_where_nothing_is_known_and_where_neighbors_disagree():
    z = np.tile(np.linspace(-1, 1, 8), (6, 6, 1))
    whole = surface_mesh(z, np.zeros(3), 1.0)
    assert np.ptp(whole.vertices, axis=0).tolist() == [5, 5, 0]
    holed = z.copy()
    holed[:3] = np.nan
    assert surface_mesh(holed, np.zeros(3), 1.0).vertices[:, 0].min() == 3
    step = z.copy()
    step[:3, :, :4] = 1
    step[:3, :, 4:] = -1
    found = surface_mesh(step, np.array([10.0, 0, 0]), 0.5, steepest=0.5)
    assert found.vertices[:, 0].min() == 11.5
    assert len(surface_mesh(np.abs(z), np.zeros(3), 1.0).faces) == 0


def test_a_mesh_is_written_with_its_triangles(tmp_path):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    rgb = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 8, 7]], np.uint8)
    write_mesh(tmp_path / "a.ply", Mesh(vertices, faces, rgb))
    found = read_vertices(tmp_path / "a.ply")
    np.testing.assert_array_equal(np.stack([found[name] for name in "xyz"], -1), vertices)
    names = "red", "green", "blue"
    np.testing.assert_array_equal(np.stack([found[name] for name in names], -1), rgb)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    assert b"element face 2\nproperty list uchar int vertex_indices\n" in header
    expected = b"".join(b"\x03" + face.astype("<i4").tobytes() for face in faces)
    assert body[4 * 15 :] == expected


def test_distances_of_a_mesh_are_those_of_known_planes(monkeypatch):
    monkeypatch.setattr(mesh_error, "_POINTS", 20_000)
    square = np.array([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]], np.float32)
    mesh = Mesh(square, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros((4, 3), np.uint8))
    exact = np.random.default_rng(1).uniform([0, 0, 0.5], [20, 10, 0.5], (40_000, 3))
    found = mesh_error.mesh_error(mesh, exact)
    assert found["extent"] == pytest.approx(20, abs=0.1)
    assert found["mesh_to_surface"] == pytest.approx(0.5, abs=0.02)
    # One half lies above the mesh, the other up to 10 beside it.
    beside = np.hypot(np.linspace(0, 10, 1000), 0.5).mean()
    assert found["surface_to_mesh"] == pytest.approx((0.5 + beside) / 2, abs=0.05)
    assert found["chamfer"] == pytest.approx((0.5 + (0.5 + beside) / 2) / 2, abs=0.04)
    assert (found["mesh_close"], found["surface_close"]) == (0, 0)
    near = mesh_error.mesh_error(mesh, exact - [0, 0, 0.4])
    assert near["mesh_close"] > 0.95 and near["surface_close"] == pytest.approx(0.5, abs=0.03)


@pytest.fixture
def run(kept, tmp_path):
    flags.FLAGS(["mesh"])

    def call(**given):
        given = {"run": str(kept), "output_dir": str(tmp_path / "out"), **given}
        with (
            flagsaver.flagsaver(compilation_cache="", **given),
            jax.numpy_dtype_promotion("standard"),
        ):
            program.main(["mesh"])
        return tmp_path / "out"

    return call


def plane_surface(placement, camera):
    """The exact plane, as a built-in scene would give it; the camera is in the scene's world."""
    origins, directions = pixels_to_rays(camera, pixel_grid(camera.height, camera.width))
    origins = origins / placement.scale + placement.center.astype("f")[None, None]
    depth = -placement.scale * origins[..., 2] / directions[..., 2]
    points = origins + depth[..., None] / placement.scale * directions
    on_it = (jnp.abs(points[..., :2]) < HALF).all(-1)
    return Surface(jnp.full_like(points, 0.5), jnp.where(on_it, depth, 0), jnp.zeros_like(points))


def test_the_mesh_of_a_run_lies_on_the_plane_that_it_shows(run, monkeypatch, capsys):
    monkeypatch.setattr(mesh_error, "_POINTS", 20_000)
    monkeypatch.setattr(surface, "_FINER", 1)
    load = stored_run.load_scene

    def load_with_surface(*args, **options):
        scene = load(*args, **options)
        exact = functools.partial(plane_surface, scene.placement)
        return dataclasses.replace(scene, surface=exact)

    monkeypatch.setattr(stored_run, "load_scene", load_with_surface)
    folder = run(resolution=40)
    found = read_vertices(folder / "mesh.ply")
    assert np.abs(found["z"]).mean() < 0.02
    points = np.stack([found["x"], found["y"], 0 * found["x"]], -1)
    assert np.abs(found["green"] / 255 - plane.texture(points)[:, 1]).mean() < 0.1
    about = json.loads((folder / "mesh.json").read_text())
    assert about["stage"] == "closeup" and about["triangles"] > 1000
    error = about["error"]
    assert error["surface_close"] > 0.9 and error["chamfer"] < 0.02 * error["extent"]
    said = capsys.readouterr().out
    assert "Chamfer distance" in said and "within 1% of the extent" in said
    exact = folder / "exact"
    region = [-1, -0.8, -0.3, 0.9, 1, 0.3]
    run(exact=True, output_dir=str(exact), voxel=0.08, region=list(map(str, region)))
    about = json.loads((exact / "mesh.json").read_text())
    assert about["stage"] is None and about["voxel"] == pytest.approx(0.08)
    np.testing.assert_allclose(np.ravel(about["region"]), region)
    found = read_vertices(exact / "mesh.ply")
    assert np.median(np.abs(found["z"])) < 1e-3  # where views end, more
    assert -1.4 < found["x"].min() < -0.9 and 0.8 < found["x"].max() < 1.3  # and a margin


def test_a_mistake_is_one_sentence(run, monkeypatch):
    monkeypatch.setattr(surface, "_FINER", 1)
    for flags_, sentence in (
        ({"run": "nowhere"}, "--run=nowhere is not a folder"),
        ({"voxel": -1.0}, "--voxel=-1 must be a length above 0"),
        ({"region": ["0", "0", "0", "1", "1"]}, "--region=0,0,0,1,1 must be six finite numbers"),
        ({"region": ["0", "0", "0", "1", "1", "0"]}, "must be six finite numbers"),
        ({"exact": True}, "--exact needs a built-in scene"),
        ({"min_views": 99}, "no pixel shows a surface that 99 training views see"),
        ({"voxel": 1e-5}, "voxels take .* GiB, .* choose a smaller --resolution"),
        ({"region": ["0", "0", "5", "1", "1", "6"]}, "no surface lies in the region"),
    ):
        with pytest.raises(SystemExit, match=f"jaxcloseup mesh: .*{sentence}"):
            run(**flags_)
    with monkeypatch.context() as patch:
        patch.setattr(surface, "seen_points", lambda *_: np.tile([1.0, 2, 3], (5, 1)))
        with pytest.raises(SystemExit, match="all that views see is one point"):
            run()
    monkeypatch.setattr(meshing, "find_detail", None)  # refused before that
    with pytest.raises(SystemExit, match=r"--texture=256 has no room for .* triangles"):
        run(texture=256, resolution=80)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match='install jaxcloseup with the extra "mesh"'):
        run()
