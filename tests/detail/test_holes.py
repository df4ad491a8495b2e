"""Holes: which pixels no photograph speaks of, and the colors that spread into them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.detail.holes import fill_holes, find_empty
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.photos.depth_maps import join_maps


HEIGHT, WIDTH = 24, 40


def camera(x=0.0):
    """A camera at `[x, 0, 0]` that looks along z, with a focal length of 40 pixels."""
    pose = jnp.concatenate([jnp.eye(3), jnp.array([[x], [0.0], [0.0]])], axis=1)
    intrinsics = jnp.array([WIDTH, WIDTH, WIDTH / 2, HEIGHT / 2], jnp.float32)
    return Camera(pose, intrinsics, HEIGHT, WIDTH)


def photographs(count, depth):
    """That many photographs from the origin with the same depth map."""
    cameras = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[camera()] * count)
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-9), 0).astype(np.float32)
    inverse = jnp.tile(jnp.asarray(inverse)[None], (count, 1, 1))
    return join_maps(cameras, inverse, jnp.ones_like(inverse))


def wall_with_a_gap():
    """Depth of a wall at z = 2 that is missing in the columns 10 to 19."""
    depth = np.full((HEIGHT, WIDTH), 2.0)
    depth[:, 10:20] = 0
    return depth


def test_a_ray_is_empty_where_two_photographs_look_through_a_gap():
    pixels, gap = pixel_grid(HEIGHT, WIDTH), wall_with_a_gap() == 0
    found = find_empty(camera(), pixels, photographs(2, wall_with_a_gap()))
    np.testing.assert_array_equal(found, gap)
    unsure = np.asarray(find_empty(camera(), pixels, photographs(1, wall_with_a_gap())))
    assert unsure[:, 11:19].min() == unsure.max() == 0.5 and not unsure[~gap].any()
    assert not find_empty(camera(), pixels, photographs(3, np.full((HEIGHT, WIDTH), 2.0))).any()


def test_padding_is_no_emptiness():
    """Photographs of other sizes are padded; what they would have shown there is not known."""
    depth = np.full((HEIGHT, WIDTH), 2.0)
    depth[:, 12:] = 0
    pixels, maps = pixel_grid(HEIGHT, WIDTH), photographs(3, depth)
    assert find_empty(camera(), pixels, maps).any()
    sizes = jnp.array([[HEIGHT, 12]] * 3)
    assert not find_empty(camera(), pixels, maps, sizes=sizes).any()


def test_a_ray_is_empty_in_a_moved_camera_too():
    # Photographs look through x / z in [-1/4, 0]. The ray of a pixel k columns left of the middle
    # has x / z = 1 / z - k / 40, and places from z = 1/4 to 16 are tried: k must be 2.5 or more.
    found = np.asarray(
        find_empty(camera(1.0), pixel_grid(HEIGHT, WIDTH), photographs(3, wall_with_a_gap()))
    )
    assert found[:, :17].all() and not found[:, 18:].any()


def test_empty_rays_of_a_large_image_are_those_of_a_small_one():
    large = camera()
    large = large.replace(intrinsics=8 * large.intrinsics, height=8 * HEIGHT, width=8 * WIDTH)
    found = find_empty(large, pixel_grid(8 * HEIGHT, 8 * WIDTH), photographs(3, wall_with_a_gap()))
    share = np.asarray(found).reshape(HEIGHT, 8, WIDTH, 8).mean((1, 3))
    # It tries every third pixel, so the borders are off by two at most.
    assert np.abs(share - (wall_with_a_gap() == 0)).max() <= 2 / 8
    assert share.sum() == pytest.approx((wall_with_a_gap() == 0).sum(), rel=0.05)


def fading(height=HEIGHT, width=WIDTH):
    """Opacity that fades from 1 to 0 on the right, and where a photograph saw a surface."""
    alpha = np.clip((width - 8 - np.arange(width)) / 6, 0, 1)
    alpha = np.tile(alpha.astype(np.float32), (height, 1))
    return jnp.asarray(alpha), jnp.asarray(alpha > 0.5)


def test_a_hole_in_one_color_has_that_color():
    alpha, seen = fading()
    color = jnp.array([0.2, 0.5, 0.8])
    rgb = alpha[..., None] * color[None, None]
    filled = fill_holes(rgb, alpha, seen, jnp.zeros(seen.shape))
    hole = ~np.asarray(seen)
    np.testing.assert_allclose(filled[hole], np.tile(color, (hole.sum(), 1)), atol=0.06)
    clear = np.asarray(alpha) < 0.05
    np.testing.assert_allclose(filled[clear], np.tile(color, (clear.sum(), 1)), atol=1e-5)
    np.testing.assert_array_equal(filled[:, : WIDTH // 2], rgb[:, : WIDTH // 2])


def test_colors_spread_from_the_nearest_pixels():
    alpha = jnp.ones((HEIGHT, WIDTH)).at[:, 16:24].set(0)
    seen = alpha > 0
    rgb = jnp.where(jnp.arange(WIDTH)[None, :, None] < 20, 1.0, 0.0) * alpha[..., None]
    rgb = jnp.broadcast_to(rgb, (HEIGHT, WIDTH, 3))
    row = np.asarray(fill_holes(rgb, alpha, seen, jnp.zeros(seen.shape)))[HEIGHT // 2, :, 0]
    assert row[16] > 0.8 and row[23] < 0.2 and np.all(np.diff(row[14:26]) <= 1e-6)


def test_emptiness_stays_black():
    alpha, seen = fading()
    rgb = 0.5 * jnp.repeat(alpha[..., None], 3, axis=-1)
    np.testing.assert_array_equal(fill_holes(rgb, alpha, seen, jnp.where(seen, 0.0, 1.0)), rgb)


def test_an_image_without_anything_stays_black():
    nothing = jnp.zeros((HEIGHT, WIDTH))
    filled = fill_holes(jnp.zeros((HEIGHT, WIDTH, 3)), nothing, nothing > 0, nothing)
    np.testing.assert_array_equal(filled, np.zeros((HEIGHT, WIDTH, 3)))


def test_what_is_not_wanted_does_not_change_the_rest():
    wanted = jnp.zeros((8 * HEIGHT, 8 * WIDTH), bool).at[50:90, 100:].set(True)
    large = camera()
    large = large.replace(intrinsics=8 * large.intrinsics, height=8 * HEIGHT, width=8 * WIDTH)
    given = large, pixel_grid(8 * HEIGHT, 8 * WIDTH), photographs(2, wall_with_a_gap())
    every, some = (np.asarray(find_empty(*given, which)) for which in (None, wanted))
    np.testing.assert_array_equal(some[wanted], every[wanted])
    assert every[wanted].any() and not some[-8:].any()


def test_a_single_ray_among_others_is_not_empty():
    depth = np.full((HEIGHT, WIDTH), 2.0)
    depth[12, 20] = 0  # two photographs saw nothing there, by mistake
    assert not find_empty(camera(), pixel_grid(HEIGHT, WIDTH), photographs(2, depth)).any()


def test_half_empty_pixels_are_half_filled():
    alpha, seen = fading()
    rgb = 0.5 * jnp.repeat(alpha[..., None], 3, axis=-1)
    unsure = [fill_holes(rgb, alpha, seen, jnp.where(seen, 0.0, e)) for e in (0.0, 0.5, 1.0)]
    full, half, none = (np.asarray(image)[:, -1].mean() for image in unsure)
    assert full > 0.45 and none == 0 and 0.1 < half < full - 0.1
