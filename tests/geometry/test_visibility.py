import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.geometry.rotations import euler_to_matrix
from jaxcloseup.geometry.union_warp import block_sources, union_warp
from jaxcloseup.geometry.visibility import sample_where_visible
from jaxcloseup.geometry.warp import warp_forward_to, warp_to


SOURCE = Camera(jnp.eye(3, 4), jnp.array([40.0, 40, 20, 15]), height=30, width=40)
WALL, SCREEN = 4.0, 2.0  # z of a wall, and of a screen |x|, |y| < 0.3 in front of it
sample = jax.jit(sample_where_visible)
warp = jax.jit(warp_to)
TARGET = SOURCE.replace(
    camtoworld=SOURCE.camtoworld.at[:, 3].set(jnp.array([1.2, 0.1, 0.5])), height=24, width=36
)


def see(camera):
    """Depth of wall and screen, points on the wall, and whether a pixel shows the screen."""
    fx, fy, cx, cy = np.asarray(camera.intrinsics, np.float64)
    x0, y0, z0 = np.asarray(camera.position, np.float64)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y = (x - cx) / fx, (y - cy) / fy
    near, far = SCREEN - z0, WALL - z0
    screen = (np.abs(x0 + near * x) < 0.3) & (np.abs(y0 + near * y) < 0.3)
    points = np.stack([x0 + far * x, y0 + far * y, np.full(x.shape, WALL)], axis=-1)
    return np.where(screen, near, far), points, screen


def random_problem(key):
    """Two cameras that see each other's random surface in part, one of them from behind."""
    keys = jax.random.split(key, 6)
    cameras = []
    for key_angle, key_position in (keys[:2], keys[2:4]):
        rotation = euler_to_matrix(jax.random.uniform(key_angle, (3,), minval=-0.5, maxval=0.5))
        position = jax.random.uniform(key_position, (3, 1), minval=-0.7, maxval=0.7)
        camtoworld = jnp.concatenate([rotation, position], axis=1)
        cameras.append(Camera(camtoworld, jnp.array([8.0, 7, 5, 4]), 8, 10))
    depth = jax.random.uniform(keys[4], (8, 10), minval=0.1, maxval=3)
    depth = depth.at[0, :3].set(jnp.array([0.0, jnp.inf, jnp.nan])).at[1, 1].set(-1)
    return jax.random.uniform(keys[5], (8, 10, 2)), *cameras, depth


@pytest.mark.parametrize(("occluded", "jit"), [(False, True), (True, True), (True, False)])
def test_warp_to_matches_the_oracle(key, occluded, jit):
    image, source, target, depth = random_problem(key)
    source_depth = jax.random.uniform(key, (8, 10), minval=0.5, maxval=2) if occluded else None
    ours = (warp if jit else warp_to)(
        image, source, target, depth, source_depth=source_depth, tolerance=0.5
    )
    cameras = [(camera.camtoworld, camera.intrinsics) for camera in (source, target)]
    expected, valid, margin = reference.warp_to(image, *cameras, depth, source_depth, 0.5)
    clear = margin > 1e-3
    assert clear.mean() > 0.9
    assert 0.05 < valid.mean() < 0.95
    np.testing.assert_array_equal(np.asarray(ours.hit)[clear], valid[clear])
    np.testing.assert_allclose(np.asarray(ours.values)[clear], expected[clear], atol=1e-4)


def test_a_wall_behind_a_screen_is_read_only_where_the_source_sees_it():
    source_depth, points, _ = see(SOURCE)
    image = jnp.asarray(points[..., :2], jnp.float32)  # the wall's x and y: bilinear is exact
    depth, wall, screen = see(TARGET)
    arguments = image, SOURCE, TARGET, jnp.asarray(depth, jnp.float32)
    warped = warp(*arguments, source_depth=jnp.asarray(source_depth, jnp.float32))
    # The ray from the source, at the origin, to a point on the wall crosses z = SCREEN half way.
    crossing = np.abs(wall[..., :2]) * SCREEN / WALL
    hidden = (crossing < 0.3).all(-1) & ~screen
    x, y = 10 * wall[..., 0] + 20, 10 * wall[..., 1] + 15
    inside = (x > 0) & (x < 40) & (y > 0) & (y < 30)
    clear = ~screen & (np.abs(crossing - 0.3).min(-1) > 0.06)  # a source pixel is 0.05 wide there
    clear &= np.minimum(np.abs(x), np.abs(x - 40)) > 0.6  # the outermost half pixel is constant
    clear &= np.minimum(np.abs(y), np.abs(y - 30)) > 0.6
    assert (hidden & clear).sum() > 5
    assert (inside & ~hidden & clear).sum() > 100
    valid = np.asarray(warped.hit)
    np.testing.assert_array_equal(valid[clear], (inside & ~hidden)[clear])
    seen = clear & valid
    np.testing.assert_allclose(np.asarray(warped.values)[seen], wall[..., :2][seen], atol=1e-4)
    np.testing.assert_allclose(np.asarray(warped.pixels)[seen], np.stack([x, y], -1)[seen], 1e-4)
    assert not np.any(np.asarray(warped.values)[~valid])
    # Without the source's depth, the screen's color is taken for the wall behind it.
    assert np.asarray(warp(*arguments).hit)[hidden & clear & inside].all()


def test_points_behind_the_source_are_not_valid():
    depth = jnp.full((TARGET.height, TARGET.width), 2.0)
    ahead = SOURCE.replace(camtoworld=SOURCE.camtoworld.at[2, 3].set(9.0))
    image = jnp.ones((SOURCE.height, SOURCE.width, 1))
    for source_depth in (None, jnp.full((SOURCE.height, SOURCE.width), 2.0)):
        warped = warp(image, ahead, TARGET, depth, source_depth=source_depth, tolerance=jnp.inf)
        assert not jnp.any(warped.hit)
        assert jnp.all(jnp.isfinite(warped.pixels))


def test_gradients_are_finite_and_reach_image_and_depth(key):
    image, source, target, depth = random_problem(key)

    def total(image, depth, source, target):
        return jnp.sum(warp_to(image, source, target, depth).values)

    gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(image, depth, source, target)
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradients))
    valid = warp(image, source, target, depth).hit
    np.testing.assert_allclose(gradients[0].sum(), 2 * valid.sum(), rtol=1e-5)
    assert jnp.any(gradients[1] != 0)
    np.testing.assert_array_equal(gradients[1][~valid], 0)


@pytest.mark.parametrize("jit", [False, True])
def test_warp_forward_to_matches_the_oracle(key, jit):
    image, source, target, depth = random_problem(key)
    valid = jax.random.uniform(key, depth.shape) < 0.7
    forward = jax.jit(warp_forward_to) if jit else warp_forward_to
    ours = forward(image, source, target, depth, valid=valid)
    drawn = np.asarray(valid & (depth > 0) & jnp.isfinite(depth))
    poses = [(camera.camtoworld, camera.intrinsics) for camera in (source, target)]
    grid = np.asarray(pixel_grid(8, 10))
    points = reference.unproject(*poses[0], grid[drawn], np.asarray(depth)[drawn])
    pixels, z = reference.project(*poses[1], points)
    expected, z_buffer = reference.forward_warp(np.asarray(image)[drawn], pixels, z, (8, 10))
    assert 5 < np.isfinite(z_buffer).sum() < 75
    np.testing.assert_array_equal(ours.hit, np.isfinite(z_buffer))
    np.testing.assert_array_equal(ours.values, expected.astype(np.float32))
    np.testing.assert_allclose(ours.depth, z_buffer, rtol=1e-5)


def test_forward_warps_join_in_one_target(key):
    """Two sources drawn one after the other equal the union of both."""
    image, source, target, depth = random_problem(key)
    sources = jax.tree.map(lambda *leaves: jnp.stack(leaves), source, target)
    images, depths = jnp.stack([image, image[::-1]]), jnp.stack([depth, depth[::-1]])
    view = target.replace(camtoworld=target.camtoworld.at[2, 3].add(-0.5))
    first = warp_forward_to(images[0], source, view, depths[0])
    both = warp_forward_to(images[1], target, view, depths[1], into=first)
    grid = pixel_grid(view.height, view.width)
    union = union_warp(block_sources(sources, depths), sources, images, view, grid)
    assert (both.hit & ~first.hit).any()
    np.testing.assert_array_equal(both.values, union.values)
    np.testing.assert_array_equal(both.hit, union.hit)


def test_warp_to_batches_under_vmap(key):
    image, source, target, depth = random_problem(key)
    shifts = jnp.array([0.0, 0.2, -0.3])
    poses = jnp.stack([source.camtoworld.at[0, 3].add(shift) for shift in shifts])
    sources = source.replace(camtoworld=poses, intrinsics=jnp.tile(source.intrinsics, (3, 1)))
    together = jax.jit(jax.vmap(warp_to, (None, 0, None, None)))(image, sources, target, depth)
    for i in range(3):
        one = warp(image, source.replace(camtoworld=poses[i]), target, depth)
        np.testing.assert_allclose(together.values[i], one.values, atol=1e-5)
        np.testing.assert_array_equal(together.hit[i], one.hit)


def test_wrong_shapes_and_types_are_refused(key):
    image, source, target, depth = random_problem(key)
    for wrong in (image[:5], (255 * image).astype(jnp.uint8)):
        with pytest.raises(AssertionError):
            warp_to(wrong, source, target, depth)
    with pytest.raises(AssertionError):
        warp_to(image, source, target, depth[:5])
    with pytest.raises(AssertionError):
        warp_to(image, source, target, depth, source_depth=depth[:5])


def test_a_view_weighs_only_points_that_its_depth_confirms():
    depth, points, screen = (jnp.asarray(array) for array in see(SOURCE))
    depth, points = depth.astype(jnp.float32), points.astype(jnp.float32)
    weight = jnp.full(depth.shape, 0.7).at[:, :5].set(0)
    seen = sample(SOURCE, depth, weight, points, 0.02)
    np.testing.assert_allclose(seen.pixels, pixel_grid(SOURCE.height, SOURCE.width), atol=1e-3)
    np.testing.assert_allclose(seen.depth, WALL, rtol=1e-6)
    np.testing.assert_array_equal(seen.weight, jnp.where(screen, 0, weight))
    for outside in (points + jnp.array([[[100.0, 0, 0]]]), -points):
        assert not jnp.any(sample(SOURCE, depth, weight, outside, jnp.inf).weight)
