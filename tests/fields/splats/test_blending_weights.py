"""The weights of splats, against renders in which one splat alone is white."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from splat_scenes import CONFIG, COUNT, random_scene, to_camera, to_surfels

from jaxcloseup.fields.contract import RadianceField
from jaxcloseup.fields.splats import render_surfels
from jaxcloseup.fields.splats.blending_weights import blending_weights


def test_weights_are_what_a_splat_adds_to_the_views():
    surfels, alive = to_surfels(random_scene(0)), jnp.arange(COUNT) != 5

    def draw(params, alive, camera, pixels, key):
        return render_surfels(params, alive, camera, CONFIG, background=jnp.zeros(3))

    field = RadianceField(init=None, render=draw, loss=None)
    aside = np.eye(4)[:3]
    aside[0, 3] = 0.3
    cameras = [to_camera(), to_camera(aside)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    weigh = jax.jit(functools.partial(blending_weights, field))
    weights = weigh(surfels, alive, stacked)

    show = jax.jit(lambda params, camera: draw(params, alive, camera, None, None))
    for row in range(COUNT):
        level = np.where(np.arange(COUNT) == row, 0.5, -0.5) / 0.28209479
        sh = jnp.zeros_like(surfels.sh).at[:, 0].set(jnp.asarray(level, jnp.float32)[:, None])
        shown = [show(surfels.replace(sh=sh), camera).rgb[..., 0].sum() for camera in cameras]
        np.testing.assert_allclose(weights[row], sum(shown), rtol=1e-4, atol=1e-4)
    assert weights[5] == 0
    opaque = sum(show(surfels, camera).alpha.sum() for camera in cameras)
    np.testing.assert_allclose(weights.sum(), opaque, rtol=1e-4)
