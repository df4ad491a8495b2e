"""New surfels where a photograph of a textured plane shows what its render does not."""

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest

from jaxcloseup.fields.splats.refinement import (
    IN_FRONT,
    SIZE,
    join_surfels,
    replace_least,
    surfels_where_wrong,
)
from jaxcloseup.fields.splats.spherical_harmonics import sh_to_rgb
from jaxcloseup.geometry.cameras import points_to_pixels
from jaxcloseup.geometry.rotations import quaternion_to_matrix


WRONG = np.s_[4:16, 10:30]  # rows and columns


@pytest.fixture(scope="module")
def found():
    """Surfels at the wrong pixels of a photograph whose render is right elsewhere."""
    camera = plane.camera_above(0.3, 0.2, 4.0, tilt=0.3)
    rgb, depth, _ = plane.photograph(camera)
    rendered = np.array(rgb)
    rendered[WRONG] = 1 - rendered[WRONG]
    images = np.asarray(rgb), np.ones(rgb.shape[:2], np.float32), rendered, np.asarray(depth)
    images = map(lambda image: jnp.asarray(image, jnp.float32), images)
    return (
        camera,
        rgb,
        depth,
        surfels_where_wrong(jax.random.key(0), camera, *images, count=300, sh_degree=1),
    )


def test_new_surfels_lie_on_the_surface_where_the_render_is_wrong(found):
    camera, rgb, depth, (surfels, alive) = found
    wrong = np.zeros(depth.shape, bool)
    wrong[WRONG] = np.abs(2 * np.asarray(rgb)[WRONG] - 1).mean(-1) > 1e-6
    assert int(alive.sum()) == wrong.sum() < 300
    pixels, distance = map(np.asarray, points_to_pixels(camera, surfels.means[alive]))
    column, row = np.floor(pixels.T).astype(int)
    assert np.all(wrong[row, column]) and len(set(zip(row, column, strict=True))) == len(row)
    there = np.asarray(depth)[row, column]
    np.testing.assert_allclose(distance, there * (1 - IN_FRONT), rtol=1e-4)
    colors = sh_to_rgb(surfels.sh[alive], jnp.zeros((len(row), 3)).at[:, 2].set(1))
    np.testing.assert_allclose(colors, np.asarray(rgb)[row, column], atol=1e-5)
    size = np.exp(np.asarray(surfels.log_scales[alive])) * float(camera.intrinsics[0])
    np.testing.assert_allclose(size, np.repeat(SIZE * there[:, None], 2, axis=1), rtol=1e-5)
    normals = np.asarray(quaternion_to_matrix(surfels.quaternions[alive]))[..., 2]
    np.testing.assert_allclose(np.abs(normals[:, 2]), 1, atol=1e-3)  # that of the plane


def test_new_volumes_are_round(found):
    camera, rgb, depth, _ = found
    images = (np.asarray(image, np.float32) for image in (rgb, depth > 0, 1 - rgb, depth))
    volumes, _ = surfels_where_wrong(
        jax.random.key(0), camera, *map(jnp.asarray, images), count=9, sh_degree=0, num_scales=3
    )
    size = np.exp(volumes.log_scales) * float(camera.intrinsics[0])
    away = (np.asarray(volumes.means) - np.asarray(camera.position)) @ camera.rotation[:, 2]
    np.testing.assert_allclose(size, SIZE * np.tile(away[:, None], 3) / (1 - IN_FRONT), rtol=1e-4)


def test_joined_surfels_are_the_living_ones_of_both(found):
    _, _, _, new = found
    old = jax.tree.map(lambda leaf: leaf[:6], new[0]), jnp.arange(6) % 2 == 0
    living = int(new[1].sum())
    surfels, alive = join_surfels(old, new, capacity=400)
    assert len(alive) == 400 and int(alive.sum()) == 3 + living
    np.testing.assert_array_equal(surfels.means[:3], old[0].means[::2])
    np.testing.assert_array_equal(surfels.means[3 : 3 + living], new[0].means[new[1]])
    fewer, alive = join_surfels(old, new, capacity=10)
    assert alive.all()
    np.testing.assert_array_equal(fewer.means, surfels.means[:10])


def test_new_surfels_take_free_rows_then_those_that_show_least(found):
    """Opacity times area: a faint large surfel shows more than an opaque tiny one."""
    _, _, _, (drawn, _) = found
    old, new = (jax.tree.map(lambda x, s=part: x[s], drawn) for part in (slice(6), slice(6, 9)))
    opacity, scale = np.array([0.5, 0.9, 0.9, 0.1, 0.9, 0.9]), np.array([3, 1, 2, 4, 9, 9])
    old = old.replace(
        opacity_logits=jnp.log(opacity / (1 - opacity)),
        log_scales=jnp.log(jnp.stack([scale, scale], axis=-1) / 100),
    )  # opacity times area: 4.5, 0.9, 3.6, 1.6, -, 72.9
    alive = jnp.array([True, True, True, True, False, True])
    surfels, living, changed = replace_least(old, alive, new, jnp.array([True, False, True]))
    np.testing.assert_array_equal(changed, [False, True, False, False, True, False])
    assert living.all()
    np.testing.assert_array_equal(surfels.means[4], new.means[0])
    np.testing.assert_array_equal(surfels.sh[1], new.sh[2])
    kept = np.array([0, 2, 3, 5])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[kept], b[kept]), surfels, old)
    none, living, changed = replace_least(old, alive, new, jnp.zeros(3, bool))
    jax.tree.map(np.testing.assert_array_equal, none, old)
    assert not changed.any() and np.array_equal(living, alive)
