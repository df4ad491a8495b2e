"""Initial surfels, their colors, and the regularizers of their images."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_splats import rotation_of, sh_color
from splat_scenes import to_camera

from jaxcloseup.fields.splats import surfels_from_points
from jaxcloseup.fields.splats.regularizers import (
    depth_to_normal,
    normal_inconsistency,
    scale_free_distortion,
)
from jaxcloseup.fields.splats.spherical_harmonics import rgb_to_sh, sh_basis, sh_to_rgb
from jaxcloseup.geometry.cameras import Camera


def test_surfels_fill_the_gaps_between_points(key):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 3)).astype(np.float32)
    points[7] = np.nan
    points[20:26] = points[20]
    rgb = rng.uniform(size=(300, 3)).astype(np.float32)
    surfels, alive = surfels_from_points(
        key, jnp.asarray(points), jnp.asarray(rgb), capacity=320, sh_degree=2
    )
    assert surfels.sh.shape == (320, 9, 3)
    assert alive.sum() == 299
    kept = np.delete(np.arange(300), 7)
    squared = np.sum((points[kept, None].astype(float) - points[None, kept]) ** 2, axis=-1)
    nearest = np.sort(squared, axis=1)[:, 1:4].mean(1)
    expected = np.sqrt(np.maximum(nearest, 1e-7))
    scales = np.exp(surfels.log_scales[np.asarray(alive)])
    np.testing.assert_allclose(surfels.means[np.asarray(alive)], points[kept])
    np.testing.assert_allclose(scales, np.stack([expected, expected], 1), rtol=1e-4)
    direction = jnp.array([[0.6, 0.0, 0.8]])
    colors = sh_to_rgb(surfels.sh[np.asarray(alive)], direction)
    np.testing.assert_allclose(colors, rgb[kept], atol=1e-6)
    opacity = jax.nn.sigmoid(surfels.opacity_logits[np.asarray(alive)])
    np.testing.assert_allclose(opacity, 0.1, rtol=1e-5)
    for leaf in jax.tree.leaves(surfels):
        assert np.all(np.isfinite(leaf))


def test_too_many_points_are_thinned_at_random(key):
    points = jnp.asarray(np.random.default_rng(0).normal(size=(50, 3)), jnp.float32)
    points = points.at[:20].set(jnp.inf)
    surfels, alive = surfels_from_points(
        key, points, jnp.full((50, 3), 0.5), capacity=25, sh_degree=0
    )
    assert alive.all() and surfels.sh.shape == (25, 1, 3)
    rows = {tuple(row) for row in np.asarray(points[20:])}
    assert len({tuple(row) for row in np.asarray(surfels.means)} & rows) == 25


def test_harmonics_are_orthonormal():
    nodes, weights = np.polynomial.legendre.leggauss(12)
    azimuth = np.arange(16) * 2 * np.pi / 16
    z, phi = np.meshgrid(nodes, azimuth, indexing="ij")
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], -1)
    with jax.enable_x64(True):
        basis = np.asarray(sh_basis(jnp.asarray(directions.reshape(-1, 3)), 3))
    measure = np.repeat(weights, 16) * 2 * np.pi / 16
    np.testing.assert_allclose(basis.T @ (measure[:, None] * basis), np.eye(16), atol=1e-10)


def test_rotations_mix_harmonics_within_a_degree():
    """Rotating directions mixes the functions of each degree by an orthogonal matrix."""
    directions = np.random.default_rng(1).normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turn = rotation_of([0.3, -0.5, 0.7, 0.2])
    with jax.enable_x64(True):
        before = np.asarray(sh_basis(jnp.asarray(directions), 3))
        after = np.asarray(sh_basis(jnp.asarray(directions @ turn.T), 3))
    for degree in range(4):
        block = slice(degree**2, (degree + 1) ** 2)
        mix, residual, *_ = np.linalg.lstsq(before[:, block], after[:, block], rcond=None)
        assert np.all(residual < 1e-20)
        np.testing.assert_allclose(mix @ mix.T, np.eye(2 * degree + 1), atol=1e-12)


@pytest.mark.parametrize("degree", range(4))
def test_colors_agree_with_written_out_polynomials(degree):
    rng = np.random.default_rng(degree)
    sh = rng.normal(size=((degree + 1) ** 2, 3))
    direction = np.array([0.48, -0.6, 0.64])
    computed = sh_to_rgb(jnp.asarray(sh, jnp.float32), jnp.asarray(direction, jnp.float32))
    np.testing.assert_allclose(computed, sh_color(sh, direction), atol=2e-6)
    np.testing.assert_allclose(
        sh_to_rgb(rgb_to_sh(jnp.array([[0.1, 0.7, 1.0]])), jnp.array([0.0, 0.0, 1.0])),
        [0.1, 0.7, 1.0],
        atol=1e-6,
    )


def test_an_unknown_degree_is_refused():
    with pytest.raises(ValueError, match="degree 0 to 3"):
        sh_basis(jnp.zeros(3), 4)


def test_normals_of_a_plane_are_exact():
    turn = rotation_of([0.9, 0.2, -0.3, 0.1])
    camtoworld = np.concatenate([turn, [[1.0], [2.0], [-0.5]]], axis=1)
    normal = np.array([0.3, -0.4, -0.85])  # in the camera's frame, towards it
    normal /= np.linalg.norm(normal)
    with jax.enable_x64(True):
        camera = to_camera(camtoworld, dtype=jnp.float64)
        x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
        rays = np.stack([(x - 14.5) / 30, (y - 13) / 34, np.ones_like(x)], axis=-1)
        depth = -1.5 / (rays @ normal)
        depth[:, 20:] = 0
        found, pullback = jax.vjp(jax.jit(lambda d: depth_to_normal(camera, d)), depth)
        gradient = pullback(jnp.ones_like(found))[0]
    found = np.asarray(found)
    sine = np.linalg.norm(np.cross(found[1:-1, 1:19], turn @ normal), axis=-1)
    assert np.degrees(sine).max() < 1e-5
    assert np.all(found[1:-1, 1:19] @ (turn @ normal) > 0)
    assert np.all(found[:, 19:] == 0) and np.all(found[[0, -1]] == 0)
    assert np.all(np.isfinite(gradient))


@pytest.mark.parametrize("size", [(1, 5), (2, 3), (4, 1)])
def test_images_that_are_all_border_have_no_normals(size):
    camera = Camera(jnp.eye(3, 4), jnp.array([9.0, 9, 2, 1]), *size)
    normal = depth_to_normal(camera, jnp.ones(size))
    assert normal.shape == (*size, 3) and not normal.any()


def test_float32_normals_agree_with_opencv():
    """OpenCV takes the differences of points on a bumpy depth map."""
    camera = to_camera()
    x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
    depth = 2 + 0.1 * np.sin(x / 3) * np.cos(y / 4)
    points = np.stack([(x - 14.5) / 30, (y - 13) / 34, np.ones_like(x)], -1) * depth[..., None]
    kernel = np.array([[-1.0, 0.0, 1.0]])
    across, down = cv2.filter2D(points, -1, kernel), cv2.filter2D(points, -1, kernel.T)
    expected = np.cross(down, across)[1:-1, 1:-1]
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    found = jax.jit(depth_to_normal)(camera, jnp.asarray(depth, jnp.float32))
    np.testing.assert_allclose(found[1:-1, 1:-1], expected, atol=2e-5)
    assert np.all(expected[..., 2] < 0)


def test_regularizers_agree_with_arithmetic():
    normal = jnp.zeros((2, 2, 3)).at[0, 0].set(jnp.array([0.0, 0.6, -0.3]))
    surface = jnp.zeros((2, 2, 3)).at[0].set(jnp.array([0.0, 0.6, -0.8]))
    alpha = jnp.array([[0.5, 1.0], [1.0, 1.0]])
    loss = normal_inconsistency(normal, surface, alpha)
    np.testing.assert_allclose(loss, [[0.5 * (1 - 0.6), 1.0], [0, 0]], atol=1e-6)
    gradient = jax.grad(lambda a: normal_inconsistency(normal, surface, a).sum())(alpha)
    assert np.all(gradient == 0)

    # Several views at once, as large as photographs for training: jax 0.10.2 summed them wrongly.
    rng = np.random.default_rng(0)
    one, several = (rng.normal(size=size).astype("f4") for size in ((67, 120, 3), (6, 67, 120, 3)))
    batched = jax.jit(jax.vmap(lambda other: normal_inconsistency(one, other, jnp.ones((67, 120)))))
    np.testing.assert_allclose(batched(several), 1 - np.sum(one * several, -1), atol=1e-5)

    # Two splats of weights 0.5 and 0.25 at depths 2 and 4, in the published mapping.
    near, far = 0.2, 100.0
    mapped = [far / (far - near) * (1 - near / z) for z in (2.0, 4.0)]
    rendered = jnp.array(0.5 * 0.25 * (1 / 2 - 1 / 4) ** 2)
    np.testing.assert_allclose(
        scale_free_distortion(rendered, near * far / (far - near)),
        0.5 * 0.25 * (mapped[0] - mapped[1]) ** 2,
        rtol=1e-5,
    )
