import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.fields.contract import RadianceField, Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photos.views import Batch, Measured
from jaxcloseup.training.loss import judge, rendered_loss


CAMERA = Camera(jnp.eye(4)[:3], jnp.array([8.0, 8, 4, 4]), 8, 8)


def _render(params, buffers, camera, pixels, key):
    """Colors that depend on the pixel and its camera through trainable weights."""
    x = pixels / 8 + camera.position[..., :2].reshape(-1, 2) + buffers
    rgb = jnp.tanh(x @ params["first"]) @ params["second"]
    if key is not None:
        rgb += jax.random.normal(key, rgb.shape)
    return Rendering(rgb, rgb[:, 0], rgb[:, 0])


def _loss(rendering, target, weight):
    squared = jnp.sum((rendering.rgb - target) ** 2, axis=-1)
    total = jnp.sum(weight)
    loss = jnp.where(total > 0, jnp.sum(weight * squared) / jnp.where(total > 0, total, 1), 0)
    return loss, {"root": jnp.sqrt(jnp.max(squared))}


FIELD = RadianceField(init=lambda *_: None, render=_render, loss=_loss)


def problem(stacked, weight=None):
    keys = jax.random.split(jax.random.key(7), 6)
    params = {
        "first": jax.random.normal(keys[0], (2, 5)),
        "second": jax.random.normal(keys[1], (5, 3)),
    }
    camera = CAMERA
    if stacked:
        poses = CAMERA.camtoworld[None] + jax.random.normal(keys[2], (10, 3, 4))
        camera = Camera(poses, jnp.tile(CAMERA.intrinsics, (10, 1)), 8, 8)
    pixels, rgb = jax.random.uniform(keys[3], (10, 2)), jax.random.uniform(keys[4], (10, 3))
    weight = jax.random.uniform(keys[5], (10,)) if weight is None else weight
    return params, jnp.full((1, 1), 0.1), Batch(camera, 8 * pixels, rgb, weight)


@functools.partial(jax.jit, static_argnames="chunk")
def differentiate(params, buffers, batch, key, chunk):
    loss = functools.partial(rendered_loss, field=FIELD, chunk=chunk)
    return jax.value_and_grad(lambda p: loss(p, buffers, batch, key), has_aux=True)(params)


@pytest.mark.parametrize("stacked", [False, True])
@pytest.mark.parametrize("chunk", [4, 5])
def test_chunks_change_nothing(stacked, chunk):
    args = problem(stacked)
    whole = differentiate(*args, None, None)
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-5),
        differentiate(*args, None, chunk),
        whole,
    )
    loss = rendered_loss(*args, None, field=FIELD, chunk=chunk)
    np.testing.assert_allclose(loss[0], whole[0][0], rtol=1e-6)


def test_chunks_add_up_the_loss_on_measured_depth():
    """Ten pixels in chunks of four; two have no known depth, and fill counts for nothing."""
    params, buffers, batch = problem(False)
    trust = jnp.array([1.0, 0.5, 0, 1, 1, 1, 0, 1, 1, 1])
    batch = batch._replace(measured=Measured(jnp.linspace(0.5, 1.5, 10), trust))

    def depth_loss(rendering, depth, trust):
        return jnp.mean(trust * (rendering.depth - depth) ** 2)

    field = FIELD._replace(depth_loss=depth_loss)

    def total(params):
        seen = _render(params, buffers, batch.cameras, batch.pixels, None)
        error = trust * (seen.depth - batch.measured.depth) ** 2
        return _loss(seen, batch.rgb, batch.weight)[0] + jnp.sum(error) / 10

    expected = jax.jit(jax.value_and_grad(total))(params)
    for chunk in (None, 4):
        loss = functools.partial(rendered_loss, field=field, chunk=chunk)
        found = jax.jit(jax.value_and_grad(loss, has_aux=True))(params, buffers, batch, None)
        np.testing.assert_allclose(found[0][0], expected[0], rtol=1e-5)
        jax.tree.map(
            functools.partial(np.testing.assert_allclose, rtol=1e-5), found[1], expected[1]
        )


def test_every_chunk_draws_its_own_numbers():
    params, buffers, batch = problem(False)
    batch = batch._replace(pixels=batch.pixels[:1].repeat(10, 0), rgb=jnp.zeros((10, 3)))

    def loss(rendering, target, weight):
        return jnp.mean(weight), {"spread": jnp.std(rendering.rgb, axis=0)}

    noisy = functools.partial(rendered_loss, field=FIELD._replace(loss=loss), chunk=1)
    _, metrics = jax.jit(jax.grad(noisy, has_aux=True))(params, buffers, batch, jax.random.key(0))
    assert np.all(metrics["spread"] > 0.3)


def test_zero_weight_gives_zero_loss_and_gradient():
    (loss, _), gradient = differentiate(*problem(True, jnp.zeros(10)), None, 4)
    assert loss == 0
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(gradient))


def test_a_sum_of_losses_scales_their_gradients():
    params, buffers, batch = problem(True)

    def total(params):
        loss = functools.partial(rendered_loss, field=FIELD, chunk=4)
        return 0.5 * loss(params, buffers, batch, None)[0] + 3 * params["first"].sum()

    gradient = jax.jit(jax.grad(total))(params)
    alone = differentiate(params, buffers, batch, None, None)[1]
    np.testing.assert_allclose(gradient["first"], 0.5 * alone["first"] + 3, rtol=1e-5)
    np.testing.assert_allclose(gradient["second"], 0.5 * alone["second"], rtol=1e-5)


def test_a_renderings_overflow_is_among_its_metrics():
    rgb, weight = jnp.full((4, 3), 0.5), jnp.ones(4)
    rendering = Rendering(rgb, weight, weight)
    loss, metrics = judge(FIELD, rendering, 0 * rgb, weight)
    assert set(metrics) == {"root"}
    full = rendering._replace(overflow=jnp.int32(7))
    same_loss, metrics = judge(FIELD, full, 0 * rgb, weight)
    assert same_loss == loss
    assert metrics["overflow"] == 7
    assert metrics["overflow"].dtype == jnp.float32
