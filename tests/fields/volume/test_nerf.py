import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import reference

from jaxcloseup.fields.contract import Rendering
from jaxcloseup.fields.volume.config import NerfConfig
from jaxcloseup.fields.volume.encodings import positional_encoding
from jaxcloseup.fields.volume.nerf import nerf_field
from jaxcloseup.fields.volume.networks import apply_network, init_network
from jaxcloseup.fields.volume.rays import Extent, VolumeAux
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.photos.views import Batch
from jaxcloseup.training.loss import rendered_loss


TINY = NerfConfig(
    depth=2,
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


def camera(x=0.3):
    """A camera that looks along z from (x, 0, -2)."""
    pose = jnp.array([[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, -2]], float)
    return Camera(pose, jnp.array([8.0, 8, 4, 4]), SIZE, SIZE)


def field(**changes):
    return nerf_field(dataclasses.replace(TINY, **changes), Extent(1.0, 3.0))


@functools.cache
def params():
    """Parameters whose scene is not empty; drawn by NumPy, which compiles nothing."""
    shapes, buffers = jax.eval_shape(field().init, jax.random.key(0), *[jnp.zeros((1, 3))] * 2)
    assert buffers == ()
    numbers = np.random.default_rng(1)
    params = jax.tree.map(lambda x: jnp.asarray(0.3 * numbers.normal(size=x.shape), "f4"), shapes)
    for network in params.values():
        network["density"]["bias"] += 1.0
    return params


@functools.cache
def renderer(**changes):
    """`(params, camera, pixels, key) -> Rendering`, compiled."""
    render = field(**changes).render
    return jax.jit(lambda params, *args: render(params, (), *args))


def whole_image(x=0.3):
    return renderer()(params(), camera(x), None, None)


@functools.cache
def loss_and_gradient(**changes):
    """`(params, weight) -> loss, gradient` of a whole image that should be black, compiled."""
    tiny = field(**changes)

    def loss(params, weight):
        rendering = tiny.render(params, (), camera(), None, None)
        return tiny.loss(rendering, jnp.zeros((SIZE, SIZE, 3)), weight)[0]

    return jax.jit(jax.value_and_grad(loss))


def test_the_network_matches_the_oracle(key):
    tiny = field(depth=4, skip_after=1)
    shapes = jax.eval_shape(tiny.init, key, *[jnp.zeros((1, 3))] * 2)[0]["fine"]
    numbers = np.random.default_rng(2)
    network = jax.tree.map(lambda x: jnp.asarray(0.3 * numbers.normal(size=x.shape), "f4"), shapes)
    positions, directions = (jnp.asarray(numbers.normal(size=(3, 5)), "f4") for _ in range(2))
    positions = positional_encoding(jnp.repeat(positions, 4, axis=1), 4)  # 5 rays of 4 samples
    directions = positional_encoding(directions, 2)
    ours = jax.jit(apply_network)(network, positions, directions)
    looking = np.repeat(directions, 4, axis=1).T
    density, rgb = reference.nerf_network(network, np.asarray(positions.T), looking)
    np.testing.assert_allclose(ours.density, density, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(ours.rgb, rgb.T, rtol=1e-4, atol=1e-5)


def test_the_default_network_has_the_documented_shapes():
    full = nerf_field(NerfConfig(), Extent(1.0, 2.0))
    shapes = jax.eval_shape(full.init, jax.random.key(0), *[jnp.zeros((1, 3))] * 2)[0]["fine"]
    trunk = [[w.shape for w in layer["weights"]] for layer in shapes["trunk"]]
    plain = [(256, 256)]
    assert trunk == [[(256, 63)], *[plain] * 4, [(256, 256), (256, 63)], plain, plain]
    assert [w.shape for w in shapes["view"]["weights"]] == [(128, 256), (128, 27)]


def test_initial_weights_are_glorot_uniform():
    init = functools.partial(
        init_network,
        depth=2,
        width=128,
        skip_after=0,
        position_features=63,
        direction_features=27,
        direction_width=64,
    )
    network = jax.jit(init)(jax.random.key(0))
    for layer, fans in ((network["trunk"][1], 128 + 63 + 128), (network["view"], 128 + 27 + 64)):
        weights = np.concatenate([np.ravel(w) for w in layer["weights"]])
        np.testing.assert_allclose(np.abs(weights).max(), (6 / fans) ** 0.5, rtol=1e-2)
        np.testing.assert_allclose(weights.std(), (2 / fans) ** 0.5, rtol=0.03)
        assert np.all(layer["bias"] == 0)


def test_shapes():
    image = whole_image()
    expected = Rendering(
        rgb=(8, 8, 3),
        depth=(8, 8),
        alpha=(8, 8),
        aux=VolumeAux(coarse_rgb=(8, 8, 3), median_depth=(8, 8), expected_depth=(8, 8)),
    )
    assert jax.tree.map(jnp.shape, image) == expected
    assert np.all((image.depth > 1) & (image.depth < 3))
    np.testing.assert_allclose(image.aux.expected_depth, image.alpha * image.depth, rtol=1e-5)


def test_an_image_equals_its_pixels_in_chunks_of_any_size():
    pixels = pixel_grid(SIZE, SIZE).reshape(-1, 2)
    ours = renderer(chunk=None)(params(), camera(), pixels, None)
    ours = jax.tree.map(lambda x: x.reshape(SIZE, SIZE, *x.shape[1:]), ours)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=2e-4), ours, whole_image())


def test_stacked_cameras_see_their_own_pixels():
    pixels = pixel_grid(SIZE, SIZE).reshape(-1, 2)
    cameras = jax.tree.map(lambda a, b: jnp.stack([a, b] * 32), camera(-0.5), camera(0.4))
    ours = renderer()(params(), cameras, pixels, None).rgb
    even, odd = (whole_image(x).rgb.reshape(-1, 3) for x in (-0.5, 0.4))
    np.testing.assert_allclose(ours[::2], even[::2], rtol=2e-4)
    np.testing.assert_allclose(ours[1::2], odd[1::2], rtol=2e-4)
    assert np.abs(even - odd).max() > 1e-3


def test_scaled_coordinates_move_the_network_not_the_depth():
    """A scene seen through `center` and `scale` is the same scene, transformed."""
    moved = nerf_field(TINY, Extent(2.0, 6.0, center=(2.0, 0.0, 4.0), scale=0.5))
    pose = camera().camtoworld.at[:, 3].set(jnp.array([2 + 2 * 0.3, 0.0, 4 - 2 * 2.0]))
    thin = jax.tree.map(jnp.copy, params())
    for network in thin.values():  # half the density, for twice the distance
        network["density"] = jax.tree.map(lambda x: x / 2, network["density"])
    pixels = jnp.array([[2.5, 3.5]])
    ours = jax.jit(moved.render)(thin, (), camera().replace(camtoworld=pose), pixels, None)
    expected = jax.tree.map(lambda x: x[3, 2], whole_image())
    np.testing.assert_allclose(ours.rgb[0], expected.rgb, rtol=1e-3)
    np.testing.assert_allclose(ours.depth[0], 2 * expected.depth, rtol=1e-3)


def test_a_key_perturbs_the_samples():
    render = functools.partial(renderer(), params(), camera(), None)
    first, again, other = (render(jax.random.key(seed)).rgb for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


def test_background_shows_through_empty_space():
    pixels = jnp.array([[2.5, 3.5]])
    white = renderer(background=1.0)(params(), camera(), pixels, None).rgb[0]
    seen = jax.tree.map(lambda x: x[3, 2], whole_image())
    np.testing.assert_allclose(white, seen.rgb + (1 - seen.alpha), rtol=1e-4)


def test_gradient_is_the_finite_difference(key):
    """Each network against its own loss, because moving the coarse one moves the fine samples."""
    with jax.enable_x64(True):
        wide, view = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), (params(), camera()))
        pixels = jnp.array([[2.5, 3.5], [6.5, 1.5], [4.5, 4.5]], jnp.float64)
        target = jnp.full((3, 3), 0.3, jnp.float64)
        weight = jnp.array([1.0, 0.5, 0.0], jnp.float64)
        tiny = field(chunk=2)
        leaves, treedef = jax.tree.flatten(wide)
        keys = jax.random.split(key, len(leaves))
        direction = treedef.unflatten(
            [jax.random.normal(k, x.shape, x.dtype) for k, x in zip(keys, leaves, strict=True)]
        )

        def losses(steps):
            moved = {
                name: jax.tree.map(lambda p, d: p + steps[name] * d, wide[name], direction[name])  # noqa: B023
                for name in wide
            }
            seen = tiny.render(moved, (), view, pixels, None)
            of_fine = seen._replace(aux=seen.aux._replace(coarse_rgb=target))
            each = {"coarse": seen._replace(rgb=target), "fine": of_fine}
            each = {name: tiny.loss(part, target, weight)[0] for name, part in each.items()}
            return each["coarse"] + each["fine"], each

        value_and_grad = jax.jit(jax.value_and_grad(losses, has_aux=True))
        zero = {"coarse": 0.0, "fine": 0.0}
        slopes = value_and_grad(zero)[1]
        for name, slope in slopes.items():
            up, down = (value_and_grad(zero | {name: h})[0][1][name] for h in (1e-5, -1e-5))
            np.testing.assert_allclose(slope, (up - down) / 2e-5, rtol=1e-5)
            assert abs(slope) > 1e-4


def test_zero_weight_gives_zero_loss_and_gradient():
    value, gradient = loss_and_gradient()(params(), jnp.zeros((SIZE, SIZE)))
    assert value == 0
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(gradient))


def test_loss_is_a_weighted_mean():
    rgb = jnp.array([[0.1, 0.2, 0.3], [1.0, 1.0, 1.0]])
    ones = jnp.ones(2)
    rendering = Rendering(rgb, ones, ones, VolumeAux(rgb + 0.1, ones, ones))
    target = jnp.array([[0.2, 0.2, 0.3], [0.0, 0.0, 0.0]])
    value, metrics = field().loss(rendering, target, jnp.array([3.0, 1.0]))
    fine = (3 * 0.01 / 3 + 1 * 1) / 4
    coarse = (3 * (0.0 + 0.01 + 0.01) / 3 + 1 * 1.21) / 4
    np.testing.assert_allclose(value, fine + coarse, rtol=1e-5)
    np.testing.assert_allclose(metrics["psnr"], -10 * np.log10(fine), rtol=1e-5)


def test_learns_a_toy_scene():
    """64 pixels in chunks of 24, in bfloat16, which is harder than float32."""
    tiny = field(compute_dtype="bfloat16")
    state = params()
    pixels = pixel_grid(SIZE, SIZE).reshape(-1, 2)
    target = jnp.stack([pixels[:, 0] / 8, pixels[:, 1] / 8, 0 * pixels[:, 0] + 0.5], axis=-1)
    batch = Batch(camera(), pixels, target, jnp.ones(len(pixels)))
    optimizer = optax.adam(1e-2)

    def step(carry, key):
        state, opt_state = carry
        loss = functools.partial(rendered_loss, field=tiny, chunk=24)
        (value, _), gradient = jax.value_and_grad(loss, has_aux=True)(state, (), batch, key)
        with jax.numpy_dtype_promotion("standard"):  # Optax raises floats to integer powers
            updates, opt_state = optimizer.update(gradient, opt_state)
        return (optax.apply_updates(state, updates), opt_state), value

    carry = state, jax.jit(optimizer.init)(state)
    _, values = jax.jit(functools.partial(jax.lax.scan, step))(
        carry, jax.random.split(jax.random.key(5), 60)
    )
    assert values[-5:].mean() < 0.05 * values[0], values


def test_bfloat16_is_close():
    everywhere = jnp.ones((SIZE, SIZE))
    value, gradient = loss_and_gradient()(params(), everywhere)
    narrow, narrow_gradient = loss_and_gradient(compute_dtype="bfloat16")(params(), everywhere)
    np.testing.assert_allclose(narrow, value, rtol=1e-2)
    flat, narrow_flat = (
        np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])
        for tree in (gradient, narrow_gradient)
    )
    assert flat.dtype == narrow_flat.dtype == np.float32
    assert np.linalg.norm(flat - narrow_flat) < 0.03 * np.linalg.norm(flat)


def test_an_unknown_type_is_refused():
    with pytest.raises(ValueError, match="compute_dtype"):
        nerf_field(NerfConfig(compute_dtype="float16"), Extent(1.0, 2.0))
