"""How near photographs come to a view of the plane z = 0, against a slow float64 oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import plane

from jaxcloseup.photos.proximity import measure_proximity


measure = jax.jit(measure_proximity, static_argnames="samples")
EVERY_PIXEL = plane.HEIGHT * plane.WIDTH


def land(points, camera):
    """Return where points fall in a camera's image, and their z-depths there."""
    pose = np.asarray(camera.camtoworld, np.float64)
    fx, fy, cx, cy = np.asarray(camera.intrinsics, np.float64)
    x, y, z = np.moveaxis((points - pose[:, 3]) @ pose[:, :3], -1, 0)
    return fx * x / z + cx, fy * y / z + cy, z


def inside(points, camera):
    x, y, z = land(points, camera)
    return (z > 0) & (x >= 0) & (x < plane.WIDTH) & (y >= 0) & (y < plane.HEIGHT)


def oracle(camera, source):
    """Return what one photograph of the plane, on which nothing is hidden, shares with a view."""
    points, depth = plane.photograph(camera)[2:0:-1]
    saw, sees = inside(points, source), inside(plane.photograph(source)[2], camera)
    a, b = saw.mean(), sees.mean()
    rays = [points - np.asarray(c.camtoworld, np.float64)[:, 3] for c in (camera, source)]
    lengths = [np.linalg.norm(ray, axis=-1) for ray in rays]
    angle = np.arccos(np.sum(rays[0] * rays[1], -1) / lengths[0] / lengths[1])
    ratio = (land(points, source)[2] / depth)[saw]
    return a, 1 / (1 / a + 1 / b - 1), np.median(ratio), np.median(angle[saw])


def test_matches_the_definition():
    poses = ((-0.9, 0.3, 4.1), (0.1, -0.2, 3.0), (0.5, 0.6, 6.0), (0.37, 0.11, 2.0))
    cameras = [plane.camera_above(x, y, z, tilt=0.3 * x) for x, y, z in poses]
    views, depths = plane.make_views(cameras)
    camera = plane.camera_above(0.33, 0.12, 1.3, tilt=0.21)
    depth = jnp.asarray(plane.photograph(camera)[1], jnp.float32)
    found = measure(camera, depth, views, depths, tolerance=0.2, samples=EVERY_PIXEL)
    for values in zip(*map(np.asarray, found), cameras, strict=True):
        # The depths of a float32 map are read at the nearest pixel, so borders may differ by one.
        np.testing.assert_allclose(values[:-1], oracle(camera, values[-1]), rtol=0.02)


def test_four_times_nearer_overlaps_by_a_sixteenth():
    far, near, beside = (plane.camera_above(x, 0.0, z) for x, z in ((0, 4), (0, 1), (30, 4)))
    views, depths = plane.make_views([far, near, beside])
    found = measure(near, depths[1], views, depths, samples=EVERY_PIXEL)
    np.testing.assert_allclose(found.overlap, [1 / 16, 1, 0], rtol=1e-5)
    np.testing.assert_allclose(found.depth_ratio, [4, 1, np.nan], rtol=1e-5)
    np.testing.assert_allclose(found.angle[1], 0, atol=1e-3)
    coarse = measure(near, depths[1], views, depths, samples=EVERY_PIXEL // 4)
    np.testing.assert_allclose(coarse.overlap, [1 / 16, 1, 0], rtol=0.2)


def test_what_a_view_does_not_show_is_not_shared():
    camera = plane.camera_above(0.0, 0.0, 2.0)
    views, depths = plane.make_views([camera, camera, camera])
    views = views.replace(weight=views.weight.at[1].set(0))
    depths = depths.at[2].set(1.0)  # something stands before the plane
    found = measure(camera, jnp.full_like(depths[0], 2.0), views, depths, samples=EVERY_PIXEL)
    np.testing.assert_allclose(found.seen, [1, 0, 0])
    np.testing.assert_allclose(found.overlap, [1, 0, 0])
    empty = measure(camera, jnp.zeros_like(depths[0]), views, depths, samples=EVERY_PIXEL)
    assert np.all(np.asarray(empty.overlap) == 0) and np.all(np.isnan(empty.angle))
