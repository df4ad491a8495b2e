import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxcloseup.field import Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.volume.encodings import positional_encoding
from jaxcloseup.volume.mlp import apply_network, init_network
from jaxcloseup.volume.nerf import NerfAux, NerfConfig, nerf
from tests import reference


TINY = NerfConfig(
    depth=3,
    width=16,
    skip_after=0,
    position_octaves=4,
    direction_octaves=2,
    direction_width=8,
    num_coarse=8,
    num_fine=8,
    chunk=24,
)
SIZE = 8


def camera(x=0.0):
    """One that looks along z from (x, 0, -2)."""
    pose = jnp.array([[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, -2]], float)
    return Camera(pose, jnp.array([8.0, 8, 4, 4]), SIZE, SIZE)


def field(**changes):
    return nerf(TINY.__class__(**{**TINY.__dict__, **changes}), near=1.0, far=3.0)


@functools.cache
def params():
    """Parameters whose scene is not empty."""
    params, buffers = field().init(jax.random.key(1), jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    assert buffers == ()
    for network in params.values():
        network["density"]["bias"] += 1.0
    return params


@functools.cache
def whole_image():
    return jax.jit(functools.partial(field().render, buffers=(), pixels=None, key=None))(
        params(), camera=camera(0.3)
    )


def test_the_network_is_the_oracles(key):
    network = init_network(
        key,
        depth=4,
        width=12,
        skip_after=1,
        position_features=15,
        direction_features=9,
        direction_width=6,
    )
    rays = jax.random.normal(key, (2, 3, 5))  # positions and directions of 5 rays
    positions = positional_encoding(jnp.repeat(rays[0], 4, axis=1), 2)
    directions = positional_encoding(rays[1], 1)
    ours = jax.jit(apply_network)(network, positions, directions)
    looking = np.repeat(directions, 4, axis=1).T
    density, rgb = reference.nerf_network(network, np.asarray(positions.T), looking)
    np.testing.assert_allclose(ours.density, density, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(ours.rgb, rgb.T, rtol=1e-4, atol=1e-5)


def test_shapes():
    image = whole_image()
    expected = Rendering(
        rgb=(8, 8, 3),
        depth=(8, 8),
        alpha=(8, 8),
        aux=NerfAux(coarse_rgb=(8, 8, 3), median_depth=(8, 8), expected_depth=(8, 8)),
    )
    assert jax.tree.map(jnp.shape, image) == expected
    assert np.all((image.depth > 1) & (image.depth < 3))
    np.testing.assert_allclose(image.aux.expected_depth, image.alpha * image.depth, rtol=1e-5)


def test_an_image_is_its_pixels_whatever_the_chunks_and_cameras():
    pixels = pixel_grid(SIZE, SIZE).reshape(-1, 2)
    cameras = jax.tree.map(lambda x: jnp.stack([x] * len(pixels)), camera(0.3))
    render = jax.jit(functools.partial(field(chunk=1000).render, buffers=(), key=None))
    for ours in (
        render(params(), camera=camera(0.3), pixels=pixels),
        render(params(), camera=cameras, pixels=pixels),
    ):
        ours = jax.tree.map(lambda x: x.reshape(SIZE, SIZE, *x.shape[1:]), ours)
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=2e-4), ours, whole_image())


def test_stacked_cameras_see_their_own_rays():
    pixels = jnp.array([[2.5, 3.5], [6.5, 1.5]])
    cameras = jax.tree.map(lambda *x: jnp.stack(x), camera(-0.5), camera(0.4))
    render = jax.jit(functools.partial(field().render, params(), (), key=None))
    together = render(cameras, pixels).rgb
    alone = [render(camera(x), pixels).rgb[i] for i, x in enumerate((-0.5, 0.4))]
    np.testing.assert_allclose(together, alone, rtol=1e-4)
    assert np.abs(together[0] - together[1]).max() > 1e-3


def test_a_key_perturbs():
    render = jax.jit(functools.partial(field().render, params(), (), camera(), None))
    first, again, other = (render(jax.random.key(seed)).rgb for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


def test_background_shows_where_nothing_is():
    seen = whole_image()
    white = jax.jit(functools.partial(field(background=1.0).render, params(), (), key=None))(
        camera(0.3), pixels=None
    )
    np.testing.assert_allclose(white.rgb, seen.rgb + (1 - seen.alpha[..., None]), rtol=1e-5)


def test_gradient_is_the_finite_difference(key):
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), (params(), camera()))
        pixels = jnp.array([[2.5, 3.5], [6.5, 1.5], [4.5, 4.5]], jnp.float64)
        target = jnp.full((3, 3), 0.3, jnp.float64)
        # One chunk at a time, so that recomputation is what is differentiated. No importance
        # samples: no gradient flows through their positions, but a difference would see them move.
        tiny = field(chunk=2, num_fine=1)

        def loss(step, direction):
            moved = jax.tree.map(lambda p, d: p + step * d, wide[0], direction)
            moved["coarse"] = jax.lax.stop_gradient(moved["coarse"])
            rendering = tiny.render(moved, (), wide[1], pixels, None)
            return tiny.loss(rendering, target, jnp.array([1.0, 0.5, 0.0], jnp.float64))[0]

        fixed = jax.tree.map(jnp.zeros_like, wide[0])
        keys = jax.random.split(key, len(jax.tree.leaves(fixed)))
        keys = jax.tree.unflatten(jax.tree.structure(fixed), list(keys))
        direction = jax.tree.map(lambda x, k: jax.random.normal(k, x.shape, x.dtype), fixed, keys)
        direction["coarse"] = fixed["coarse"]
        slope = jax.jit(jax.grad(loss))(0.0, direction)
        value = jax.jit(loss)
        numeric = (value(1e-5, direction) - value(-1e-5, direction)) / 2e-5
        np.testing.assert_allclose(slope, numeric, rtol=1e-5)
        assert abs(slope) > 1e-4


def test_no_weight_no_loss_no_gradient():
    tiny = field()

    def loss(p):
        rendering = tiny.render(p, (), camera(), jnp.array([[2.5, 3.5]]), jax.random.key(0))
        return tiny.loss(rendering, jnp.zeros((1, 3)), jnp.zeros(1))[0]

    value, gradient = jax.jit(jax.value_and_grad(loss))(params())
    assert value == 0
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(gradient))


def test_loss_is_a_weighted_mean():
    rgb = jnp.array([[0.1, 0.2, 0.3], [1.0, 1.0, 1.0]])
    rendering = Rendering(
        rgb, jnp.ones(2), jnp.ones(2), NerfAux(rgb + 0.1, jnp.ones(2), jnp.ones(2))
    )
    target = jnp.array([[0.2, 0.2, 0.3], [0.0, 0.0, 0.0]])
    value, metrics = field().loss(rendering, target, jnp.array([3.0, 1.0]))
    fine = (3 * 0.01 / 3 + 1 * 1) / 4
    coarse = (3 * (0.0 + 0.01 + 0.01) / 3 + 1 * 1.21) / 4
    np.testing.assert_allclose(value, fine + coarse, rtol=1e-5)
    np.testing.assert_allclose(metrics["psnr"], -10 * np.log10(fine), rtol=1e-5)


@pytest.mark.parametrize("compute_dtype", ["float32", "bfloat16"])
def test_learns_a_toy_scene(compute_dtype):
    tiny = field(compute_dtype=compute_dtype, width=32)
    state = tiny.init(jax.random.key(4), jnp.zeros((1, 3)), jnp.zeros((1, 3)))[0]
    pixels = pixel_grid(SIZE, SIZE).reshape(-1, 2)
    target = jnp.stack([pixels[:, 0] / 8, pixels[:, 1] / 8, 0 * pixels[:, 0] + 0.5], axis=-1)
    optimizer = optax.adam(1e-2)

    @jax.jit
    def step(state, opt_state, key):
        def loss(state):
            rendering = tiny.render(state, (), camera(), pixels, key)
            return tiny.loss(rendering, target, jnp.ones(len(pixels)))

        (value, _), gradient = jax.value_and_grad(loss, has_aux=True)(state)
        with jax.numpy_dtype_promotion("standard"):  # Optax raises floats to integer powers
            updates, opt_state = optimizer.update(gradient, opt_state)
        return optax.apply_updates(state, updates), opt_state, value

    opt_state = optimizer.init(state)
    values = []
    for key in jax.random.split(jax.random.key(5), 60):
        state, opt_state, value = step(state, opt_state, key)
        values.append(float(value))
    assert np.mean(values[-5:]) < 0.05 * values[0], values


def test_bfloat16_is_close(key):
    def loss(p, tiny):
        rendering = tiny.render(p, (), camera(), None, None)
        return tiny.loss(rendering, jnp.zeros((SIZE, SIZE, 3)), jnp.ones((SIZE, SIZE)))[0]

    value_and_grad = jax.jit(jax.value_and_grad(loss), static_argnums=1)
    value, gradient = value_and_grad(params(), field())
    narrow, narrow_gradient = value_and_grad(params(), field(compute_dtype="bfloat16"))
    np.testing.assert_allclose(narrow, value, rtol=1e-2)
    flat, narrow_flat = (
        np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])
        for tree in (gradient, narrow_gradient)
    )
    assert flat.dtype == narrow_flat.dtype == np.float32
    assert np.linalg.norm(flat - narrow_flat) < 0.03 * np.linalg.norm(flat)


@pytest.mark.parametrize(
    ("near", "far", "config", "message"),
    [
        (0.0, 1.0, NerfConfig(), "near and far"),
        (2.0, 1.0, NerfConfig(), "near and far"),
        (1.0, 2.0, NerfConfig(compute_dtype="float16"), "compute_dtype"),
    ],
)
def test_bad_settings_are_refused(near, far, config, message):
    with pytest.raises(ValueError, match=message):
        nerf(config, near=near, far=far)
