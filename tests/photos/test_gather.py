"""Gathering on the plane z = 0: against a slow float64 oracle, and against area-filtered truth."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
import reference

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points
from jaxcloseup.photos import gather_native
from jaxcloseup.photos.depth_maps import gather_sources
from jaxcloseup.photos.gather import GatherSettings, gather, gather_parts
from jaxcloseup.photos.pyramids import Pyramid, photograph_pyramid
from jaxcloseup.photos.views import camera_at


SIZES = ((48, 64), (24, 32), (10, 13))  # the last is not a half
GRID = pixel_grid(plane.HEIGHT, plane.WIDTH)
SETTINGS = GatherSettings(robust=1.0)
# Compiled once: three photographs, three levels, one view.
gathered = jax.jit(functools.partial(gather, settings=SETTINGS))


@jax.jit
def gathered_in_jax(*arguments, **options):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gather_native, "can_gather", lambda *_, **__: False)
        return gather(*arguments, settings=SETTINGS, **options)


def with_edge(depths):
    """The depth maps with a nearer box in the first one, which has edges."""
    return depths.at[0, 5:11, 8:16].multiply(0.8)


@pytest.fixture(scope="module")
def capture():
    """Photographs from three heights with their depths, one with a box, and random values."""
    cameras = [
        plane.camera_above(x, 0.1 * x, z, tilt=0.1 * x) for x, z in ((-1, 4), (0.2, 3), (1, 6))
    ]
    views, depths = plane.make_views(cameras)
    weight = views.weight.at[1, :, :8].set(0)
    sources = gather_sources(views.cameras, with_edge(depths), weight)
    rng = np.random.default_rng(0)
    values = rng.integers(-127, 128, (3 * sum(h * w for h, w in SIZES), 3)).astype(np.int8)
    scales = jnp.array([2.0, 1.0, 0.4])
    intrinsics = views.cameras.intrinsics[:, None] * scales[None, :, None]
    return sources, Pyramid(jnp.asarray(values), intrinsics, jnp.array([SIZES] * 3))


@pytest.fixture(scope="module")
def closeup():
    """A view between the photographs, with a hole in its depth."""
    camera = plane.camera_above(0.1, 0.0, 1.5, tilt=0.2)
    depth = plane.photograph(camera)[1]
    depth[3:5, 6:9] = 0
    return camera, jnp.asarray(depth, jnp.float32)


@pytest.mark.parametrize("gathered", [gathered, gathered_in_jax], ids=["fastest", "in_jax"])
@pytest.mark.parametrize(("exclude", "finest"), [(-1, 0), (1, 0), (-1, 1)])
def test_gather_against_an_oracle(capture, closeup, gathered, exclude, finest):
    sources, pyramid = capture
    camera, depth = closeup
    found = gathered(camera, GRID, depth, sources, pyramid, exclude=exclude, finest=finest)
    points = np.asarray(pixels_to_points(camera, GRID, depth), np.float64)
    side = np.asarray(depth, np.float64) / plane.FOCAL
    position = np.asarray(camera.position, np.float64)
    maps = [np.asarray(a, np.float64) for a in (sources.inverse_depth, sources.trust)]
    for row, column in list(np.ndindex(*depth.shape))[::5]:
        views = []
        for v in range(3):
            if v != exclude:
                source = camera_at(sources.cameras, v)
                seen = reference.gather_view(
                    points[row, column],
                    side[row, column],
                    position,
                    *(np.asarray(a, np.float64) for a in (source.camtoworld, source.intrinsics)),
                    *(a[v] for a in maps),
                    [np.asarray(pyramid.image(v, i), np.float64) / 127 for i in range(3)],
                    np.asarray(pyramid.intrinsics[v], np.float64),
                    SETTINGS,
                    finest,
                )
                if seen is not None:
                    views.append(seen)
        expected = reference.gather_mean(views, SETTINGS)
        for name, value in expected.items():
            actual = np.asarray(getattr(found, name)[row, column])
            np.testing.assert_allclose(actual, value, rtol=2e-3, atol=2e-4, err_msg=name)


def test_parts_are_gathered_as_if_alone(capture, closeup):
    """Each by its own settings; a part that is read finer has other values."""
    sources, pyramid = capture
    camera, depth = closeup
    strict = GatherSettings(tolerance=0.02, finer=0.8)
    twice = pyramid.replace(values=jnp.concatenate([pyramid.values, pyramid.values[..., ::-1]], -1))
    parts = jax.jit(functools.partial(gather_parts, settings=(SETTINGS, strict)))
    first, second = parts(camera, GRID, depth, sources, twice, exclude=1)
    alone = gathered(camera, GRID, depth, sources, pyramid, exclude=1, finest=0)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), first, alone)
    alone = jax.jit(functools.partial(gather, settings=strict))(
        camera, GRID, depth, sources, pyramid, exclude=1
    )
    alone = alone._replace(mean=alone.mean[..., ::-1])
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), second, alone)
    assert np.abs(np.asarray(first.weight - second.weight)).max() > 0.002
    with pytest.raises(ValueError, match="6 channels are not 4 parts of one size"):
        gather_parts(camera, GRID, depth, sources, twice, (strict,) * 4)


def test_a_view_of_several_blocks_is_gathered_as_if_its_parts_were_alone(capture, closeup):
    camera, depth = closeup
    copies = 2**15 // depth.size + 1
    pixels, depths = jnp.tile(GRID, (copies, 1, 1)), jnp.tile(depth, (copies, 1))
    found = gather(camera, pixels, depths, *capture, SETTINGS)
    alone = gathered(camera, GRID, depth, *capture)
    for own, other in zip(found, alone, strict=True):
        own = np.asarray(own).reshape(copies, *other.shape)
        np.testing.assert_allclose(own, np.broadcast_to(other, own.shape), rtol=1e-5, atol=1e-5)


def test_undefined_depth_gathers_nothing(capture, closeup):
    camera, depth = closeup
    found = gathered(camera, GRID, depth, *capture, exclude=-1, finest=0)
    assert np.asarray(found.weight)[4, 7] == 0
    assert np.asarray(found.count)[4, 7] == 0
    assert not np.asarray(found.mean)[4, 7].any()
    assert np.isinf(np.asarray(found.footprint)[4, 7])
    assert np.asarray(found.weight).max() > 0


def test_a_view_that_looks_elsewhere_gathers_nothing(capture, closeup):
    camera, depth = closeup
    away = camera.replace(camtoworld=camera.camtoworld.at[:, 3].add(jnp.array([50.0, 0, 0])))
    found = gathered(away, GRID, depth, *capture, exclude=-1, finest=0)
    assert not np.asarray(found.weight).any()


def test_edges_of_depth_maps_are_not_trusted_and_slanted_planes_are():
    cameras = [plane.camera_above(0.0, 0.0, 3.0, tilt=0.5)]
    views, depths = plane.make_views(cameras)
    flat = gather_sources(views.cameras, depths, views.weight).trust
    np.testing.assert_allclose(flat, 1, atol=1e-3)
    edged = np.asarray(
        gather_sources(views.cameras, with_edge(depths), views.weight, edge=0.05).trust
    )
    inside = np.zeros(edged.shape[1:], bool)
    inside[5:11, 8:16] = True
    ring = np.zeros_like(inside)
    ring[4:12, 7:17] = True
    ring[6:10, 9:15] = False
    assert edged[0][ring].max() < 0.05
    far = np.ones_like(inside)
    far[3:13, 6:18] = False
    np.testing.assert_allclose(edged[0][far], 1, atol=1e-3)


def filtered(camera, scale=1, samples=6):
    """The plane's texture averaged over each pixel of a camera, `scale` times finer."""
    fx, fy, cx, cy = np.asarray(camera.intrinsics, np.float64) * scale
    pose = np.asarray(camera.camtoworld, np.float64)
    offsets = (np.arange(samples) + 0.5) / samples
    total = 0
    for dx in offsets:
        for dy in offsets:
            x, y = np.meshgrid(
                np.arange(scale * plane.WIDTH) + dx, np.arange(scale * plane.HEIGHT) + dy
            )
            rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1) @ pose[:, :3].T
            depth = -pose[2, 3] / rays[..., 2]
            total = total + plane.texture(pose[:, 3] + depth[..., None] * rays)
    return total / samples**2


def test_gathered_colors_are_the_area_filtered_truth():
    cameras = [plane.camera_above(x, 0.0, z) for x, z in ((-0.3, 4.0), (0.0, 3.0), (0.4, 5.0))]
    views, depths = plane.make_views(cameras)
    sources = gather_sources(views.cameras, depths, views.weight)
    scales = (2, 1)
    images = [filtered(camera, scale) for camera in cameras for scale in scales]
    values = jnp.asarray(np.concatenate([image.reshape(-1, 3) for image in images]), jnp.float32)
    intrinsics = views.cameras.intrinsics[:, None] * jnp.array(scales, jnp.float32)[None, :, None]
    sizes = [(scale * plane.HEIGHT, scale * plane.WIDTH) for scale in scales]
    pyramid = Pyramid(values, intrinsics, jnp.array([sizes] * 3))
    camera = plane.camera_above(0.0, 0.0, 2.5)
    depth = jnp.asarray(plane.photograph(camera)[1], jnp.float32)
    found = jax.jit(gather)(camera, GRID, depth, sources, pyramid)
    error = np.asarray(found.mean) - filtered(camera)
    inner = np.s_[3:-3, 3:-3]
    assert np.sqrt(np.mean(error[inner] ** 2)) < 0.003
    assert np.asarray(found.variance)[inner].max() < 1e-3


def test_gradients_follow_values_and_stay_finite(capture, closeup):
    sources, pyramid = capture
    camera, depth = closeup
    floats = pyramid.replace(values=pyramid.values.astype(jnp.float32) / 127)

    def total(values, scale):
        found = gather(
            camera, GRID, scale * depth, sources, floats.replace(values=values), SETTINGS
        )
        return jnp.sum(found.mean**2)

    both = jax.jit(jax.value_and_grad(total, (0, 1)))
    _, (by_value, by_scale) = both(floats.values, jnp.float32(1))
    assert np.isfinite(np.asarray(by_value)).all()
    assert np.isfinite(float(by_scale))
    step = 0.01 * jax.random.normal(jax.random.key(0), floats.values.shape)
    ahead, behind = (both(floats.values + sign * step, jnp.float32(1))[0] for sign in (1, -1))
    np.testing.assert_allclose(jnp.sum(by_value * step), (ahead - behind) / 2, rtol=2e-2)


def test_a_pyramid_halves_by_weight_and_ends_with_what_training_reads():
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, (2, 9, 13, 3)).astype(np.uint8)
    weight = rng.integers(0, 2, (2, 9, 13)).astype(np.float32)
    cameras = Camera(jnp.zeros((2, 3, 4)), jnp.tile(jnp.array([8.0, 8, 6.5, 4.5]), (2, 1)), 9, 13)
    views = plane.Views(cameras, jnp.asarray(rgb), jnp.asarray(weight))
    coarse = rng.integers(0, 256, (2, 3, 4, 3)).astype(np.uint8)
    own = jnp.tile(jnp.array([2.5, 2.5, 2, 1.5]), (2, 1))
    training = plane.Views(
        Camera(jnp.zeros((2, 3, 4)), own, 3, 4), jnp.asarray(coarse), jnp.ones((2, 3, 4))
    )
    assert photograph_pyramid(views).sizes == ((9, 13),)
    pyramid = photograph_pyramid(views, training)
    assert pyramid.sizes == ((9, 13), (4, 6), (3, 4))
    levels = [np.stack([pyramid.image(view, i) for view in range(2)]) for i in range(3)]
    np.testing.assert_array_equal(levels[2][..., :3], coarse)
    np.testing.assert_array_equal(pyramid.intrinsics[:, 2], own)
    np.testing.assert_allclose(pyramid.coarseness(1), np.log2([1, 2, 8 / 2.5]), rtol=1e-6)
    np.testing.assert_allclose(pyramid.intrinsics[0, 1], [4, 4, 3.25, 2.25])
    fine, half = levels[0].astype(np.float64), levels[1]
    np.testing.assert_array_equal(fine[..., :3], rgb * (weight[..., None] > 0))
    for v, y, x in np.ndindex(2, 4, 6):
        block = np.s_[v, 2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
        shares = weight[block]
        assert abs(half[v, y, x, 3] - 255 * shares.mean()) <= 0.5
        if shares.any():
            mean = np.average(rgb[block].reshape(4, 3), axis=0, weights=shares.ravel())
            assert np.abs(half[v, y, x, :3] - mean).max() <= 0.51
