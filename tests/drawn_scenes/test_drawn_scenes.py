"""The built-in scenes: cameras against exact geometry, consistency between views, the cache."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxcloseup.captures.load import load_scene
from jaxcloseup.drawn_scenes import assembly, drawn, lighting, planning
from jaxcloseup.drawn_scenes.builtin import SCENES
from jaxcloseup.drawn_scenes.raycast import PLANE, cast_rays
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.warp import backward_warp
from jaxcloseup.photos.views import camera_at


DOWNSCALE = 20  # 48 x 27


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """An empty cache for this module."""
    with pytest.MonkeyPatch.context() as patch:
        root = tmp_path_factory.mktemp("cache")
        patch.setenv("XDG_CACHE_HOME", str(root))
        patch.setattr(lighting, "_ROUNDS", 1)  # half of what baking takes longest for
        drawn._world.cache_clear()
        yield root / "jaxcloseup"
        drawn._world.cache_clear()


@pytest.fixture(scope="module")
def scene(cache):
    return drawn.draw_scene("counter", downscale=DOWNSCALE)


@pytest.fixture(scope="module")
def truth(scene):
    """The exact surface of every third training view."""
    return [(i, scene.surface(camera_at(scene.train.cameras, i))) for i in range(0, 60, 3)]


@pytest.mark.parametrize("name", drawn.DRAWN_SCENES)
def test_cameras(name, monkeypatch):
    """Cameras stand in free space; close-ups are near, rotated and seen by training views."""
    monkeypatch.setattr(assembly, "draw_texture", lambda name: np.zeros((1024, 1024, 3)))
    model = SCENES[name]()
    world = assembly.build_world(model, lambda *scene: np.ones((8, 4)))
    rng = np.random.default_rng(7)
    train = planning.plan_far(world.solids, model.rig, rng, 24)
    close = planning.plan_closeups(world.solids, model.rig, train, rng, 5)

    poses = np.concatenate([train, close.poses])
    np.testing.assert_allclose(
        poses[..., :3] @ poses[..., :3].swapaxes(1, 2), np.tile(np.eye(3), (29, 1, 1)), atol=1e-12
    )
    assert (np.linalg.det(poses[..., :3]) > 0).all()
    assert (poses[:24, 2, 1] < -0.6).all()  # upright: y points down
    depth = cast_rays(world.solids, *planning.grid_rays(poses, 96, 54)).depth
    assert np.isfinite(depth).all()
    assert depth[:24].min() > 0.6
    assert depth[24:].min() > 0.06

    intrinsics = [800.0, 800.0, 480.0, 270.0]
    assert ((close.magnification > 2) & (close.magnification < 8)).all()
    for pose, subject, magnification in zip(*close, strict=True):
        own, nearest, views = np.linalg.norm(pose[:, 3] - subject), np.inf, 0
        for other in train:
            distance = np.linalg.norm(other[:, 3] - subject)
            nearest = min(nearest, distance)
            views += sees(world.solids, other, intrinsics, subject)
            cosine = (np.trace(other[:, :3].T @ pose[:, :3]) - 1) / 2
            assert np.rad2deg(np.arccos(np.clip(cosine, -1, 1))) > 3  # rotated from every view
        np.testing.assert_allclose(magnification, nearest / own)
        assert views >= 3
        assert sees(world.solids, pose, intrinsics, subject)
        # Nothing blocks the line from the subject to the camera.
        back = cast_rays(
            world.solids, subject + 1e-3 * (pose[:, 3] - subject), pose[:, 3] - subject
        )
        assert back.depth > 0.998


def test_the_statue_is_seen_whole_from_all_sides(monkeypatch):
    """No view cuts it off, and about half of them see what a close-up shows."""
    monkeypatch.setattr(assembly, "draw_texture", lambda name: np.zeros((1024, 1024, 3)))
    model = SCENES["statue"]()
    solids = assembly.build_world(model, lambda *scene: np.ones((8, 4))).solids
    rng = np.random.default_rng(0)
    train = planning.plan_far(solids, model.rig, rng, model.rig.photographs)
    azimuths = np.sort(np.rad2deg(np.arctan2(train[:, 1, 3], train[:, 0, 3])))
    assert len(train) == 24 and np.diff([*azimuths, azimuths[0] + 360]).max() < 18
    on_top = [s for s in model.solids if s.center[2] > 0.5 and np.abs(s.center).max() < 2]
    axes = [(s.rotation * s.size / 2).T[: 2 if s.kind == PLANE else 3] for s in on_top]
    ends = [s.center + sign * a for s, a in zip(on_top, axes, strict=True) for sign in (-1, 1)]
    for pose in train:
        pixels, depths = reference.project(pose, [800.0, 800.0, 480.0, 270.0], np.concatenate(ends))
        assert (depths > 0).all() and (pixels > 0).all() and (pixels < [960, 540]).all()
    close = planning.plan_closeups(solids, model.rig, train, rng, 6)
    assert ((close.magnification > 2) & (close.magnification < 4.1)).all()
    seen = planning.count_views(solids, close.subjects, train) / 24
    assert seen.max() < 0.75 and 0.25 < seen.mean() < 0.6


def sees(solids, pose, intrinsics, point):
    """Whether a view shows a surface point: it lies in the image and is not occluded."""
    pixels, depths = reference.project(pose, intrinsics, [point])
    inside = depths[0] > 0 and (pixels[0] > 0).all() and (pixels[0] < [960, 540]).all()
    return inside and abs(cast_rays(solids, pose[:, 3], point - pose[:, 3]).depth - 1) < 5e-3


def test_a_capture_is_complete(scene):
    counts = {"train": 60, "test": 12, "test_far": 8}
    for split, count in counts.items():
        views = getattr(scene, split)
        assert views.rgb.shape == (count, 27, 48, 3)
        assert views.rgb.dtype == jnp.uint8
        assert views.weight.shape == (count, 27, 48)
        assert bool((views.weight == 1).all())
        assert len(set(scene.names[split])) == count
        assert views.cameras.camtoworld.shape == (count, 3, 4)
        np.testing.assert_allclose(
            views.cameras.intrinsics, np.tile([40, 40, 24, 13.5], (count, 1))
        )
        assert float(jnp.std(views.rgb.astype(jnp.float32))) > 20
    assert len(scene.metadata["magnification"]) == 12
    # Close-ups are nearer than the far views by the stated magnification.
    subjects = np.array(scene.metadata["subjects"])
    away = np.asarray(scene.train.cameras.position)[None] - subjects[:, None]
    own = np.linalg.norm(np.asarray(scene.test.cameras.position) - subjects, axis=-1)
    np.testing.assert_allclose(
        np.linalg.norm(away, axis=-1).min(1) / own, scene.metadata["magnification"], rtol=1e-4
    )


def test_depth_range_holds_everything(scene, truth):
    close = [scene.surface(camera_at(scene.test.cameras, i)) for i in range(12)]
    for surface in [surface for _, surface in truth] + close:
        assert scene.near < float(surface.depth.min())
        assert float(surface.depth.max()) < scene.far
    assert 0.05 < scene.near < scene.far < 8


def test_photographs_are_what_the_surface_shows(scene, truth):
    for i, surface in truth[:3]:
        photograph = np.asarray(scene.train.rgb[i], np.float32) / 255
        np.testing.assert_allclose(photograph, surface.rgb, atol=0.5 / 255 + 1e-5)
        length = np.linalg.norm(surface.normal, axis=-1)
        np.testing.assert_allclose(length, np.ones((27, 48)), atol=1e-5)


def test_two_views_agree(scene, truth):
    """A pixel lifted by its depth lands in another view at the same depth and color."""
    lift, project = jax.jit(pixels_to_points), jax.jit(points_to_pixels)
    grid = pixel_grid(27, 48)
    shown, errors = [], []
    for (i, a), (j, b) in itertools.pairwise(truth):
        points = lift(camera_at(scene.train.cameras, i), grid, a.depth)
        pixels, depth = project(camera_at(scene.train.cameras, j), points)
        inside = (pixels > 1).all(-1) & (pixels < jnp.array([[[47.0, 26.0]]])).all(-1)
        found = backward_warp(jnp.concatenate([b.rgb, b.depth[..., None]], -1), pixels)
        visible = np.asarray(inside & (jnp.abs(found[..., 3] / depth - 1) < 0.02))
        shown.append(visible.sum() / np.asarray(inside).sum())
        errors.append(np.abs(np.asarray(found[..., :3] - a.rgb))[visible].ravel())
    assert np.mean(shown) > 0.7
    assert np.median(np.concatenate(errors)) < 0.025


def test_points_lie_on_the_surface_with_its_color(scene, truth):
    assert 4500 < len(scene.points) <= 5100
    solids, seen = drawn._world("counter").solids, np.zeros(len(scene.points), bool)
    for i, surface in truth:
        camera = camera_at(scene.train.cameras, i)
        pixels, depths = reference.project(camera.camtoworld, camera.intrinsics, scene.points)
        inside = (depths > 0) & (pixels > 0).all(-1) & (pixels < [48, 27]).all(-1)
        eye = np.asarray(camera.position)
        visible = inside & (np.abs(cast_rays(solids, eye, scene.points - eye).depth - 1) < 1e-3)
        column, row = pixels[visible].astype(int).T
        difference = np.abs(np.asarray(surface.rgb)[row, column] - scene.rgb[visible])
        assert np.median(difference) < 0.04
        seen |= visible
    assert seen.mean() > 0.95


def test_zoom_agrees_with_the_plain_view_and_shows_more(scene, truth):
    """Pixels are means over their area, so averaging a 4 times finer view gives the same image."""
    errors, hidden = [], []
    for i, surface in truth[::4]:
        for left, top in ((2, 2), (18, 10), (34, 18)):
            # 12 x 6 pixels, magnified four times on the same sensor.
            intrinsics = jnp.array([160.0, 160.0, 4 * (24 - left), 4 * (13.5 - top)])
            camera = camera_at(scene.train.cameras, i).replace(intrinsics=intrinsics)
            zoom = np.asarray(scene.surface(camera).rgb)[:24]
            mean = zoom.reshape(6, 4, 12, 4, 3).mean((1, 3))
            errors.append(np.abs(mean - np.asarray(surface.rgb)[top : top + 6, left : left + 12]))
            hidden.append(np.abs(zoom - np.repeat(np.repeat(mean, 4, 0), 4, 1)))
    assert np.mean(errors) < 0.015
    assert np.mean(hidden) > 3 * np.mean(errors)


def test_fewer_photographs_are_the_same_ones(scene):
    """The finer ones are of the same views, and the points lie in two of their pictures."""
    fewer = load_scene("counter", downscale=DOWNSCALE, photographs=2)
    views = [15, 45]
    assert fewer.names["train"] == [f"train_{i:03d}" for i in views]
    np.testing.assert_array_equal(fewer.train.rgb, np.asarray(scene.train.rgb)[views])
    np.testing.assert_array_equal(fewer.test.rgb, scene.test.rgb)
    finer = fewer.photographs_at(DOWNSCALE)
    np.testing.assert_array_equal([photograph.rgb for photograph in finer], fewer.train.rgb)
    assert len(fewer.photographs_at(DOWNSCALE, "test")) == len(scene.test)
    inside, visible = np.ones((2, len(scene.points)), bool)
    for pose, lens in zip(
        np.asarray(scene.train.cameras.camtoworld)[views],
        np.asarray(scene.train.cameras.intrinsics)[views],
        strict=True,
    ):
        x, y, z = ((scene.points - pose[:, 3]) @ pose[:, :3]).T
        column, row = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
        inside &= (z > 0) & (column >= 0) & (column < 48) & (row >= 0) & (row < 27)
        # An eighth of a pixel beside the point the surface is as far away, or hides it.
        fine = Camera(jnp.asarray(pose), jnp.asarray(8 * lens), height=8 * 27, width=8 * 48)
        depth = np.asarray(scene.surface(fine).depth)
        y, x = (
            np.clip(8 * at, 0, 8 * end - 1).astype(int) for at, end in ((row, 27), (column, 48))
        )
        visible &= inside & (z < 1.02 * depth[y, x])
    kept = (scene.points[:, None] == fewer.points[None]).all(-1).any(1)
    np.testing.assert_array_equal(fewer.points, scene.points[kept])
    np.testing.assert_array_equal(fewer.rgb, scene.rgb[kept])
    assert 100 < visible.sum() < 0.9 * inside.sum() and not kept[~inside].any()
    assert kept[visible].mean() > 0.99 and kept[inside & ~visible].mean() < 0.3


def test_photographs_far_apart_are_farther_apart(scene):
    smallest = {}
    for choose in ("path", "spread"):
        chosen = load_scene("counter", downscale=DOWNSCALE, photographs=5, choose=choose)
        at = np.asarray(chosen.train.cameras.position)
        apart = np.linalg.norm(at[:, None] - at[None], axis=-1)
        smallest[choose] = apart[np.triu_indices(5, 1)].min()
    assert smallest["spread"] > 1.2 * smallest["path"]


def test_the_first_photographs_see_one_side(scene):
    """Photographs are in order of azimuth, so close-ups look from directions that none has."""
    first, path = (
        load_scene("counter", downscale=DOWNSCALE, photographs=5, choose=choose)
        for choose in ("first", "path")
    )
    np.testing.assert_array_equal(first.train.rgb, scene.train.rgb[:5])

    def angles(chosen):
        ahead, closeups = chosen.train.cameras.rotation[..., 2], scene.test.cameras.rotation[..., 2]
        return np.arccos(np.clip(np.max(closeups @ ahead.T, axis=1), -1, 1))

    assert np.rad2deg(np.median(angles(first) - angles(path))) > 10


def test_the_cache_is_used_and_survives_damage(scene, cache, monkeypatch):
    stored = list(cache.glob("counter-48x27-*.npz"))
    assert len(stored) == 1
    assert not list(cache.glob("*.part"))

    def must_not_run(*args):
        raise AssertionError("rendered again")

    with monkeypatch.context() as patch:
        patch.setattr(drawn, "_capture", must_not_run)
        again = drawn.draw_scene("counter", downscale=DOWNSCALE)
    jax.tree.map(np.testing.assert_array_equal, again.train, scene.train)

    # Redrawing gives identical bits: textures, light, cameras, photographs and points.
    stored[0].write_bytes(stored[0].read_bytes()[:1000])
    for light in cache.glob("counter-light-*.npz"):
        light.write_text("not an archive")
    drawn._world.cache_clear()
    with pytest.warns(UserWarning, match="is damaged"):
        rebuilt = drawn.draw_scene("counter", downscale=DOWNSCALE)
    for split in ("train", "test", "test_far"):
        jax.tree.map(np.testing.assert_array_equal, getattr(rebuilt, split), getattr(scene, split))
    np.testing.assert_array_equal(rebuilt.points, scene.points)
    np.testing.assert_array_equal(rebuilt.rgb, scene.rgb)


def test_an_unwritable_cache_only_warns(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    with pytest.warns(UserWarning, match="made again next time: .* cannot be written"):
        made = drawn._cached("anything", lambda: {"value": np.arange(3)})
    np.testing.assert_array_equal(made["value"], [0, 1, 2])


def test_sizes_round_up_and_focal_lengths_follow(scene):
    camera = drawn._cameras(np.zeros((1, 3, 4)), 120, 68)
    assert (camera.height, camera.width) == (68, 120)
    np.testing.assert_allclose(camera.intrinsics[0], [100, 800 * 68 / 540, 60, 34], rtol=1e-6)
    reduced = dataclasses.replace(scene, train=scene.train.replace(cameras=camera))
    own = reduced.own_camera("train", 0)
    assert (own.height, own.width) == (540, 960)
    np.testing.assert_allclose(own.intrinsics, [800, 800, 480, 270], rtol=1e-6)


def test_bad_requests():
    with pytest.raises(ValueError, match="no built-in scene 'cellar': choose one of counter"):
        drawn.draw_scene("cellar")
    with pytest.raises(ValueError, match="positive integer"):
        drawn.draw_scene("counter", downscale=0)


def test_a_new_camera_reuses_the_compiled_render(scene):
    """Each image size compiles once, for any camera."""
    before = drawn._render_surface._cache_size()
    camera = camera_at(scene.test.cameras, 0)
    moved = Camera(camera.camtoworld + 0.01, camera.intrinsics, 27, 48)
    scene.surface(moved)
    assert drawn._render_surface._cache_size() == before


def test_a_surface_first_rendered_inside_a_trace_serves_later_traces(scene):
    drawn._world.cache_clear()
    camera = camera_at(scene.test.cameras, 0)
    for _ in range(2):
        jax.jit(lambda camera: scene.surface(camera).depth).lower(camera)
