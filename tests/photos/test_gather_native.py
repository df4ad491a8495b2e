"""Native gathering: as in JAX, whatever is stored and asked, and on nonsense nothing worse."""

import hashlib
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest

from jaxcloseup.geometry.cameras import pixel_grid
from jaxcloseup.native import library
from jaxcloseup.photos import gather_native
from jaxcloseup.photos.depth_maps import gather_sources
from jaxcloseup.photos.gather import GatherSettings, gather, gather_parts
from jaxcloseup.photos.pyramids import Pyramid


pytestmark = pytest.mark.skipif(not library.available(), reason="there is no native library")
SIZES = ((48, 64), (24, 32), (10, 13))  # the last is not a half
TWO = GatherSettings(), GatherSettings(tolerance=0.02)
FINER = GatherSettings(robust=1.0), GatherSettings(tolerance=0.02, finer=0.8, angle_scale=0.1)


def make_capture(kind=np.int8, channels=6, count=5):
    """Photographs from several heights, one with a nearer box, and random values."""
    rng = np.random.default_rng(0)
    cameras = [
        plane.camera_above(x, 0.1 * x, z, tilt=0.1 * x)
        for x, z in zip(np.linspace(-1, 1, count), rng.uniform(1, 6, count), strict=True)
    ]
    views, depths = plane.make_views(cameras)
    weight = views.weight.at[1, :, :8].set(0)
    sources = gather_sources(views.cameras, depths.at[0, 5:11, 8:16].multiply(0.8), weight)
    shape = count * sum(h * w for h, w in SIZES), channels
    integers = kind != np.float32
    values = rng.integers(*(0, 128) if integers else (0, 2), shape)
    values = values if integers else rng.normal(0, 1, shape)
    scales = jnp.array([2.0, 1.0, 0.4])
    intrinsics = views.cameras.intrinsics[:, None] * scales[None, :, None]
    return sources, Pyramid(
        jnp.asarray(values.astype(kind)), intrinsics, jnp.array([SIZES] * count)
    )


def make_view(height=plane.HEIGHT, width=plane.WIDTH):
    """A view between the photographs, whose depth has a hole: a camera, pixels and depth."""
    camera = plane.camera_above(0.1, 0.0, 1.5, tilt=0.2)
    scale = jnp.array([width / plane.WIDTH, height / plane.HEIGHT] * 2, jnp.float32)
    depth = jnp.asarray(plane.photograph(camera)[1], jnp.float32)
    depth = jax.image.resize(depth, (height, width), "nearest").at[height // 2, : width // 3].set(0)
    camera = camera.replace(intrinsics=scale * camera.intrinsics, height=height, width=width)
    return camera, pixel_grid(height, width), depth


def in_jax(*arguments, **options):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gather_native, "can_gather", lambda *_, **__: False)
        return gather_parts(*arguments, **options)


def assert_close(found, expected):
    for own, other in zip(found, expected, strict=True):
        for name in own._fields:
            pair = getattr(own, name), getattr(other, name)
            np.testing.assert_allclose(*pair, rtol=2e-4, atol=2e-5, err_msg=name)


@pytest.mark.parametrize(
    ("kind", "channels", "settings", "size", "options"),
    [
        (np.int8, 6, TWO, (17, 23), {"exclude": 1}),
        (np.int8, 6, FINER, (17, 23), {}),
        (np.uint8, 4, TWO[:1], (1, 30), {"finest": 1}),
        (np.uint8, 3, FINER[:1], (1, 1), {}),
        (np.float32, 20, TWO, (3, 70), {"finest": 2}),
        (np.float32, 1, FINER[:1], (9, 8), {"exclude": 3}),
    ],
)
def test_native_gathering_is_that_in_jax(kind, channels, settings, size, options):
    capture, view = make_capture(kind, channels), make_view(*size)
    found = gather_parts(*view, *capture, settings, **options)
    assert_close(found, in_jax(*view, *capture, settings, **options))
    assert np.asarray(found[0].weight).max() > 0


def test_negligible_photographs_are_not_missed():
    """Of photographs that weigh from 1 down to e^-20 of it, the sum is that of all."""
    capture, view = make_capture(), make_view()
    narrow = (GatherSettings(angle_scale=0.01), GatherSettings(angle_scale=0.003))
    assert_close(gather_parts(*view, *capture, narrow), in_jax(*view, *capture, narrow))


def test_programs_for_cpus_call_the_library_and_vmap_calls_it_for_each():
    capture, (camera, pixels, depth) = make_capture(), make_view()
    gathered = jax.jit(lambda depth: gather_parts(camera, pixels, depth, *capture, TWO))
    assert "jaxcloseup_gather" in gathered.lower(depth).as_text()
    assert_close(gathered(depth), gather_parts(camera, pixels, depth, *capture, TWO))
    depths = jnp.stack([depth, 1.01 * depth, 0 * depth])
    found = jax.jit(jax.vmap(gathered))(depths)
    for i, depth in enumerate(depths):
        assert_close(jax.tree.map(lambda leaf, i=i: leaf[i], found), gathered(depth))


def test_derivatives_are_those_in_jax():
    """`test_gather` compares them with differences."""
    (sources, pyramid), (camera, pixels, depth) = make_capture(np.float32, 3), make_view()

    def total(scale, values):
        changed = pyramid.replace(values=values)
        (found,) = gather_parts(camera, pixels, scale * depth, sources, changed, TWO[:1])
        return jnp.sum(found.mean**2)

    calls = {
        derivative: "jaxcloseup_gather"
        in jax.jit(derivative(total)).lower(jnp.float32(1), pyramid.values).as_text()
        for derivative in (lambda function: function, jax.grad, jax.jacfwd)
    }
    assert [*calls.values()] == [True, False, False]


@pytest.mark.parametrize("nonsense", [np.nan, np.inf, -np.inf, 0.0, -1.0, 1e38, 1e-38])
def test_nonsense_gathers_nothing_and_reads_nothing_elsewhere(nonsense):
    """Pixels beside it are as if it were not there."""
    capture, (camera, pixels, depth) = make_capture(), make_view()
    plain = gather_parts(camera, pixels, depth, *capture, TWO)
    wrong = jnp.zeros(depth.shape, bool).at[::3, ::5].set(True)
    found = gather_parts(camera, pixels, jnp.where(wrong, nonsense, depth), *capture, TWO)
    for part, other in zip(found, plain, strict=True):
        assert not np.asarray(part.weight)[wrong].any()
        for own, whole in zip(part, other, strict=True):
            np.testing.assert_allclose(own[~wrong], whole[~wrong], rtol=1e-6, atol=1e-6)
    gather_parts(camera, jnp.where(wrong[..., None], nonsense, pixels), depth, *capture, TWO)
    for name in ("camtoworld", "intrinsics"):
        odd = jnp.full_like(getattr(camera, name), nonsense)
        jax.block_until_ready(
            gather_parts(camera.replace(**{name: odd}), pixels, depth, *capture, TWO)
        )


def nonsense_in_photographs(value):
    sources, pyramid = make_capture(np.float32)
    for which in range(2):  # inverse depth and trust
        yield sources.replace(maps=sources.maps.at[:, ::2, ::3, which].set(value)), pyramid
    for name in ("camtoworld", "intrinsics"):
        odd = sources.cameras.replace(**{name: getattr(sources.cameras, name).at[::2].set(value)})
        yield sources.replace(cameras=odd), pyramid
    for name in ("values", "intrinsics"):
        yield sources, pyramid.replace(**{name: getattr(pyramid, name).at[::2, ::2].set(value)})


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, 1e38])
def test_nonsense_in_photographs_does_no_harm(value):
    for capture in nonsense_in_photographs(value):
        for options in ({}, {"finest": 99, "exclude": 99}, {"finest": -5, "exclude": -7}):
            jax.block_until_ready(gather_parts(*make_view(), *capture, FINER, **options))


def test_a_camera_behind_all_surfaces_and_an_image_without_pixels():
    capture, (camera, pixels, depth) = make_capture(), make_view()
    turned = camera.replace(camtoworld=camera.camtoworld.at[:, 1:3].multiply(-1))
    for part in gather_parts(turned, pixels, depth, *capture, TWO):
        assert not np.asarray(part.weight).any() and np.isinf(np.asarray(part.footprint)).all()
    found = gather(camera, pixels[:0], depth[:0], *capture)
    assert found.mean.shape == (0, plane.WIDTH, 6) and found.weight.shape == (0, plane.WIDTH)


def test_what_the_library_does_not_take_is_gathered_in_jax(monkeypatch):
    capture, view = make_capture(), make_view()
    sources, pyramid = capture
    assert gather_native.can_gather(*view, *capture, parts=2)
    halves = pyramid.replace(values=pyramid.values.astype(jnp.float16))
    assert not gather_native.can_gather(*view, sources, halves, parts=2)
    assert not gather_native.can_gather(*view, *capture, parts=5)
    expected = gather_parts(*view, *capture, TWO)
    monkeypatch.setattr(library, "available", lambda: False)
    assert not gather_native.can_gather(*view, *capture, parts=2)
    assert_close(gather_parts(*view, *capture, TWO), expected)


def digest():
    """Return a hash of what is gathered in an image of many blocks."""
    capture, view = make_capture(), make_view(150, 200)
    hashed = hashlib.sha256()
    for leaf in jax.tree.leaves(gather_parts(*view, *capture, FINER)):
        hashed.update(np.asarray(leaf).tobytes())
    return hashed.hexdigest()


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be chosen")
def test_results_do_not_depend_on_the_number_of_threads():
    here = os.path.dirname(__file__)
    paths = os.pathsep.join([os.getcwd(), here, os.path.dirname(here)])
    core = min(os.sched_getaffinity(0))
    code = f"import os; os.sched_setaffinity(0, {{{core}}}); import test_gather_native as tests; "
    alone = subprocess.run(
        [sys.executable, "-c", code + "print(tests.digest())"],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=True,
    )
    assert alone.stdout.strip() == digest() == digest()
