"""Camera paths, orbits and dollies against poses that are known."""

import dataclasses
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from tiny_capture import single_file
from tiny_runs import path_file

from jaxcloseup.app.run.manifest import write_dataparser_transforms
from jaxcloseup.app.view import camera_files, camera_paths
from jaxcloseup.app.view.camera_files import read_camera_path
from jaxcloseup.app.view.camera_paths import CameraError, check_pixel, dolly, focus_point
from jaxcloseup.app.view.orientation import up_direction
from jaxcloseup.captures.load import SceneError, load_scene
from jaxcloseup.geometry.cameras import Camera, pixels_to_points, points_to_pixels
from jaxcloseup.photos.views import camera_at


def test_a_camera_path_has_the_cameras_that_nerfstudio_shows(tmp_path):
    shots = read_camera_path(path_file(tmp_path))
    expected = plane.camera_above(0.3, 0.1, 2.0, tilt=0.2)
    assert shots.names == ["0000", "0001"] and shots.fps == 24
    for i, fov in enumerate((40, 20)):
        camera = camera_at(shots.cameras, i)
        assert (camera.height, camera.width) == (24, 32)
        np.testing.assert_allclose(camera.camtoworld, expected.camtoworld, atol=1e-6)
        # The rays at the top and at the bottom are `fov` apart.
        focal = 12 / math.tan(math.radians(fov / 2))
        np.testing.assert_allclose(camera.intrinsics, [focal, focal, 16, 12], rtol=1e-6)


@pytest.mark.parametrize(("changes", "fps"), [({"fps": None}, 1.0), ({"seconds": None}, 24)])
def test_fps_or_seconds_give_frames_per_second(tmp_path, changes, fps):
    assert read_camera_path(path_file(tmp_path, **changes)).fps == fps


def random_similarity(rng):
    """Return a rotation with a translation, `[3, 4]`, and a scale."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    q[:, 0] *= np.linalg.det(q)
    return np.column_stack([q, rng.normal(size=3)]), rng.uniform(0.1, 3)


# As nerfstudio's ns-process-data writes it.
APPLIED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])


@pytest.mark.parametrize(("applied", "applied_scale"), [(None, 1.0), (APPLIED, 1.0), (None, 2.5)])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_nerfstudio_path_maps_back_to_the_capture(
    tmp_path, capture_folder, applied, applied_scale, seed
):
    """The mapped camera shows the capture's points as nerfstudio's camera shows its own."""
    scene = load_scene(str(capture_folder))
    scene.metadata.update(applied_transform=applied, applied_scale=applied_scale)
    rng = np.random.default_rng(seed)
    transform, scale = random_similarity(rng)
    original = rng.normal(size=(20, 3))
    theirs = scale * (original @ transform[:, :3].T + transform[:, 3])
    ours = original if applied is None else original @ applied[:, :3].T + applied[:, 3]
    file = tmp_path / "dataparser_transforms.json"
    # The recorded scale includes the applied scale; the cameras do not.
    recorded = {"transform": transform.tolist(), "scale": scale * applied_scale}
    file.write_text(json.dumps(recorded))
    shots = read_camera_path(path_file(tmp_path))
    back = camera_files.to_capture(shots, *camera_files.read_camera_transform(file), scene)
    pose = np.asarray(shots.cameras.camtoworld[0], np.float64)
    seen = (theirs - pose[:, 3]) @ pose[:, :3]  # in the camera's frame
    pose = np.asarray(back.cameras.camtoworld[0], np.float64)
    np.testing.assert_allclose((ours - pose[:, 3]) @ pose[:, :3], seen / scale, atol=1e-5)
    np.testing.assert_allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), atol=1e-5)
    np.testing.assert_array_equal(back.cameras.intrinsics, shots.cameras.intrinsics)


@pytest.mark.parametrize("applied", [None, APPLIED])
def test_the_transform_that_a_run_writes_keeps_its_own_coordinates(
    tmp_path, capture_folder, applied
):
    scene = load_scene(str(capture_folder))
    scene.metadata.update(applied_transform=applied, applied_scale=2.0)
    write_dataparser_transforms(tmp_path, scene)
    file = tmp_path / "dataparser_transforms.json"
    written = json.loads(file.read_text())
    assert written["scale"] == 2
    np.testing.assert_array_equal(
        written["transform"], np.eye(3, 4) if applied is None else applied
    )
    shots = read_camera_path(path_file(tmp_path))
    back = camera_files.to_capture(shots, *camera_files.read_camera_transform(file), scene)
    np.testing.assert_allclose(back.cameras.camtoworld, shots.cameras.camtoworld, atol=1e-6)


def test_a_transform_of_another_capture_raises_one_sentence(tmp_path, capture_folder):
    scene = load_scene(str(capture_folder))
    scene.metadata["applied_transform"] = 2 * APPLIED
    shots = read_camera_path(path_file(tmp_path))
    with pytest.raises(SceneError, match="applied_transform after --camera_transform is not rigid"):
        camera_files.to_capture(shots, APPLIED, 1.0, scene)


RIGID = np.eye(3, 4).tolist()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"scale": 1}, "transform must be a 4x4 matrix"),
        ({"transform": RIGID[:2], "scale": 1}, "transform must be a 4x4 matrix"),
        ({"transform": [[math.nan] * 4, *RIGID[1:]], "scale": 1}, "a value that is not finite"),
        ({"transform": [[1.01, 0, 0, 0], *RIGID[1:]], "scale": 1}, "transform is not rigid"),
        ({"transform": [[-1, 0, 0, 0], *RIGID[1:]], "scale": 1}, "transform mirrors space"),
        ({"transform": RIGID}, "scale must be a finite number"),
        ({"transform": RIGID, "scale": 0}, "scale must be greater than 0"),
        ([], "not an object with a transform and a scale"),
    ],
)
def test_a_broken_camera_transform_raises_one_sentence(tmp_path, fields, message):
    file = tmp_path / "t.json"
    file.write_text(json.dumps(fields))
    with pytest.raises(SceneError, match=message) as error:
        camera_files.read_camera_transform(file)
    assert "t.json" in str(error.value) and "\n" not in str(error.value)


FLAT = np.eye(4).ravel().tolist()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"render_height": None}, "render_height is missing"),
        ({"render_width": 31.5}, "render_width must be a whole number"),
        (
            {"render_height": 1e9},
            "render_width and render_height: frames of 32 x 1000000000 pixels",
        ),
        ({"render_height": 1e300}, "render_height must be a whole number of pixels, not 1e"),
        ({"render_height": "tall"}, "render_height must be a finite number"),
        ({"camera_path": None}, "camera_path must be a list"),
        ({"camera_path": []}, "camera_path must be a list of at least one camera"),
        ({"camera_path": [3]}, r"camera_path\[0\] must be an object"),
        ({"camera_type": "fisheye"}, "camera_type is 'fisheye'"),
        ({"fps": 0}, "fps and seconds must be positive"),
        ({"camera_to_world": None}, r"camera_path\[1\]: camera_to_world is missing"),
        ({"camera_to_world": FLAT[:15]}, r"camera_path\[1\]: camera_to_world must be 16 finite"),
        ({"camera_to_world": ["a"] * 16}, "must be 16 finite numbers"),
        ({"camera_to_world": [math.nan, *FLAT[1:]]}, "must be 16 finite numbers"),
        ({"camera_to_world": [*FLAT[:12], 1, 2, 3, 1]}, "may be transposed"),
        ({"camera_to_world": [2, *FLAT[1:]]}, "not a rotation and a position"),
        ({"camera_to_world": [1e300, *FLAT[1:]]}, "not a rotation and a position"),
        ({"camera_to_world": [-1, *FLAT[1:]]}, "not a rotation and a position"),
        ({"fov": None}, r"camera_path\[1\]: fov is missing"),
        ({"fov": 180}, "fov must be between 0 and 180"),
        ({"fov": 1e-300}, "fov of 1e-300 degrees is too small for any lens"),
        ({"camera_to_world": [*FLAT[:3], 1e39, *FLAT[4:]]}, "is more than 1e\\+12 away"),
    ],
)
def test_a_broken_camera_path_raises_one_sentence(tmp_path, changes, message):
    with pytest.raises(CameraError, match=message) as error:
        read_camera_path(path_file(tmp_path, **changes))
    assert "path.json" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"{", "not JSON at line 1"),
        (b"[]", "not an object"),
        (b"\xff", "not UTF-8"),
        (None, "read"),
    ],
)
def test_a_file_without_a_camera_path_raises_one_sentence(tmp_path, text, message):
    if text is not None:
        (tmp_path / "a.json").write_bytes(text)
    with pytest.raises(CameraError, match=message):
        read_camera_path(tmp_path / "a.json")


def test_a_dolly_ends_magnification_times_nearer_and_grows_evenly():
    camera, pixel = plane.camera_above(0.3, 0.0, 4.0, tilt=0.3), (20.5, 7.5)
    depth = float(plane.photograph(camera)[1][7, 20])
    shots = dolly(camera, pixel, depth, magnification=4.0, frames=5)
    anchor = pixels_to_points(camera, jnp.array(pixel), jnp.float32(depth))
    sizes = []
    for i in range(5):
        one = camera_at(shots.cameras, i)
        np.testing.assert_array_equal(one.rotation, camera.rotation)
        # A short rod at the anchor, parallel to the image.
        ends = anchor[None] + jnp.array([[-0.01], [0.01]]) * camera.rotation[None, :, 0]
        (left, right), _ = points_to_pixels(one, ends)
        np.testing.assert_allclose((left + right) / 2, pixel, atol=1e-3)
        sizes.append(float(right[0] - left[0]))
    np.testing.assert_allclose(np.array(sizes) / sizes[0], 4 ** (np.arange(5) / 4), rtol=1e-3)
    np.testing.assert_allclose(shots.cameras.position[0], camera.position, atol=1e-6)
    (last,) = dolly(camera, pixel, depth, magnification=4.0, frames=1).cameras.position
    np.testing.assert_allclose(last, shots.cameras.position[-1], atol=1e-6)


@pytest.mark.parametrize("pixel", [(-0.1, 3), (32, 3), (3, 24), (math.nan, 3)])
def test_a_pixel_outside_raises_one_sentence(pixel):
    camera = plane.camera_above(0, 0, 1)
    check_pixel(camera, (31.9, 0))
    with pytest.raises(CameraError, match=r"--pixel=.* is outside .* 32 x 24 pixels"):
        check_pixel(camera, pixel)


def ring(center, radius, height, count=12):
    """Return stacked cameras on a circle `height` above a center, looking at the center."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        position = center + np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        poses.append(camera_paths.look_at(position, center, np.array([0.0, 0, 1])))
    intrinsics = jnp.tile(jnp.array([40.0, 40, 16, 12]), (count, 1))
    return Camera(jnp.asarray(np.array(poses), jnp.float32), intrinsics, 24, 32)


def test_an_orbit_recovers_cameras_that_stand_on_a_circle(capture_folder):
    scene = load_scene(str(capture_folder))
    center = np.array([1.0, -2.0, 0.5])
    cameras = ring(center, 3.0, 2.0)
    train = scene.train.replace(cameras=cameras)
    scene = dataclasses.replace(scene, train=train, near=0.1, far=10.0)
    shots = camera_paths.orbit(scene, 12)
    np.testing.assert_allclose(shots.cameras.camtoworld, cameras.camtoworld, atol=1e-4)
    pixel, depth = jax.vmap(points_to_pixels, (0, None))(shots.cameras, jnp.asarray(center, "f"))
    np.testing.assert_allclose(pixel, np.tile([16, 12], (12, 1)), atol=1e-2)
    np.testing.assert_allclose(depth, math.hypot(3, 2), rtol=1e-5)


def test_an_orbit_turns_around_the_given_up_direction(capture_folder):
    scene = load_scene(str(capture_folder))
    center, radius, height = np.array([1.0, -2.0, 0.5]), 3.0, 2.0
    cameras = ring(center, radius, height)
    train = scene.train.replace(cameras=cameras)
    scene = dataclasses.replace(scene, train=train, near=0.1, far=10.0)
    # Around -z the circle is the same, and every camera is upside down.
    shots = camera_paths.orbit(scene, 12, up=(0, 0, -3))
    offset = np.asarray(shots.cameras.position) - center
    np.testing.assert_allclose(offset[:, 2], height, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(offset[:, :2], axis=1), radius, atol=1e-4)
    down = np.asarray(shots.cameras.rotation)[..., 1]
    np.testing.assert_allclose(down[:, 2], radius / math.hypot(radius, height), atol=1e-4)
    # Around x: as far from that axis as the median camera of the ring.
    shots = camera_paths.orbit(scene, 8, up=(0.1, 0, 0))
    offset = np.asarray(shots.cameras.position) - center
    np.testing.assert_allclose(offset[:, 0], 0, atol=1e-4)
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    expected = np.median(np.hypot(radius * np.sin(angles), height))
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), expected, atol=1e-4)
    steps = np.einsum("ni,ni->n", offset, np.roll(offset, 1, axis=0)) / expected**2
    np.testing.assert_allclose(steps, math.cos(2 * np.pi / 8), atol=1e-4)
    rotation = np.asarray(shots.cameras.rotation)
    np.testing.assert_allclose(rotation[..., 1], np.tile([-1, 0, 0], (8, 1)), atol=1e-4)
    np.testing.assert_allclose(rotation[..., 2], -offset / expected, atol=1e-4)


def test_cameras_without_a_common_focus_look_ahead():
    positions, forward = np.eye(3), np.tile([0.0, 0, 1], (3, 1))
    point = focus_point(positions, forward, near=1.0, far=3.0)
    np.testing.assert_allclose(point, positions.mean(0) + 1.5 * forward[0])
    # Back to back in a room: their axes meet behind them.
    outward = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0]])
    point = focus_point(outward * 0.1, outward, near=1.0, far=3.0)
    np.testing.assert_allclose(point, (outward * 1.6).mean(0))


def test_resizing_keeps_the_view():
    camera = plane.camera_above(0.3, 0.0, 4.0, tilt=0.3)
    points = jnp.asarray(plane.photograph(camera)[2], jnp.float32)
    before, _ = points_to_pixels(camera, points)
    for sizes, (width, height) in (((64, None), (64, 48)), ((None, 12), (16, 12))):
        larger = camera_paths.resized(camera, *sizes)
        assert (larger.width, larger.height) == (width, height)
        after, _ = points_to_pixels(larger, points)
        np.testing.assert_allclose(after, before * (width / 32), atol=1e-3)
    assert camera_paths.resized(camera, None, None) is camera


def tilted(scene, rng, *, yaws, pitch, roll):
    """Photographs by a person: any yaw and pitch, hardly any roll; and which way is up, at random.

    Angles in degrees; `pitch` and `roll` are ranges. Returns the scene and up.
    """
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    poses = []
    for yaw in np.radians(yaws):
        look, level = (np.radians(rng.uniform(*limits)) for limits in (pitch, roll))
        flat = np.array([np.cos(yaw), np.sin(yaw), 0])
        forward = np.cos(look) * flat + np.sin(look) * np.array([0, 0, 1.0])
        pose = camera_paths.look_at(-3 * forward, np.zeros(3), np.array([0, 0, 1.0]))
        c, s = np.cos(level), np.sin(level)
        pose[:, :3] = pose[:, :3] @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        poses.append(turn @ pose)
    count = len(poses)
    lens = jnp.tile(jnp.array([40.0, 40, 16, 12]), (count, 1))
    cameras = Camera(jnp.asarray(np.array(poses), jnp.float32), lens, 24, 32)
    return dataclasses.replace(scene, train=scene.train.replace(cameras=cameras)), turn[:, 2]


@pytest.mark.parametrize(
    ("yaws", "pitch", "roll", "most"),
    [
        (np.arange(0, 360, 15), (-60, -10), (0, 0), 0.2),
        (np.arange(0, 120, 8), (-50, -40), (0, 0), 0.5),  # from one side: their mean up leans
        (np.arange(0, 120, 8), (-50, -40), (-2, 2), 3),
        (np.arange(0, 360, 15), (-80, 30), (-5, 5), 3),
        ([40], (-5, -5), (0, 0), 6),  # one photograph: its own up
    ],
)
def test_up_is_where_cameras_are_level(capture_folder, yaws, pitch, roll, most):
    scene, rng = load_scene(str(capture_folder)), np.random.default_rng(0)
    for _ in range(5):
        taken, up = tilted(scene, rng, yaws=yaws, pitch=pitch, roll=roll)
        found = up_direction(taken)
        assert np.degrees(np.arccos(np.clip(found @ up, -1, 1))) < most
        heights = np.asarray(camera_paths.orbit(taken, 8).cameras.position) @ found
        np.testing.assert_allclose(heights, heights[0], atol=1e-4)


def test_up_is_what_the_capture_says(tmp_path, capture_folder):
    scene = load_scene(str(capture_folder))
    said = dataclasses.replace(scene, metadata={**scene.metadata, "up": (0.0, 1.0, 0.0)})
    np.testing.assert_array_equal(up_direction(said), [0, 1, 0])
    assert scene.metadata["up"] is None
    for fields in ({"orientation_override": "none"}, {"camera_angle_x": 0.8}):
        single_file(tmp_path, 2, **fields)
        np.testing.assert_array_equal(load_scene(tmp_path).metadata["up"], [0, 0, 1])
    single_file(tmp_path, 2, orientation_override="up")
    assert load_scene(tmp_path).metadata["up"] is None


def test_nearly_an_axis_is_that_axis(capture_folder):
    scene = dataclasses.replace(load_scene(str(capture_folder)))
    cameras = ring(np.zeros(3), 3.0, 2.0)
    for degrees, snaps in ((2, True), (6, False)):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turn = jnp.asarray([[1, 0, 0], [0, c, -s], [0, s, c]], jnp.float32)
        turned = cameras.replace(camtoworld=turn @ cameras.camtoworld)
        up = up_direction(dataclasses.replace(scene, train=scene.train.replace(cameras=turned)))
        expected = [0, 0, 1] if snaps else [0, -s, c]
        np.testing.assert_allclose(up, expected, atol=1e-3)
