"""Settings of labels, a field whose steps have a closed form, and comparison of two steps."""

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxcloseup.fields.contract import RadianceField, Rendering
from jaxcloseup.geometry.cameras import pixel_grid, pixels_to_rays
from jaxcloseup.geometry.poses import PoseSettings
from jaxcloseup.labels.make import PseudoSettings
from jaxcloseup.training.state import init_state
from jaxcloseup.training.steps import run_steps, train_step


RATE = 0.25


def settings(**changes):
    pose = PoseSettings(jnp.array([2.0, 8.0]), jnp.float32(0.5), jnp.float32(jnp.inf))
    values = {
        "use_mask": 1.0,
        "rgb_tolerance": 0.15,
        "depth_tolerance": jnp.inf,
        "fixed_anchors": 0.0,
        "forward_label": 0.0,
        "leave_out_source": 0.0,
        "label_loss_weight": 0.5,
    }
    return PseudoSettings(pose, **{k: jnp.float32(v) for k, v in (values | changes).items()})


def one_color_field():
    """A field of one trainable color, whose depth is that of the plane: steps in closed form."""

    def render(params, buffers, camera, pixels, key):
        if camera.intrinsics.ndim > 1:
            shape = pixels.shape[:-1]
            depth = jnp.ones(shape)
        else:
            depth = jnp.asarray(plane_depth(camera, pixels))
            shape = depth.shape
        rgb = jnp.broadcast_to(params.reshape((1,) * len(shape) + (3,)), (*shape, 3))
        return Rendering(rgb, depth, jnp.ones(shape))

    def loss(rendering, target, weight):
        total = jnp.sum(weight)
        squared = jnp.sum((rendering.rgb - target) ** 2, axis=-1)
        return jnp.sum(weight * squared) / jnp.where(total == 0, 1, total), {}

    def init(key, points, rgb):
        return jnp.full(3, 0.2), ()

    return RadianceField(init, render, loss)


def plane_depth(camera, pixels):
    if pixels is None:
        pixels = pixel_grid(camera.height, camera.width)
    origins, directions = pixels_to_rays(camera, pixels)
    return -origins[..., 2] / directions[..., 2]


def fresh_state(seed=0):
    return init_state(
        jax.random.key(seed),
        jnp.zeros((0, 3)),
        jnp.zeros((0, 3)),
        field=one_color_field(),
        optimizer=optax.sgd(RATE),
    )


def assert_same_step(arm, alone, before):
    """Gradients agree to 1e-4 of the largest, and parameters with a clear gradient to 1e-5.

    Adam divides by the gradient's size: of what is only rounding it makes a whole step.
    """

    def compare(new, old, new_moment, old_moment):
        new_moment, old_moment = np.asarray(new_moment), np.asarray(old_moment)
        largest = np.abs(old_moment).max()
        np.testing.assert_allclose(new_moment, old_moment, rtol=0, atol=1e-4 * largest)
        clear = np.abs(old_moment) > 0.01 * largest
        np.testing.assert_allclose(
            np.asarray(new)[clear], np.asarray(old)[clear], rtol=1e-5, atol=1e-5
        )

    jax.tree.map(compare, arm.params, alone.params, arm.opt_state[0].mu, alone.opt_state[0].mu)
    changed = jax.tree.map(lambda x, y: float(jnp.abs(x - y).max()), alone.params, before.params)
    assert max(jax.tree.leaves(changed)) > 1e-3


def run_train_steps(state, views, *, count, **static):
    """Take `count` steps on photographs in one loop."""
    return run_steps(lambda state: train_step(state, views, **static), state, count=count)
