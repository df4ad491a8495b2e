"""Selective Adam against optax's Adam, fed with the gradients of each surfel's own steps."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from splat_scenes import COUNT, random_scene, to_surfels

from jaxcloseup.fields.splats.selective_adam import scale_by_selective_adam


def test_each_surfel_has_the_steps_of_adam_when_it_is_seen():
    params = to_surfels(random_scene(0))
    rng = np.random.default_rng(0)
    seen = rng.random((12, COUNT)) < 0.5
    seen[:, 0], seen[:, 1] = True, False
    drawn = [
        jax.tree.map(lambda leaf: rng.normal(size=leaf.shape).astype(np.float32), params)
        for _ in seen
    ]
    gradients = []
    ours = scale_by_selective_adam()
    state, taken = ours.init(params), []
    update = jax.jit(ours.update)
    for now, gradient in zip(seen, drawn, strict=True):
        # A prior has gradients everywhere, but a surfel out of sight has none of color and place.
        # One that is black is seen, too, and has none of its color.
        colored = now & (np.arange(COUNT) % 3 > 0)
        gradient = gradient.replace(
            sh=np.where(colored[:, None, None], gradient.sh, 0),
            means=np.where(now[:, None], gradient.means, 0),
        )
        gradients.append(gradient)
        moved, state = update(gradient, state)
        taken.append(moved)
    np.testing.assert_array_equal(state.count, seen.sum(0))
    adam = optax.scale_by_adam(eps=1e-15)
    for surfel in range(COUNT):
        alone = adam.init(jax.tree.map(lambda leaf, i=surfel: jnp.asarray(leaf[i]), params))
        for now, gradient, moved in zip(seen[:, surfel], gradients, taken, strict=True):
            own = jax.tree.map(lambda leaf, i=surfel: np.asarray(leaf[i]), moved)
            if not now:
                assert not any(np.any(leaf) for leaf in jax.tree.leaves(own))
                continue
            own_gradient = jax.tree.map(lambda leaf, i=surfel: jnp.asarray(leaf[i]), gradient)
            with jax.numpy_dtype_promotion("standard"):  # optax mixes integers and floats
                expected, alone = adam.update(own_gradient, alone)
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4), own, expected)
