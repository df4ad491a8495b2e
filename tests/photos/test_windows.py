"""Windows against the photographs that they are cut out of, and against renders of whole images."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from splat_scenes import CONFIG, random_scene, to_surfels

from jaxcloseup.fields.splats import render_surfels
from jaxcloseup.geometry.cameras import (
    Camera,
    pixel_grid,
    pixels_to_points,
    pixels_to_rays,
    points_to_pixels,
)
from jaxcloseup.photos.depth_maps import join_maps
from jaxcloseup.photos.pyramids import photograph_pyramid
from jaxcloseup.photos.views import Views, camera_at
from jaxcloseup.photos.windows import (
    cut_window,
    in_quarters,
    photograph_windows,
    sample_window,
    sample_window_pixels,
    view_windows,
    windows_that_see,
)


WHOLE_SHARE = 0.25


@pytest.fixture(scope="module")
def windows():
    """Photographs of 4, 2 and 1 times 12 x 16 pixels."""
    rng = np.random.default_rng(0)
    views, _ = plane.make_views([plane.camera_above(x, 0, 4.0) for x in (-1.0, 0.0, 1.0)])

    def photographs(scale):
        height, width = 12 * scale, 16 * scale
        rgb = rng.integers(0, 256, (3, height, width, 3)).astype(np.uint8)
        intrinsics = scale * np.array([[20.0, 21.0, 8.5, 6.2]] * 3, np.float32)
        cameras = Camera(views.cameras.camtoworld, jnp.asarray(intrinsics), height, width)
        return views.replace(cameras=cameras, rgb=rgb, weight=np.ones(rgb.shape[:3], np.float32))

    coarsest = photographs(1)
    pyramid = photograph_pyramid(photographs(4), coarsest)
    assert pyramid.sizes == ((48, 64), (24, 32), (12, 16))
    return photograph_windows(coarsest.cameras, pyramid, whole_share=WHOLE_SHARE)


def test_a_window_is_a_part_of_its_level(windows):
    for view, level, row, column in ((0, 0, 36, 48), (2, 1, 5, 7), (1, 2, 0, 0)):
        window = cut_window(windows, view, level, jnp.array([row, column]))
        whole = np.asarray(windows.pyramid.image(view, level)) / np.float32(255)
        part = whole[row : row + 12, column : column + 16]
        np.testing.assert_allclose(window.rgb, part[..., :3], rtol=1e-6)
        np.testing.assert_allclose(window.weight, part[..., 3], rtol=1e-6)


def test_a_window_has_the_depth_of_its_photograph_at_any_size():
    """Inverse depth is linear on a plane, so maps of half the size have the exact depth."""
    poses = [plane.camera_above(x, 0.2, 3.0, tilt=0.3 * x) for x in (-1.0, 1.0)]
    views, depths = plane.make_views(poses)
    shown = np.ones(depths.shape, np.float32)
    shown[1, 10, 20] = 0  # nothing is known of this pixel
    known = join_maps(views.cameras, 1 / depths, jnp.asarray(shown))
    twice = Camera(views.cameras.camtoworld, 2 * views.cameras.intrinsics, 48, 64)
    rgb = jnp.zeros((2, 48, 64, 3))
    pyramid = photograph_pyramid(Views(twice, rgb, jnp.ones(rgb.shape[:3])), views)
    windows = photograph_windows(views.cameras, pyramid, whole_share=WHOLE_SHARE)
    windows = dataclasses.replace(windows, depths=known)
    batch = cut_window(windows, 1, 0, jnp.array([13, 25]))
    camera = batch.cameras
    origins, directions = pixels_to_rays(camera, pixel_grid(camera.height, camera.width))
    exact = -np.asarray(origins)[..., 2] / np.asarray(directions)[..., 2]
    unknown = np.asarray(batch.measured.trust) == 0
    np.testing.assert_allclose(batch.measured.depth[~unknown], exact[~unknown], rtol=1e-5)
    # The window's pixels around it, up to the centers of its neighbors, have no depth either.
    rows, columns = np.nonzero(unknown)
    assert (rows.min() + 13, rows.max() + 13) == (19, 22)
    assert (columns.min() + 25, columns.max() + 25) == (39, 42)
    assert np.all(np.asarray(batch.measured.depth)[unknown] == 0)


def test_single_pixels_have_the_depth_of_their_photograph(key):
    poses = [plane.camera_above(x, 0.2, 3.0, tilt=0.3 * x) for x in (-1.0, 1.0)]
    views, depths = plane.make_views(poses)
    shown = np.ones(depths.shape, np.float32)
    shown[1, :10] = 0
    known = join_maps(views.cameras, 1 / depths, jnp.asarray(shown))
    windows = photograph_windows(views.cameras, photograph_pyramid(views), whole_share=1.0)
    windows = dataclasses.replace(windows, depths=known)
    batch = jax.jit(sample_window_pixels, static_argnums=2)(key, windows, 400)
    of_second = np.asarray(batch.cameras.camtoworld == poses[1].camtoworld[None]).all((1, 2))
    hidden = of_second & (np.asarray(batch.pixels[:, 1]) < 10.4)
    assert 0 < hidden.sum() < of_second.sum() < 400
    np.testing.assert_array_equal(np.asarray(batch.measured.trust) == 0, hidden)
    rays = jax.vmap(pixels_to_rays)(batch.cameras, batch.pixels)
    origins, directions = map(np.asarray, rays)
    exact = np.where(hidden, 0, -origins[:, 2] / directions[:, 2])
    np.testing.assert_allclose(batch.measured.depth, exact, rtol=1e-5)


def test_views_of_any_size_have_windows_of_a_given_one(windows, key):
    """Windows of 13 x 17 pixels: two halvings of 48 x 64 would be smaller."""
    image = np.asarray(windows.pyramid.image(1, 0))
    one = camera_at(windows.cameras, 1).replace(
        intrinsics=windows.pyramid.intrinsics[1, 0], height=48, width=64
    )
    cameras = jax.tree.map(lambda leaf: leaf[None], one)
    views = Views(cameras, image[None, ..., :3], image[None, ..., 3] / np.float32(255))
    parts = view_windows(views, 13, 17)
    assert parts.pyramid.sizes == ((48, 64), (24, 32))
    np.testing.assert_array_equal(parts.pyramid.image(0, 0), image)
    drawn = jax.vmap(lambda key: sample_window(key, parts))(jax.random.split(key, 200))
    assert drawn.rgb.shape == (200, 13, 17, 3)
    fine = np.asarray(drawn.cameras.intrinsics[:, 0]) == one.intrinsics[0]
    assert 0.4 < fine.mean() < 0.6
    corner = np.asarray(one.intrinsics[2:]) - np.asarray(drawn.cameras.intrinsics[:, 2:])
    for (x, y), rgb in zip(np.asarray(corner)[fine].astype(int), drawn.rgb[fine], strict=True):
        there = image[y : y + 13, x : x + 17, :3]
        np.testing.assert_allclose(rgb, there / np.float32(255), rtol=1e-6)


def test_windows_cover_all_pixels_of_all_levels_with_the_stated_shares(windows, key):
    count = 20_000

    @jax.jit
    @jax.vmap
    def draw(key):
        camera = sample_window(key, windows).cameras
        return camera.position[0], camera.intrinsics

    position, intrinsics = map(np.asarray, draw(jax.random.split(key, count)))
    view = np.searchsorted([-0.5, 0.5], position)
    level = 2 - np.rint(np.log2(intrinsics[:, 0] / 20)).astype(int)
    own = np.asarray(windows.pyramid.intrinsics)[view, level]
    corner = np.rint(own[:, 2:] - intrinsics[:, 2:]).astype(int)
    np.testing.assert_allclose(np.bincount(view) / count, 1 / 3, atol=0.015)
    np.testing.assert_allclose(np.bincount(level) / count, [0.6, 0.15, WHOLE_SHARE], atol=0.015)
    for index, (height, width) in enumerate(windows.pyramid.sizes):
        x, y = corner[level == index].T
        assert x.min() == 0 and x.max() == width - 16
        assert y.min() == 0 and y.max() == height - 12
        for places, last in ((x, width - 16), (y, height - 12)):
            seen = np.bincount(places, minlength=last + 1) / len(places)
            np.testing.assert_allclose(seen, 1 / (last + 1), atol=0.015)


def test_pixels_come_from_all_levels_with_the_stated_shares(windows, key):
    count = 60_000
    batch = jax.jit(functools.partial(sample_window_pixels, count=count))(key, windows)
    view = np.searchsorted([-0.5, 0.5], batch.cameras.position[:, 0])
    level = 2 - np.rint(np.log2(batch.cameras.intrinsics[:, 0] / 20)).astype(int)
    np.testing.assert_allclose(np.bincount(view) / count, 1 / 3, atol=0.01)
    np.testing.assert_allclose(np.bincount(level) / count, [0.6, 0.15, WHOLE_SHARE], atol=0.01)
    own = np.asarray(windows.pyramid.intrinsics)[view, level]
    np.testing.assert_array_equal(batch.cameras.intrinsics, own)
    x, y = np.floor(batch.pixels).astype(int).T
    for index, (height, width) in enumerate(windows.pyramid.sizes):
        there = level == index
        images = np.stack([windows.pyramid.image(v, index) for v in range(3)]) / np.float32(255)
        expected = images[view[there], y[there], x[there]]
        np.testing.assert_allclose(batch.rgb[there], expected[:, :3], rtol=1e-6)
        np.testing.assert_allclose(batch.weight[there], expected[:, 3], rtol=1e-6)
        seen = np.bincount(y[there] * width + x[there], minlength=height * width)
        assert np.all(seen < 5 * seen.mean() + 5) and seen.min() >= (0 if index == 0 else 1)
        halves = np.bincount(y[there] >= height // 2), np.bincount(x[there] >= width // 2)
        np.testing.assert_allclose(np.array(halves) / there.sum(), 0.5, atol=0.02)


def test_windows_lie_around_places_as_far_as_the_photograph_reaches(windows, key):
    there = windows.replace(places=jnp.array([[2.0, 0.5, 0.25], [0.0, 1.0, 0.0]]))
    cameras = jax.vmap(lambda key: sample_window(key, there).cameras)(jax.random.split(key, 500))
    view = np.searchsorted([-0.5, 0.5], cameras.position[:, 0])
    level = 2 - np.rint(np.log2(cameras.intrinsics[:, 0] / 20)).astype(int)
    own = np.asarray(windows.pyramid.intrinsics)[view, level]
    corner = np.rint(own[:, 2:] - cameras.intrinsics[:, 2:]).astype(int)
    assert set(view) == {0, 2} and set(level) == {0, 1, 2}
    for index, (height, width) in enumerate(windows.pyramid.sizes):
        # The middle of the upper half, and the upper right corner.
        middle, edge = (width // 2 - 8, max(height // 4 - 6, 0)), (width - 16, 0)
        for one, expected in ((2, middle), (0, edge)):
            found = corner[(view == one) & (level == index)]
            np.testing.assert_array_equal(found, [expected] * len(found))


def test_pixels_lie_around_places(windows, key):
    there = windows.replace(places=jnp.array([[1.0, 0.5, 0.5]]))
    batch = sample_window_pixels(key, there, 4000)
    level = 2 - np.rint(np.log2(batch.cameras.intrinsics[:, 0] / 20)).astype(int)
    assert not np.any(batch.cameras.position[:, 0])
    for index, (height, width) in enumerate(windows.pyramid.sizes):
        away = np.asarray(batch.pixels)[level == index] - [width / 2, height / 2]
        assert np.abs(away[:, 0]).max() <= 8.5 and np.abs(away[:, 1]).max() <= 6.5
        np.testing.assert_allclose(away.mean(0), 0, atol=0.5)


def test_windows_that_see_are_where_photographs_show_what_cameras_see(windows, key):
    """Places lie on the plane; lifted there, they are inside of the wanted view."""
    wanted = plane.camera_above(0.7, 0.1, 1.5)
    views, depths = plane.make_views([plane.camera_above(x, 0, 4.0) for x in (-4.5, 0.0, 1.0)])
    cameras = jax.tree.map(lambda leaf: leaf[None], wanted)
    depth = jnp.asarray(plane.photograph(wanted)[1], jnp.float32).at[: wanted.height // 2].set(0)
    seen = cameras, depth[None], views, jnp.asarray(depths, jnp.float32)
    places = np.asarray(windows_that_see(key, windows, *seen, count=600).places)
    assert places.shape == (600, 3) and (places[:, 1:] >= 0).all() and (places[:, 1:] <= 1).all()
    inside = []
    for view, x, y in places:
        camera = camera_at(views.cameras, int(view))
        pixel = jnp.array([x * camera.width, y * camera.height])
        landed, _ = points_to_pixels(wanted, pixels_to_points(camera, pixel, jnp.float32(4.0)))
        inside.append(bool(jnp.all((landed >= 0) & (landed <= wanted.width))) and view > 0)
    # Half of the pixels have no depth, and draw any place; the first photograph sees none.
    assert 0.45 < np.mean(inside) < 0.75
    assert set(places[np.array(inside), 0]) == {1.0, 2.0}


def test_quarters_make_a_whole_image(key):
    """Of odd size too; what a quarter is of follows from its intrinsics alone."""
    rotation = jnp.concatenate([jnp.eye(3), jax.random.normal(key, (3, 1))], axis=1)
    camera = Camera(rotation, jnp.array([6.0, 5.0, 3.2, 2.1]), height=5, width=7)

    def see(camera):
        pixels = pixel_grid(camera.height, camera.width)
        _, rays = pixels_to_rays(camera, pixels)
        return {"ray": rays, "sum": jnp.sum(rays, axis=-1), "none": None}

    seen, called = in_quarters(see, camera), []
    for name, image in see(camera).items():
        if image is None:
            assert seen[name] is None
        else:
            np.testing.assert_allclose(seen[name], image, atol=1e-6)
    in_quarters(lambda part: called.append((part.height, part.width)), camera)
    assert called == [(3, 4)] * 4


def test_a_window_learns_as_that_part_of_a_whole_image():
    """The gradient of a window's error is that of the same pixels of the whole render."""
    surfels, alive = to_surfels(random_scene(0, count=40)), jnp.ones(40, bool)
    whole = Camera(jnp.eye(3, 4), jnp.array([60.0, 68.0, 29.0, 26.0]), 48, 64)
    row, column, height, width = 13, 21, 24, 32
    shifted = whole.intrinsics - jnp.array([0.0, 0.0, column, row])
    window = whole.replace(intrinsics=shifted, height=height, width=width)
    target = jax.random.uniform(jax.random.key(1), (height, width, 3))
    config = dataclasses.replace(CONFIG, antialias=True, compositor="auto")

    @functools.partial(jax.jit, static_argnums=(2, 3))
    @functools.partial(jax.value_and_grad, has_aux=True)
    def error(surfels, camera, row, column):
        seen = render_surfels(surfels, alive, camera, config)
        rgb = seen.rgb[row : row + height, column : column + width]
        return jnp.sum((rgb - target) ** 2), seen.overflow

    (expected, overflow), theirs = error(surfels, whole, row, column)
    assert not overflow
    (value, _), ours = error(surfels, window, 0, 0)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5 * np.abs(other).max())
