"""Support on the plane z = 0: counts and footprints against a slow float64 oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest

from jaxcloseup.geometry.cameras import pixel_grid
from jaxcloseup.photos.support import count_seen, find_support


GRID = pixel_grid(plane.HEIGHT, plane.WIDTH)
support = jax.jit(find_support)


@pytest.fixture(scope="module")
def capture():
    """Photographs from several heights: one has other focal lengths, one a masked strip."""
    heights = ((-1.0, 4.0), (0.0, 3.0), (1.0, 6.0), (0.4, 2.0))
    cameras = [plane.camera_above(x, 0.1 * x, z, tilt=0.1 * x) for x, z in heights]
    views, depths = plane.make_views(cameras)
    lens = jnp.array([2 * plane.FOCAL, 0.5 * plane.FOCAL, 16.0, 12.0])
    intrinsics = views.cameras.intrinsics.at[2].set(lens)
    cameras = views.cameras.replace(intrinsics=intrinsics)
    weight = views.weight.at[1, :, :8].set(0)
    return views.replace(cameras=cameras, weight=weight), depths.at[2].set(flat_depth(cameras, 2))


def flat_depth(cameras, i):
    """Return the exact depth of photograph `i` for its focal lengths."""
    fx, fy, cx, cy = np.asarray(cameras.intrinsics[i], np.float64)
    pose = np.asarray(cameras.camtoworld[i], np.float64)
    x, y = np.moveaxis(np.asarray(GRID, np.float64), -1, 0)
    directions = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1) @ pose[:, :3].T
    return -pose[2, 3] / directions[..., 2]


def oracle(camera, depth, views):
    """Return counts, footprints, and each point's distance from the nearest border in pixels."""
    fx, fy, cx, cy = np.asarray(camera.intrinsics, np.float64)
    pose = np.asarray(camera.camtoworld, np.float64)
    count = np.zeros(depth.shape, int)
    finest, clearance = np.full(depth.shape, np.inf), np.full(depth.shape, np.inf)
    for row, column in np.ndindex(*depth.shape):
        z = float(depth[row, column])
        if z == 0:
            continue
        ray = np.array([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1])
        point = pose[:, :3] @ (z * ray) + pose[:, 3]
        for i in range(len(views)):
            f, g, px, py = np.asarray(views.cameras.intrinsics[i], np.float64)
            source_pose = np.asarray(views.cameras.camtoworld[i], np.float64)
            x, y, s = source_pose[:, :3].T @ (point - source_pose[:, 3])
            u, v = f * x / s + px, g * y / s + py
            borders = (u, v, u - plane.WIDTH, v - plane.HEIGHT, u - 8)
            clearance[row, column] = min(clearance[row, column], *map(abs, borders))
            inside = s > 0 and 0 <= u < plane.WIDTH and 0 <= v < plane.HEIGHT
            if inside and views.weight[i, int(v), int(u)] > 0:
                count[row, column] += 1
                ratio = (s / np.sqrt(f * g)) / (z / np.sqrt(fx * fy))
                finest[row, column] = min(finest[row, column], ratio)
    return count, finest, clearance


def test_counts_and_footprints_match_the_definition(capture):
    views, depths = capture
    camera = plane.camera_above(0.8, 0.0, 5.0, tilt=0.1)
    depth = np.float32(plane.photograph(camera)[1])
    depth[3:6, 4:9] = 0
    found = support(camera, GRID, jnp.asarray(depth), views, depths, tolerance=0.1)
    count, finest, clearance = oracle(camera, depth, views)
    clear = clearance > 1e-3
    assert clear.mean() > 0.95
    assert set(range(5)) <= set(np.unique(count[clear]).tolist())
    np.testing.assert_array_equal(np.asarray(found.count)[clear], count[clear])
    np.testing.assert_allclose(np.asarray(found.footprint)[clear], finest[clear], rtol=1e-5)
    assert np.isinf(np.asarray(found.footprint)[3:6, 4:9]).all()


def test_a_footprint_is_the_distance_ratio_times_the_focal_length_ratio():
    views, depths = plane.make_views([plane.camera_above(0.0, 0.0, 4.0)])
    near = plane.camera_above(0.0, 0.0, 1.0)
    near = near.replace(intrinsics=near.intrinsics * jnp.array([2.0, 2, 1, 1]))
    found = support(near, GRID, jnp.ones(GRID.shape[:2]), views, depths)
    np.testing.assert_array_equal(found.count, 1)
    np.testing.assert_allclose(found.footprint, 4 * 2, rtol=1e-6)


def test_unseen_surfaces_have_no_support(capture):
    views, depths = capture
    wide = plane.camera_above(0.0, 0.0, 6.0)
    depth = jnp.asarray(plane.photograph(wide)[1], jnp.float32)
    assert support(wide, GRID, depth, views, depths).count.max() == 4
    # Points in front of the plane, where no depth map confirms them; and undefined depth.
    for wrong in (0.7 * depth, 0 * depth):
        found = support(wide, GRID, wrong, views, depths)
        assert found.count.max() == 0
        assert np.isinf(found.footprint).all()
    found = support(wide, GRID, depth, views.replace(weight=0 * views.weight), depths)
    assert found.count.max() == 0


def test_count_seen_equals_the_count_of_find_support(capture):
    views, depths = capture
    data = plane.camera_above(0.2, 0.1, 5.0), GRID, jnp.full(GRID.shape[:2], 5.0), views, depths
    np.testing.assert_array_equal(jax.jit(count_seen)(*data), support(*data).count)
