"""A head of a scene's own: it begins as the known networks, and learns what they cannot know."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from experiments.studies import ibgs_arms
from experiments.studies.ibgs_arms import Gathered, Head, add_by_head, train_head
from jaxcloseup.detail.add import Detail, leave_out
from jaxcloseup.detail.weights import mix
from jaxcloseup.photos.depth_maps import join_maps


def gathered(shape, seed=0):
    """Make up what a view gathers."""
    rng = np.random.default_rng(seed)
    features, outputs, residual, colors = (
        rng.normal(scale=scale, size=(*shape, size)).astype(np.float32)
        for size, scale in ((4, 1), (2, 1), (3, 0.1), (3, 0.1))
    )
    return Gathered(features, outputs, residual, colors, rng.random(shape) < 0.8)


def test_an_untrained_head_changes_nothing():
    seen = gathered((12, 15))
    params = Head().init(jax.random.key(0), jnp.zeros((1, 8, 8, 13)))
    mixed, share = mix(*map(jnp.asarray, (seen.outputs, seen.residual, seen.colors)))
    expected = np.where(seen.seen[..., None], share[..., None] * mixed, 0)
    np.testing.assert_allclose(add_by_head(params, seen), expected, atol=1e-6)


def test_a_head_learns_what_neighbors_show(monkeypatch):
    """What is missing is the residual of the pixel to the left, which a single pixel hides."""
    monkeypatch.setattr(ibgs_arms, "_CROP", 32)
    missing, seen = [], []
    for seed in range(4):
        view = gathered((60, 70), seed)
        seen.append(view._replace(residual=view.residual / 2, colors=0 * view.colors))
        missing.append(np.roll(seen[-1].residual, 1, axis=1))
    params = train_head(list(zip(seen[:3], missing[:3], strict=True)), 200)
    inner, visible = np.s_[4:-4, 4:-4], seen[3].seen[..., None]
    off = np.abs(np.asarray(add_by_head(params, seen[3])) - missing[3]) * visible
    assert off[inner].mean() < 0.5 * np.abs(missing[3] * visible)[inner].mean()


def test_a_photograph_left_out_has_no_trust():
    depth, trust = jnp.ones((3, 4, 5)), jnp.full((3, 4, 5), 0.5)
    sources = join_maps(SimpleNamespace(), depth, trust)
    detail = Detail(None, sources, None, jnp.float32(0), jnp.float32(0))
    rest = leave_out(detail, 1).sources
    np.testing.assert_array_equal(rest.trust[:, 0, 0], [0.5, 0, 0.5])
    np.testing.assert_array_equal(rest.inverse_depth, sources.inverse_depth)
