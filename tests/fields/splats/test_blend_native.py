"""The native compositor: against the NumPy splatter, against loops, and on nonsense."""

import dataclasses
import functools
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import splat_tables
from splat_derivatives import check_derivatives
from splat_scenes import (
    CONFIG,
    CROWDS,
    HEIGHT,
    NATIVE,
    NEAR,
    SPLATS,
    VOLUMES,
    WIDTH,
    drawn,
    footprints_of,
    oracle,
    random_scene,
    render,
    to_camera,
    to_surfels,
)
from splat_tables import random_table

from jaxcloseup.fields.splats import blend_native
from jaxcloseup.fields.splats.config import RasterPlan
from jaxcloseup.fields.splats.layout import (
    ANCHOR,
    HOMOGRAPHY,
    INVERSE_DEPTH,
    LOW_PASS,
    OPACITY,
    PAYLOAD,
    pack,
)
from jaxcloseup.fields.splats.rasterize import blend
from jaxcloseup.fields.splats.tile_test import reaches
from jaxcloseup.fields.splats.tiling import tile_lists
from jaxcloseup.native import library


pytestmark = pytest.mark.skipif(
    not library.available(), reason=f"no native library: {library.missing()}"
)
PLAN = RasterPlan(capacity=1, near=NEAR, tile=blend_native.TILE)
TESTS = pathlib.Path(splat_tables.__file__).parent


@pytest.mark.parametrize(
    ("name", "antialias"),
    [
        *((name, False) for name in SPLATS),
        *((name, True) for name in ("in front", "far and small", *VOLUMES)),
    ],
)
def test_images_agree_with_the_oracle(name, antialias):
    expected = oracle(SPLATS[name], antialias=antialias)
    config = dataclasses.replace(NATIVE, antialias=antialias)
    images = render(to_surfels(SPLATS[name]), to_camera(), config=config)
    tolerance = 1e-5 if name in VOLUMES else 2e-5
    for output in expected:
        np.testing.assert_allclose(images[output], expected[output], atol=tolerance, rtol=0)


@pytest.mark.parametrize("name", ["in front", "through the camera", "volumes in front"])
def test_derivatives_agree_with_finite_differences(name):
    check_derivatives(name, NATIVE, "float32")


@functools.partial(jax.jit, static_argnames=("height", "width", "compositor"))
def blend_both(table, box, order, bars, *, height, width, compositor):
    """Blend a table; return the images, and the table's derivative of their sum times `bars`."""
    config = dataclasses.replace(CONFIG, capacity=2**13, compositor=compositor)

    def images(table):
        found = blend(table, box, order, config, height=height, width=width)
        return {name: getattr(found, name) for name in bars}

    found, pull = jax.vjp(images, table)
    return found, pull(bars)[0]


def cotangents(height, width, features, seed=0):
    rng = np.random.default_rng(seed)
    names = ("alpha", "depth", "median_depth", "distortion")
    bars = {name: rng.normal(size=(height, width)) for name in names}
    bars["payload"] = rng.normal(size=(height, width, features))
    return {name: jnp.asarray(bar, jnp.float32) for name, bar in bars.items()}


def table_of(name, antialias=False):
    """The table, boxes and orders of a scene of discs, with a drawn payload."""
    footprints = footprints_of(to_surfels(CROWDS[name]), to_camera(), antialias)
    payload = np.random.default_rng(1).normal(size=(6, len(footprints.opacity)))
    footprints = footprints.replace(payload=jnp.asarray(payload, jnp.float32))
    return pack(footprints), footprints.box.T, footprints.order


def compare(found, expected, bound=1e-5):
    """Check the mean difference of arrays, relative to their mean size."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert np.abs(b).mean() > 0 and np.abs(a - b).mean() <= bound * np.abs(b).mean()


@pytest.mark.parametrize("antialias", [False, True], ids=["low-pass", "antialiased"])
@pytest.mark.parametrize("name", ["long", "faint"])
def test_discs_are_blended_as_by_loops(name, antialias):
    size = {"height": HEIGHT, "width": WIDTH}
    arguments = (*table_of(name, antialias), cotangents(HEIGHT, WIDTH, 6))
    found, expected = (
        blend_both(*arguments, **size, compositor=compositor) for compositor in ("native", "loops")
    )
    compare(found, expected)


@pytest.mark.parametrize(
    ("height", "width", "features"), [(23, 37, 6), (2, 3, 6), (24, 32, 3), (5, 64, 17)]
)
def test_tables_are_blended_as_by_loops(height, width, features):
    """Images of odd sizes, one smaller than a tile, and payloads of several sizes."""
    arguments = *random_table(0, 40, height, width, features), cotangents(height, width, features)
    found, expected = (
        blend_both(*arguments, height=height, width=width, compositor=compositor)
        for compositor in ("native", "loops")
    )
    compare(found, expected)


@pytest.mark.parametrize("features", [1, 3, 6, 54])
def test_values_of_a_payload_do_not_depend_on_the_others(features):
    """The functions for payloads of 3 and 6 values compute what that for any does."""
    height, width, most = 9, 14, 54
    table, box, order = random_table(0, 60, height, width, most)
    bars = cotangents(height, width, most)
    bars["payload"] = bars["payload"].at[..., features:].set(0)
    size = {"height": height, "width": width, "compositor": "native"}
    expected, expected_bar = blend_both(table, box, order, bars, **size)
    columns, bars["payload"] = PAYLOAD + features, bars["payload"][..., :features]
    found, bar = blend_both(table[:, :columns], box, order, bars, **size)
    expected["payload"] = expected["payload"][..., :features]
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    np.testing.assert_allclose(bar, expected_bar[:, :columns], rtol=1e-5, atol=1e-6)


def test_where_nothing_shows_images_and_derivatives_are_0():
    height, width = 9, 14
    bars = cotangents(height, width, 6)
    table, box, order = random_table(0, 60, height, width)
    empty = np.broadcast_to(np.float32([0, 0, -1, -1]), box.shape)
    for arrays in ((table[:0], box[:0], order[:0]), (table, empty, order)):
        result = blend_both(*arrays, bars, height=height, width=width, compositor="native")
        for leaf in jax.tree.leaves(result):
            assert not np.any(leaf)
    scene = random_scene(8)
    scene["means"][:, 2] *= -1
    scene["log_scales"][:] = -3
    assert not np.any(render(to_surfels(scene), to_camera(), config=NATIVE)["alpha"])


def random_bars(seed):
    rng = np.random.default_rng(seed)
    return tuple(rng.normal(size=shape).astype(np.float32) for shape in ((10, 9, 14), (9, 14)))


@jax.jit
def native_both(table, box, order, bars):
    """Blend an image of 9 x 14 pixels; return its sums, and the table's derivative."""
    images, pull = jax.vjp(
        lambda table: blend_native.blend_image(PLAN, 9, 14, table, box, order), table
    )
    return images, pull(bars)[0]


def test_a_batch_of_images_is_each_image():
    """Of tables that differ and of tables that are the same."""
    tables = [random_table(seed, 60, 9, 14) for seed in range(4)]
    bars = [random_bars(seed) for seed in range(4)]
    many_tables, many_bars = (jax.tree.map(lambda *a: np.stack(a), *a) for a in (tables, bars))
    found = jax.vmap(native_both)(*many_tables, many_bars)
    same = jax.vmap(native_both, in_axes=(None, None, None, 0))(*tables[0], many_bars)
    for i in range(4):
        for table, batch in ((tables[i], found), (tables[0], same)):
            result = jax.tree.map(lambda leaf, i=i: leaf[i], batch)
            jax.tree.map(np.testing.assert_array_equal, result, native_both(*table, bars[i]))


def test_steps_in_a_loop_are_steps_one_by_one():
    table, box, order = random_table(0, 60, 9, 14)

    def step(table):
        return table - 1e-3 * native_both(table, box, order, random_bars(0))[1]

    found = jax.jit(lambda table: jax.lax.fori_loop(0, 3, lambda _, t: step(t), table))(table)
    expected = functools.reduce(lambda t, _: step(t), range(3), jnp.asarray(table))
    assert np.abs(expected - table).max() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_other_tables_are_blended_by_loops():
    height, width = 5, 7
    table, box, order = random_table(0, 20, height, width)
    assert blend_native.can_blend(jnp.zeros((1, PAYLOAD + blend_native.MOST_FEATURES)))
    assert not blend_native.can_blend(jnp.zeros((1, PAYLOAD + blend_native.MOST_FEATURES + 1)))
    with jax.enable_x64(True):
        arrays = [jnp.asarray(a, jnp.float64) for a in (table, box, order)]
        images = [
            jax.jit(functools.partial(blend, config=config, height=height, width=width))(*arrays)
            for config in (NATIVE, CONFIG)
        ]
        assert images[0].payload.dtype == jnp.float64
    jax.tree.map(np.testing.assert_array_equal, *images)


def test_bits_do_not_depend_on_the_run_or_the_number_of_threads():
    expected = splat_tables.digest()
    assert splat_tables.digest() == expected
    cores = sorted(os.sched_getaffinity(0))
    code = "import os, sys; os.sched_setaffinity(0, {int(sys.argv[1])}); import splat_tables; "
    code += "print(splat_tables.digest())"
    command = [sys.executable, "-c", code, str(cores[-1])]
    paths = [str(TESTS), str(pathlib.Path(blend_native.__file__).parents[3])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "JAX_PLATFORMS": "cpu"}
    environment.pop("XLA_FLAGS", None)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == expected


@functools.partial(jax.jit, static_argnames=("height", "width"))
def listed(table, box, order, *, height=HEIGHT, width=WIDTH):
    """Which tiles list each splat, `[N, rows, columns]`: lists of images of one splat."""
    each = (a[:, None] for a in (table, box, order))
    count = functools.partial(blend_native.count_pairs, PLAN, height, width)
    return jax.vmap(count)(*each)


@functools.partial(jax.jit, static_argnames=("height", "width"))
def listed_by_loops(table, box, order, *, height=HEIGHT, width=WIDTH):
    size = {"height": height, "width": width, "tile": PLAN.tile}
    test = functools.partial(reaches, table, tile=PLAN.tile, near=NEAR)
    return tile_lists(box, order, **size, capacity=2**14, reaches=test).counts


@pytest.mark.parametrize("antialias", [False, True], ids=["low-pass", "antialiased"])
@pytest.mark.parametrize("name", CROWDS)
def test_a_tile_lists_what_draws_in_it_and_little_else(name, antialias):
    table, box, order = table_of(name, antialias)
    found = np.asarray(listed(table, box, order))
    assert found.max() == 1
    rows, columns = HEIGHT // PLAN.tile, WIDTH // PLAN.tile
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    at_pixels = drawn(CROWDS[name], np.stack([x, y], axis=-1), antialias)
    in_tiles = at_pixels.reshape(-1, rows, PLAN.tile, columns, PLAN.tile).any(axis=(2, 4))
    assert in_tiles.any() and not np.any(in_tiles & (found == 0))
    counts = blend_native.count_pairs(PLAN, HEIGHT, WIDTH, table, box, order)
    np.testing.assert_array_equal(counts, found.sum(0))
    assert int(counts.sum()) <= 1.02 * int(listed_by_loops(table, box, order).sum())


def test_boxes_do_not_matter_where_they_hold_what_draws():
    """A table's own shapes are what is listed; an image of many bands of rows."""
    height, width = 130, 50
    table, box, order = random_table(0, 300, height, width)
    bars = cotangents(height, width, 6)
    huge = np.broadcast_to(np.float32([-np.inf, -1e30, 1e30, np.inf]), box.shape)
    size = {"height": height, "width": width}
    found, expected = (
        blend_both(table, b, order, bars, **size, compositor="native") for b in (huge, box)
    )
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    counts = [listed(table, b, order, **size).sum() for b in (huge, box)]
    assert counts[0] == counts[1] > 0


def blend_with(bad, boxes, orders):
    """Blend 60 splats and bad ones; also without these, that is with their boxes empty."""
    table, box, order = random_table(0, 60, HEIGHT, WIDTH)
    bars, size = cotangents(HEIGHT, WIDTH, 6), {"height": HEIGHT, "width": WIDTH}
    empty = np.broadcast_to([0, 0, -1, -1], boxes.shape)
    for table_of_bad, boxes_of_bad in ((bad, boxes), (np.zeros_like(bad), empty)):
        arrays = (table, table_of_bad), (box, boxes_of_bad), (order, orders)
        arrays = (np.concatenate(pair).astype(np.float32) for pair in arrays)
        images, bar = blend_both(*arrays, bars, **size, compositor="native")
        yield images, bar[: len(table)], box


# Columns without which there is no alpha; without u and v there still is the low-pass.
SHAPES = [ANCHOR, ANCHOR + 1, *range(HOMOGRAPHY + 6, LOW_PASS + 1)]
LEFT = 12  # pixels, the end of a tile


def splats_at_left(count):
    bad = np.repeat(random_table(0, 1, HEIGHT, WIDTH)[0], count, axis=0)
    bad[:, ANCHOR:HOMOGRAPHY], bad[:, OPACITY] = (LEFT / 2, HEIGHT / 2), 0.7
    return bad, np.repeat([[0, 0, LEFT - 0.1, HEIGHT]], count, axis=0), np.full(count, 1.5)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38, -1.0, 0.0, 1e-40])
def test_nonsense_in_a_table_stays_in_its_box(value):
    """Every column alone, and some together."""
    columns = [[column] for column in range(PAYLOAD + 6)]
    columns += [list(range(PAYLOAD)), [HOMOGRAPHY, LOW_PASS], [OPACITY, INVERSE_DEPTH]]
    bad, boxes, orders = splats_at_left(len(columns))
    for row, where in zip(bad, columns, strict=True):
        row[where] = value
    (found, bar, box), (expected, expected_bar, _) = blend_with(bad, boxes, orders)
    for name, image in found.items():
        np.testing.assert_array_equal(image[:, LEFT:], expected[name][:, LEFT:])
    away = np.flatnonzero(box[:, 0] > LEFT)
    assert len(away) > 10
    np.testing.assert_array_equal(bar[away], expected_bar[away])
    assert np.any(found["alpha"][:, :LEFT] != expected["alpha"][:, :LEFT])


def test_splats_without_a_number_are_not_drawn():
    """NaN in a splat's shape or box, and boxes without pixels."""
    count = len(SHAPES)
    bad, boxes, orders = splats_at_left(count + 6)
    bad[np.arange(count), SHAPES] = np.nan
    boxes[count + np.arange(4), np.arange(4)] = np.nan
    boxes[-2:] = [[5, 5, 4, 9], [np.inf, -np.inf, -np.inf, np.inf]]
    orders[::2] = np.nan
    found, expected = blend_with(bad, boxes, orders)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_depths_of_0_tie_whatever_their_sign():
    table, box, _ = random_table(0, 60, HEIGHT, WIDTH)
    order = np.where(np.arange(60) % 3 == 0, -0.0, 0.0).astype(np.float32)
    bars = cotangents(HEIGHT, WIDTH, 6)
    size = {"height": HEIGHT, "width": WIDTH, "compositor": "native"}
    found, expected = (blend_both(table, box, o, bars, **size) for o in (order, 0 * order**2))
    jax.tree.map(np.testing.assert_array_equal, found, expected)
