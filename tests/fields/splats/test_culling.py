"""Surfels that an image may show, against all that shows in it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_splats as reference
from splat_scenes import (
    ANTIALIASED,
    IDENTITY,
    INTRINSICS,
    NEAR,
    pixel_centers,
    random_scene,
    to_camera,
    to_surfels,
)

from jaxcloseup.fields.splats import culling, render_surfels


COUNT = 256
WINDOWS = {  # first pixel and size of a part of the image
    "corner": ((0, 0), (6, 5)),
    "middle": ((10, 8), (12, 8)),
    "whole": ((0, 0), (24, 32)),
}


def window(name):
    corner, size = WINDOWS[name]
    return INTRINSICS - np.array([0, 0, *corner]), size


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize(
    ("kwargs", "share"),
    [
        (dict(depth=(-0.5, 1.5), log_scale=(-4.0, -1.0)), 0.9),
        (dict(depth=(1.0, 3.0), log_scale=(-6.0, -3.0)), 0.3),
        (dict(depth=(-0.5, 1.5), log_scale=(-4.0, -1.0), num_scales=3), 0.9),
        (dict(depth=(1.0, 3.0), log_scale=(-6.0, -3.0), num_scales=3), 0.3),
    ],
    ids=["through the camera", "small", "volumes through the camera", "small volumes"],
)
def test_whatever_shows_is_kept(kwargs, share, antialias):
    scene = random_scene(3, count=COUNT, **kwargs)
    kept = {}
    for name in WINDOWS:
        intrinsics, (height, width) = window(name)
        options = {"near": NEAR, "antialias": antialias}
        known = scene, IDENTITY, intrinsics, pixel_centers(height, width)
        if scene["log_scales"].shape[1] == 3:
            alpha, _ = reference.project(*known, size=(width, height), **options)
        else:
            alpha, _ = reference.intersect(*known, **options)
        camera = to_camera(intrinsics=intrinsics, size=(height, width))
        surfels = to_surfels(scene)
        opacity = jax.nn.sigmoid(surfels.opacity_logits)
        shown = np.asarray(culling.may_show(surfels, opacity, camera, **options))
        shows = (alpha > 0).any(1)
        assert shows.any() and shown[shows].all()
        kept[name] = shown.mean()
    # What is kept must not be kept for nothing.
    assert kept["corner"] < share * kept["whole"]


@pytest.mark.parametrize(
    ("many", "number"),
    [
        *((16, number) for number in (0, 1, COUNT // 4, COUNT // 4 + 1, COUNT)),
        *((2 * COUNT, number) for number in (0, 1)),
    ],
)
@pytest.mark.parametrize("parts", [8, 7])
def test_a_function_of_the_shown_items_alone(many, number, parts, monkeypatch):
    """Values and gradients against NumPy, of few items in all, and of the shown ones of many."""
    monkeypatch.setattr(culling, "_MANY", many)
    monkeypatch.setattr(culling, "_PARTS", parts)
    rng = np.random.default_rng(5)
    items, faint = rng.normal(size=(COUNT, 3)), rng.uniform(size=COUNT)
    shown = np.isin(np.arange(COUNT), rng.permutation(COUNT)[:number])
    computed = shown if many == 16 or not number else np.ones(COUNT, bool)

    def function(items, shared):
        values, faint = items
        return shared * faint[:, None] * jnp.sin(values), faint

    @jax.jit
    def compute(items, shared):
        return culling.map_shown(function, items, shared, shown)

    def total(items, shared):
        table, faint = compute(items, shared)
        return jnp.sum(jnp.cos(table)) + jnp.sum(faint**2)

    given = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), ((items, faint), 2.0))
    table, kept = map(np.asarray, compute(*given))
    items, faint, rows = items[computed], faint[computed], computed.sum()
    expected = 2 * faint[:, None] * np.sin(items)
    np.testing.assert_allclose(table[:rows], expected, atol=1e-6)
    np.testing.assert_allclose(kept[:rows], faint, atol=1e-6)
    assert not table[rows:].any() and len(table) == COUNT

    (moved, fainter), by_shared = jax.grad(total, argnums=(0, 1))(*given)
    # What is shared may be left alone.
    for both, alone in zip((moved, fainter), jax.grad(total)(*given), strict=True):
        np.testing.assert_allclose(both, alone, atol=1e-6)
    bar = -np.sin(expected)
    np.testing.assert_allclose(moved[computed], bar * 2 * faint[:, None] * np.cos(items), atol=1e-6)
    np.testing.assert_allclose(
        fainter[computed], (bar * 2 * np.sin(items)).sum(1) + 2 * faint, atol=1e-5
    )
    assert by_shared == pytest.approx((bar * expected / 2).sum(), abs=1e-3)
    assert not np.any(moved[~computed]) and not np.any(fainter[~computed])


def test_culling_changes_no_image(monkeypatch):
    monkeypatch.setattr(culling, "_MANY", 16)
    surfels = to_surfels(random_scene(4, count=COUNT, log_scale=(-4.0, -2.0)))
    intrinsics, size = window("middle")
    camera, alive = to_camera(intrinsics=intrinsics, size=size), jnp.arange(COUNT) % 7 != 3

    def images():
        # A new function each time, so that nothing is taken from a cache.
        image = jax.jit(lambda *data: render_surfels(*data, ANTIALIASED))(surfels, alive, camera)
        return image.rgb, image.depth, image.alpha, image.normal

    culled = images()
    monkeypatch.setattr(
        "jaxcloseup.fields.splats.render.may_show", lambda _, opacity, *a, **k: opacity > 0
    )
    assert culled[2].max() > 0.5
    for ours, whole in zip(culled, images(), strict=True):
        np.testing.assert_allclose(ours, whole, atol=1e-6)
