import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.geometry.rotations import euler_to_matrix
from jaxcloseup.geometry.union_warp import block_sources, union_warp


VIEWS, HEIGHT, WIDTH = 3, 21, 34  # neither a multiple of the block size

block = jax.jit(block_sources)
warp = jax.jit(union_warp)


@pytest.fixture(scope="module")
def capture():
    """Three cameras around random depths, some undefined, with random 8-bit colors."""
    keys = jax.random.split(jax.random.key(3), 5)
    rotations = euler_to_matrix(jax.random.uniform(keys[0], (VIEWS, 3), minval=-0.3, maxval=0.3))
    positions = jax.random.uniform(keys[1], (VIEWS, 3, 1), minval=-0.4, maxval=0.4)
    cameras = Camera(
        jnp.concatenate([rotations, positions], axis=-1),
        jnp.tile(jnp.array([[30.0, 28, 16, 11]]), (VIEWS, 1)),
        HEIGHT,
        WIDTH,
    )
    depths = jax.random.uniform(keys[2], (VIEWS, HEIGHT, WIDTH), minval=1.5, maxval=4)
    depths = depths.at[:, 3:5, 7:11].set(0).at[1, 0, 0].set(jnp.nan).at[2, 6, 1].set(-1)
    rgb = jax.random.randint(keys[3], (VIEWS, HEIGHT, WIDTH, 3), 0, 256).astype(jnp.uint8)
    weight = jnp.ones(depths.shape).at[0, 10:].set(0)
    rotation = euler_to_matrix(jnp.array([0.2, -0.3, 0.5]))
    position = jnp.array([[0.3], [-0.2], [1.2]])
    virtual = Camera(
        jnp.concatenate([rotation, position], axis=-1), jnp.array([30.0, 28, 16, 11]), HEIGHT, WIDTH
    )
    return cameras, depths, rgb, weight, virtual


def by_oracle(cameras, depths, rgb, weight, virtual):
    """Lift and project every pixel on its own, then draw them one after the other."""
    colors, pixels, depth = [], [], []
    grid = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)
    for view in range(VIEWS):
        there = np.asarray((depths[view] > 0) & (weight[view] > 0))
        if not there.any():
            continue
        points = reference.unproject(
            cameras.camtoworld[view], cameras.intrinsics[view], grid[there], depths[view][there]
        )
        landed, z = reference.project(virtual.camtoworld, virtual.intrinsics, points)
        colors.append(np.asarray(rgb[view])[there])
        pixels.append(landed)
        depth.append(z)
    return reference.forward_warp(*map(np.concatenate, (colors, pixels, depth)), (HEIGHT, WIDTH))


def test_every_pixel_matches_the_oracle(capture):
    cameras, depths, rgb, weight, virtual = capture
    sources = block(cameras, depths, weight)
    result = warp(sources, cameras, rgb, virtual, pixel_grid(HEIGHT, WIDTH))
    values, depth = by_oracle(*capture)
    assert 0.2 < np.isfinite(depth).mean() < 0.999
    np.testing.assert_array_equal(result.hit, np.isfinite(depth))
    np.testing.assert_allclose(result.depth, depth, rtol=1e-5)
    np.testing.assert_array_equal(result.values, values)
    assert result.values.dtype == jnp.uint8


def test_chosen_pixels_with_repeats_read_the_whole_image(capture, key):
    cameras, depths, rgb, weight, virtual = capture
    sources = block(cameras, depths, weight)
    index = jax.random.randint(key, (40, 2), 0, jnp.array([[WIDTH, HEIGHT]]))
    index = jnp.concatenate([index, index[:5]])
    result = warp(sources, cameras, rgb, virtual, index.astype(jnp.float32) + 0.5)
    values, depth = by_oracle(*capture)
    np.testing.assert_array_equal(result.values, values[index[:, 1], index[:, 0]])
    np.testing.assert_allclose(result.depth, depth[index[:, 1], index[:, 0]], rtol=1e-5)


def test_an_excluded_view_has_no_sources(capture):
    cameras, depths, rgb, weight, virtual = capture
    sources = block(cameras, depths, weight)
    result = warp(sources, cameras, rgb, virtual, pixel_grid(HEIGHT, WIDTH), exclude=1)
    values, depth = by_oracle(cameras, depths, rgb, weight.at[1].set(0), virtual)
    np.testing.assert_array_equal(result.values, values)
    np.testing.assert_array_equal(result.hit, np.isfinite(depth))


def test_spheres_hold_their_points_and_culling_loses_none(capture):
    cameras, depths, rgb, weight, virtual = capture
    sources = block(cameras, depths, weight)
    # From far inside and far outside the scene: culled blocks must be those that cannot land.
    for z in (-3.0, 2.5, 50.0):
        moved = virtual.replace(camtoworld=virtual.camtoworld.at[2, 3].set(z))
        result = warp(sources, cameras, rgb, moved, pixel_grid(HEIGHT, WIDTH))
        values, _ = by_oracle(cameras, depths, rgb, weight, moved)
        np.testing.assert_array_equal(result.values, values)


def test_virtual_cameras_batch_under_vmap(capture):
    """Some warps equal their predecessor; some differ in the camera or in the excluded view."""
    cameras, depths, rgb, weight, virtual = capture
    sources = block(cameras, depths, weight)
    shifts, excludes = [0.0, 0.0, 0.2, 0.2, 0.0], [-1, -1, -1, 1, -1]
    count = len(shifts)
    several = jax.tree.map(lambda leaf: jnp.stack([leaf] * count), virtual)
    several = several.replace(camtoworld=several.camtoworld.at[:, 0, 3].add(jnp.array(shifts)))
    grid = pixel_grid(HEIGHT, WIDTH)
    together = jax.jit(
        jax.vmap(lambda c, exclude: union_warp(sources, cameras, rgb, c, grid, exclude=exclude))
    )(several, jnp.array(excludes))
    for i, exclude in enumerate(excludes):
        camera = jax.tree.map(lambda leaf, i=i: leaf[i], several)
        seen = weight if exclude < 0 else weight.at[exclude].set(0)
        values, _ = by_oracle(cameras, depths, rgb, seen, camera)
        np.testing.assert_array_equal(together.values[i], values)


def test_without_any_depth_nothing_lands(capture):
    cameras, depths, rgb, _, virtual = capture
    result = warp(block(cameras, depths * 0), cameras, rgb, virtual, pixel_grid(HEIGHT, WIDTH))
    assert not jnp.any(result.hit)
    assert jnp.all(jnp.isinf(result.depth))
