"""Native projection and its derivative against JAX's, of which other tests have oracles."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splat_scenes import CONFIG, SCENES, random_scene, to_camera, to_surfels

from jaxcloseup.fields.splats import render_surfels
from jaxcloseup.native import library


pytestmark = pytest.mark.skipif(not library.available(), reason="the native library is not built")


def loss(surfels, camera, config, weights):
    alive = jnp.ones(surfels.means.shape[0], bool)
    image = render_surfels(surfels, alive, camera, config)
    outputs = image.rgb, image.depth, image.aux.normal, image.aux.median_depth, image.alpha
    total = sum(jnp.sum(w * x) for w, x in zip(weights, outputs, strict=True))
    return total + 0.1 * jnp.sum(image.aux.distortion), image


@functools.cache
def differentiate(compositor, antialias):
    config = dataclasses.replace(CONFIG, compositor=compositor, antialias=antialias)
    both = jax.value_and_grad(functools.partial(loss, config=config), argnums=(0, 1), has_aux=True)
    return jax.jit(both)


@pytest.mark.parametrize(
    ("scene", "antialias"),
    [("in front", True), ("through the camera", False), ("harmonics of degree 3", True)],
)
def test_images_and_all_derivatives_are_those_of_jax(scene, antialias):
    arrays = SCENES.get(scene)
    if arrays is None:
        arrays = random_scene(7)
        rng = np.random.default_rng(8)
        arrays = {**arrays, "sh": 0.3 * rng.normal(size=(len(arrays["means"]), 16, 3))}
    surfels, camera = to_surfels(arrays), to_camera()
    rng = np.random.default_rng(9)
    shape = camera.height, camera.width
    weights = [
        jnp.asarray(rng.normal(size=(*shape, *more)), jnp.float32)
        for more in ((3,), (), (3,), (), ())
    ]
    (_, image), bars = differentiate("native", antialias)(surfels, camera, weights=weights)
    (_, other), expected = differentiate("loops", antialias)(surfels, camera, weights=weights)
    for new, old in zip(jax.tree.leaves(image), jax.tree.leaves(other), strict=True):
        assert np.abs(new - old).mean() <= 1e-5 * np.abs(old).mean() + 1e-7
    for (path, new), old in zip(
        jax.tree_util.tree_leaves_with_path(bars), jax.tree.leaves(expected), strict=True
    ):
        where = jax.tree_util.keystr(path)
        assert np.isfinite(new).all(), where
        assert np.abs(new - old).mean() <= 2e-5 * np.abs(old).mean(), where
        np.testing.assert_allclose(new, old, rtol=0, atol=2e-4 * np.abs(old).max(), err_msg=where)


def test_a_batch_of_cameras_is_each_camera():
    surfels, alive = to_surfels(SCENES["in front"]), jnp.ones(16, bool)
    cameras = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf + 0.02]), to_camera())
    config = CONFIG.__class__(near=CONFIG.near, compositor="native")

    def color(surfels, camera):
        return render_surfels(surfels, alive, camera, config).rgb

    together = jax.vmap(color, (None, 0))(surfels, cameras)
    for i in range(2):
        alone = color(surfels, jax.tree.map(lambda leaf, i=i: leaf[i], cameras))
        np.testing.assert_array_equal(together[i], alone)


def test_a_cotangent_of_numpy_counts_as_one_of_jax():
    """Of an output of the library's own derivative, whose missing cotangents are zeros."""
    surfels, alive, camera = to_surfels(SCENES["in front"]), jnp.ones(16, bool), to_camera()
    config = dataclasses.replace(CONFIG, compositor="native")

    def median(surfels):
        return render_surfels(surfels, alive, camera, config).aux.median_depth

    depth, pull = jax.vjp(median, surfels)
    (by_numpy,), (by_jax,) = pull(np.ones(depth.shape, np.float32)), pull(jnp.ones_like(depth))
    assert np.abs(by_jax.means).max() > 0
    np.testing.assert_array_equal(by_numpy.means, by_jax.means)


def test_cameras_of_double_precision_are_not_given_to_the_library():
    surfels, alive, camera = to_surfels(SCENES["in front"]), jnp.ones(16, bool), to_camera()
    expected = render_surfels(surfels, alive, camera, CONFIG).rgb
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        camera = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), camera)
        config = dataclasses.replace(CONFIG, compositor="native")
        rgb = render_surfels(surfels, alive, camera, config).rgb
        assert rgb.dtype == jnp.float64
        np.testing.assert_allclose(rgb, expected, atol=1e-4)


@pytest.mark.parametrize("compositor", ["native", "loops"])
def test_no_surfels_are_an_empty_image(compositor):
    none = jax.tree.map(lambda leaf: leaf[:0], to_surfels(SCENES["in front"]))
    config = dataclasses.replace(CONFIG, compositor=compositor)

    def brightness(surfels):
        return jnp.sum(render_surfels(surfels, jnp.ones(0, bool), to_camera(), config).rgb)

    value, bars = jax.value_and_grad(brightness)(none)
    assert value == 0 and bars.means.shape == (0, 3)
