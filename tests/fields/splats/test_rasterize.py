"""Images and derivatives of splats against a NumPy splatter, and their invariances."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splat_derivatives import VECTORS, check_derivatives, images_of, pose, pullback
from splat_scenes import (
    ANTIALIASED,
    CONFIG,
    COUNT,
    INTRINSICS,
    NEAR,
    OUTPUTS,
    SCENES,
    SPLATS,
    VOLUMES,
    oracle,
    random_scene,
    render,
    to_camera,
    to_surfels,
)

from jaxcloseup.fields.splats.config import RasterizeConfig
from jaxcloseup.fields.splats.raster_plan import plan_raster


@pytest.mark.parametrize(
    ("name", "antialias"),
    [
        *((name, False) for name in SPLATS),
        *((name, True) for name in ("in front", "far and small", *VOLUMES)),
    ],
)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_images_agree_with_the_oracle(name, antialias, precision):
    """Rays that meet discs, and ellipses of volumes, with either filter."""
    expected = oracle(SPLATS[name], antialias=antialias)
    config = ANTIALIASED if antialias else CONFIG
    with jax.enable_x64(precision == "float64"):
        splats, camera = to_surfels(SPLATS[name], precision), to_camera(dtype=precision)
        images = render(splats, camera, config=config)
    assert images["overflow"] == 0
    assert expected["alpha"].max() > 0.1
    single = 1e-5 if name in VOLUMES else 2e-5
    for output in expected:
        tolerance = single if precision == "float32" else 1e-9
        assert images[output].dtype == precision
        np.testing.assert_allclose(images[output], expected[output], atol=tolerance, rtol=0)


@pytest.mark.parametrize(
    ("name", "precision", "antialias"),
    [
        ("through the camera", "float32", False),
        *((name, "float64", False) for name in ("in front", "through the camera")),
        ("in front", "float64", True),
        ("volumes in front", "float64", False),
        *((f"volumes {name}", "float64", True) for name in ("in front", "through the camera")),
    ],
)
def test_derivatives_agree_with_finite_differences(name, precision, antialias):
    check_derivatives(name, ANTIALIASED if antialias else CONFIG, precision)


def test_float32_keeps_the_digits_of_small_splats():
    """Gradients of splats about a pixel wide are small differences of large sums."""
    scene = random_scene(10, depth=(1.0, 2.0), log_scale=(-3.5, -2.2))
    rng = np.random.default_rng(0)
    cotangents = images_of(lambda shape, _: rng.normal(size=shape))
    found = []
    for precision in ("float32", "float64"):
        with jax.enable_x64(precision == "float64"):
            arguments = (np.zeros(6), INTRINSICS, cotangents)
            arguments = jax.tree.map(lambda a, p=precision: jnp.asarray(a, p), arguments)
            gradient = pullback(to_surfels(scene, precision), *arguments)
            found.append(jax.tree.map(np.asarray, gradient))
    for single, double in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(single, double, atol=1e-4 * np.abs(double).max(), rtol=0)


@pytest.mark.parametrize(
    ("scene", "precision"),
    [
        (random_scene(5, depth=(0.1, 2.0), log_scale=(-4.0, 0.0)), "float32"),
        (random_scene(5, depth=(0.1, 2.0), log_scale=(-4.0, 0.0)), "float64"),
        (SCENES["in front"], "float32"),
        (SCENES["far and small"], "float32"),
    ],
    ids=["cut by the near plane", "cut, float64", "in front", "far and small"],
)
def test_tile_sizes_do_not_change_the_image(scene, precision):
    sizes = (8, 4, 4), (16, 3, 1), (32, 8, 2), (None, None, None)
    with jax.enable_x64(precision == "float64"):
        surfels, camera = to_surfels(scene, precision), to_camera(dtype=precision)
        images = [
            render(surfels, camera, config=RasterizeConfig(1024, NEAR, False, *each, "loops"))
            for each in sizes
        ]
    cut = scene["means"][:, 2].min() < 0.5
    for other, name in itertools.product(images[1:], OUTPUTS):
        # Depth and distortion of cut discs are large, so float32 rounds them more coarsely.
        rtol = 5e-5 if cut and name not in ("alpha", *VECTORS) else 0
        atol, rtol = (1e-12, 0) if precision == "float64" else (1e-6, rtol)
        np.testing.assert_allclose(other[name], images[0][name], atol=atol, rtol=rtol)


def test_sizes_left_open_suit_the_image():
    """A platform that the program names is not asked again."""
    config = RasterizeConfig(capacity=1000, compositor="loops", platform="cpu")
    small = plan_raster(config, height=68, width=120)
    large = plan_raster(config, height=540, width=960)
    assert (small.tile, small.capacity) == (4, 3000) and (large.tile, large.capacity) == (8, 1000)
    assert small.chunk == large.chunk > 0 and small.block == large.block > 0
    asked = dataclasses.replace(config, platform=None)
    assert plan_raster(asked, height=68, width=120) == small
    sizes = {"capacity": 1000, "tile": 16, "chunk": 3, "block": 5}
    for platform in ("cpu", "tpu"):
        plan = plan_raster(RasterizeConfig(**sizes, platform=platform), height=68, width=120)
        assert {name: getattr(plan, name) for name in sizes} == sizes


CUT = random_scene(6, depth=(0.1, 2.0), log_scale=(-4.0, 0.0))


@pytest.mark.parametrize(
    ("scene", "precision", "tolerance"),
    [
        (SCENES["in front"], "float32", 1e-6),
        (SCENES["far and small"], "float32", 1e-6),
        (CUT, "float32", 4e-6),
        (CUT, "float64", 1e-12),
    ],
    ids=["in front", "far and small", "cut by the near plane", "cut, float64"],
)
def test_crops_agree_with_the_image(scene, precision, tolerance):
    """They differ by the rounding of the shifted principal point only."""
    with jax.enable_x64(precision == "float64"):
        surfels = to_surfels(scene, precision)
        whole = render(surfels, to_camera(dtype=precision))
        for top, left in itertools.product((0, 12), (0, 16)):
            shifted = INTRINSICS - np.array([0, 0, left, top])
            crop = render(surfels, to_camera(intrinsics=shifted, size=(12, 16), dtype=precision))
            for name in OUTPUTS:
                expected = whole[name][top : top + 12, left : left + 16]
                np.testing.assert_allclose(crop[name], expected, atol=tolerance, rtol=0)


def test_bits_do_not_depend_on_the_run_or_the_order():
    scene = SCENES["in front"]
    order = np.random.default_rng(0).permutation(COUNT)
    cotangents = images_of(lambda shape, _: np.ones(shape))
    results = []
    for index in (np.arange(COUNT), np.arange(COUNT), order):
        surfels = jax.tree.map(lambda leaf, index=index: leaf[index], to_surfels(scene))
        gradient = pullback(surfels, jnp.zeros(6), jnp.asarray(INTRINSICS, jnp.float32), cotangents)
        unsorted = jax.tree.map(lambda leaf, i=index: np.asarray(leaf)[np.argsort(i)], gradient[0])
        results.append((render(surfels, to_camera()), unsorted))
    for result in results[1:]:
        jax.tree.map(np.testing.assert_array_equal, result, results[0])


def test_a_rigid_motion_of_scene_and_camera_changes_nothing():
    scene = random_scene(7, depth=(0.1, 2.0), log_scale=(-4.0, 0.0))
    scene["sh"][:, 1:] = 0
    motion = pose(np.array([0.4, -0.7, 1.9, 0.3, -0.2, 0.5]))
    turn = motion[:, :3]
    # Quaternion of `turn` from its axis and angle.
    angle = np.arccos((np.trace(turn) - 1) / 2)
    skew = (turn - turn.T) / (2 * np.sin(angle))
    w, v = np.cos(angle / 2), np.sin(angle / 2) * np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    q0, q = scene["quaternions"][:, :1], scene["quaternions"][:, 1:]
    product = np.concatenate([w * q0 - q @ v[:, None], w * q + q0 * v + np.cross(v, q)], axis=1)
    moved = dict(scene, means=scene["means"] @ turn.T + motion[:, 3], quaternions=product)
    still, after = (
        render(to_surfels(scene), to_camera()),
        render(to_surfels(moved), to_camera(motion)),
    )
    np.testing.assert_allclose(after.pop("normal"), still.pop("normal") @ turn.T, atol=1e-4)
    for name in still:
        np.testing.assert_allclose(after[name], still[name], atol=1e-4)


def test_discs_behind_are_invisible_and_both_sides_are_visible():
    scene = random_scene(8)
    turned = dict(scene)
    w, x, y, z = scene["quaternions"].T
    turned["quaternions"] = np.stack([-x, w, z, -y], axis=1)  # half a turn about the first tangent
    front, back = render(to_surfels(scene), to_camera()), render(to_surfels(turned), to_camera())
    for name in OUTPUTS:
        np.testing.assert_allclose(back[name], front[name], atol=2e-6, rtol=1e-5)
    assert front["normal"][front["alpha"] > 0.9].sum(0)[2] < 0
    scene["means"][:, 2] *= -1
    scene["log_scales"][:] = -3
    assert np.all(render(to_surfels(scene), to_camera())["alpha"] == 0)


def test_cameras_can_be_batched():
    twists = jnp.array([[0.0] * 6, [0.05, -0.1, 0.2, 0.1, 0.0, -0.2]])
    surfels, intrinsics = to_surfels(SCENES["in front"]), jnp.asarray(INTRINSICS, jnp.float32)
    rng = np.random.default_rng(0)
    cotangents = images_of(lambda shape, _: rng.normal(size=shape))
    batched = jax.vmap(pullback, in_axes=(None, 0, None, None))
    batched = jax.jit(batched)(surfels, twists, intrinsics, cotangents)
    for i in range(2):
        expected = pullback(surfels, twists[i], intrinsics, cotangents)
        jax.tree.map(
            lambda a, e: np.testing.assert_allclose(a, e, rtol=1e-4, atol=1e-4 * np.abs(e).max()),
            jax.tree.map(lambda leaf, i=i: leaf[i], batched),
            expected,
        )


@pytest.mark.parametrize("num_scales", [2, 3])
def test_extreme_parameters_have_finite_images_and_gradients(num_scales):
    scene = random_scene(9, num_scales=num_scales)
    scene["opacity_logits"][:4] = [100, -100, -30, 30]
    scene["log_scales"][4:8, :2] = [[-18, -18], [-60, 2], [60, 60], [0, -18]]
    scene["quaternions"][8] = 0
    scene["means"][9] = 0  # at the camera's center
    scene["means"][10:12] = scene["means"][12]
    scene["means"][13] = [1e10, 0, 1e10]
    scene["means"][14] = [0, 0, NEAR]
    scene["sh"][15] = 1e6
    surfels, intrinsics = to_surfels(scene), jnp.asarray(INTRINSICS, jnp.float32)
    config = CONFIG if num_scales == 2 else ANTIALIASED
    images = render(surfels, to_camera(), config=config)
    cotangents = {name: jnp.ones_like(images[name]) for name in OUTPUTS if name in images}
    gradient = pullback(surfels, jnp.zeros(6), intrinsics, cotangents, config)
    for leaf in jax.tree.leaves((images, gradient)):
        assert np.all(np.isfinite(leaf))


def test_overflow_is_counted():
    config = dataclasses.replace(CONFIG, capacity=16)
    images = render(to_surfels(SCENES["in front"]), to_camera(), config=config)
    assert images["overflow"] > 0
    assert render(to_surfels(SCENES["in front"]), to_camera())["overflow"] == 0
