"""Depth supervision: the divergence against quadrature, and what photographs show of points."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest

from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.shared.sightings import find_sightings
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.fields.volume.depth_supervision import (
    PixelSupervision,
    PointSupervision,
    Sightings,
    depth_divergence,
)
from jaxcloseup.fields.volume.rays import Extent, Traced, VolumeAux, ray_field
from jaxcloseup.photos.scene import Scene, SceneError


divergence = jax.jit(depth_divergence)


def by_quadrature(edges, weights, mean, deviation):
    """The integral of N log(N / h) over the intervals, and of N log N beyond them, by Gauss."""
    nodes, shares = np.polynomial.legendre.leggauss(16)
    # The density h jumps at the edges alone, so no piece has an edge within.
    ends = np.union1d(edges, mean + deviation * np.linspace(-9, 9, 73))
    half = np.diff(ends)[:, None] / 2
    z = (ends[:-1] + ends[1:])[:, None] / 2 + half * nodes[None]
    bins = np.searchsorted(edges, z, side="right") - 1
    inside = (bins >= 0) & (bins < len(weights))
    light = ((weights + 1e-5) / np.diff(edges))[np.clip(bins, 0, len(weights) - 1)]
    log_normal = -0.5 * ((z - mean) / deviation) ** 2 - np.log(deviation * np.sqrt(2 * np.pi))
    integrand = np.exp(log_normal) * (log_normal - np.where(inside, np.log(light), 0))
    return np.sum(half * shares[None] * integrand)


@pytest.mark.parametrize(("mean", "deviation"), [(2.0, 0.3), (2.0, 0.01), (1.05, 0.2)])
def test_the_divergence_matches_quadrature(mean, deviation):
    numbers = np.random.default_rng(0)
    edges = np.sort(numbers.uniform(1, 3, 12))
    weights = numbers.dirichlet(np.ones(11))
    expected = by_quadrature(edges, weights, mean, deviation)
    ours = divergence(*map(np.float32, (edges, weights, mean, deviation)))
    np.testing.assert_allclose(ours, expected, rtol=2e-4, atol=1e-4)
    with jax.enable_x64(True):
        ours = divergence(*map(np.float64, (edges, weights, mean, deviation)))
    np.testing.assert_allclose(ours, expected, rtol=1e-9)


def test_light_that_is_distributed_like_the_depth_diverges_least():
    edges = np.linspace(1, 3, 401)
    z = (edges[1:] + edges[:-1]) / 2
    normal = [np.exp(-0.5 * ((z - mean) / 0.2) ** 2) for mean in (2.0, 2.1)]
    found = [float(divergence(*map(np.float32, (edges, w / w.sum(), 2.0, 0.2)))) for w in normal]
    assert abs(found[0]) < 0.01
    assert found[1] == pytest.approx(0.1**2 / (2 * 0.2**2), rel=0.1)  # that of two normal ones


def test_the_divergences_gradient_is_the_finite_difference():
    numbers = np.random.default_rng(1)
    with jax.enable_x64(True):
        edges = np.sort(numbers.uniform(1, 3, 9))
        weights, along = numbers.dirichlet(np.ones(8)), numbers.normal(size=8)
        normal = np.array(2.1), np.array(0.3)
        of_step = jax.jit(lambda h: depth_divergence(edges, weights + h * along, *normal))
        slope = jax.jit(jax.grad(of_step))(0.0)
        np.testing.assert_allclose(slope, (of_step(1e-7) - of_step(-1e-7)) / 2e-7, rtol=1e-5)


EDGES = jnp.array([1.0, 2.0, 3.0])


def trace(params, buffers, key, rays):
    """See the same light, `params` in two intervals, along every ray."""
    each = jnp.ones(rays.length.shape)
    rendering = Rendering(each[:, None] * jnp.ones((1, 3)), each, each, VolumeAux(None, each, each))
    light = [each[:, None] * values for values in (EDGES[None], params[None])]
    return Traced(rendering, [tuple(light)])


def test_a_field_adds_the_loss_of_rays_through_points_to_steps_alone():
    """Every ray sees the same light, so the mean over points drawn is known."""
    cameras = [plane.camera_above(x, 0.0, 4.0) for x in (-0.5, 0.5)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    points = Sightings(
        stacked, np.array([0, 1, 1]), np.ones((3, 2), "f4"), *np.float32([[2.2] * 3, [0.1] * 3])
    )
    fields = [
        ray_field(Extent(1.0, 3.0), init=None, trace=trace, chunk=4, supervision=supervision)
        for supervision in (None, PointSupervision(points, 0.3, 0.5))
    ]
    params, pixels = jnp.array([0.25, 0.75]), jnp.ones((6, 2))
    target, weight = jnp.ones((6, 3)), jnp.ones(6)

    @jax.jit
    def losses(key):
        without, supervised = (f.render(params, (), cameras[0], pixels, key) for f in fields)
        silent = fields[1].render(params, (), cameras[0], pixels, None)
        assert without.aux.penalty is None and silent.aux.penalty is None
        return fields[1].loss(supervised, target, weight)[0]

    expected = 0.3 * by_quadrature(np.asarray(EDGES), np.asarray(params), 2.2, 0.1)
    np.testing.assert_allclose(losses(jax.random.key(0)), expected, rtol=1e-3)


def test_pixels_learn_from_their_measured_depth():
    """Of five pixels one is unknown, one half trusted; whole images keep no light."""
    field = ray_field(
        Extent(1.0, 3.0), init=None, trace=trace, chunk=4, supervision=PixelSupervision(0.3)
    )
    params, camera = jnp.array([0.25, 0.75]), plane.camera_above(0.0, 0.0, 4.0)
    depth, trust = jnp.array([2.2, 1.5, 0.0, 2.9, 2.9]), jnp.array([1.0, 1.0, 0.0, 0.5, 1.0])

    @jax.jit
    def loss(params, key):
        seen = field.render(params, (), camera, jnp.ones((5, 2)), key)
        return field.depth_loss(seen, depth, trust)

    diverged = [
        by_quadrature(np.asarray(EDGES), np.asarray(params), mean, 0.005 * mean)
        for mean in (2.2, 1.5, 2.9)
    ]
    expected = 0.3 * np.dot([1, 1, 1.5], diverged) / 5
    np.testing.assert_allclose(loss(params, jax.random.key(0)), expected, rtol=1e-3)
    slope = jax.jit(jax.grad(loss))(params, jax.random.key(0))
    assert np.all(np.isfinite(slope))
    assert field.render(params, (), camera, jnp.ones((5, 2)), None).aux.light is None


def scene(points, rgb, **metadata):
    cameras = [plane.camera_above(x, 0.1, 4.0) for x in (-1.0, 1.0)]
    views, depths = plane.make_views(cameras)
    names = {"train": ["a", "b"]}
    rgb = np.asarray(rgb, np.float32)
    return Scene(
        "plane", views, None, None, np.float32(points), rgb, 1.0, 8.0, names, metadata
    ), depths


def test_photographs_show_points_that_nothing_hides_and_that_have_their_color():
    numbers = np.random.default_rng(2)
    on_plane = np.column_stack([numbers.uniform(-0.8, 0.8, (30, 2)), np.zeros(30)])
    behind = on_plane - [0.0, 0.0, 1.0]  # under the plane
    rgb = np.clip(plane.texture(np.concatenate([on_plane, behind])), 0, 1)
    rgb[0] = [0.0, 1.0, 0.0]  # unlike the plane
    found = find_sightings(scene(np.concatenate([on_plane, behind]), rgb)[0])
    _, depths = scene(on_plane, rgb[:30])
    column, row = found.pixels.astype(int).T
    np.testing.assert_allclose(found.depth, np.asarray(depths)[found.view, row, column], rtol=1e-3)
    assert len(found.view) > 40
    first = plane.camera_above(-1.0, 0.1, 4.0)
    x, y = (on_plane[0, :2] - [-1.0, 0.1]) * [1, -1] * plane.FOCAL / 4.0 + [16, 12]
    there = np.all(np.abs(found.pixels[found.view == 0] - [x, y]) < 1e-3, axis=1)
    assert first.width > x > 0 and not there.any()


def test_a_models_own_tracks_and_errors_are_taken():
    """Two cameras see a point from either side: the deviation of its depth has a closed form."""
    points = np.array([[0.0, 0.1, 0.0], [0.2, 0.1, 0.0]])
    seen = [np.array([0, 1]), np.array([0])]
    told = {"seen": seen, "point_errors": np.array([4.0, np.nan]), "downscale": 8}
    found = find_sightings(scene(points, np.zeros((2, 3)), **told)[0])
    np.testing.assert_array_equal(found.view, [0, 1])  # a point seen once has no depth
    np.testing.assert_allclose(found.depth, 4, rtol=1e-6)
    angle = np.arctan2(1, 4)
    across = 0.5 * np.hypot(1, 4) / plane.FOCAL
    along = across * np.sqrt((np.tan(angle) ** 2 + 1 / np.tan(angle) ** 2) / 2)
    np.testing.assert_allclose(found.deviation, along * np.cos(angle), rtol=1e-5)


def test_a_scene_without_points_is_one_sentence():
    with pytest.raises(SceneError, match="no points that two training photographs show"):
        find_sightings(scene(np.zeros((0, 3)), np.zeros((0, 3)))[0])


def test_what_knows_depth_follows_from_the_settings():
    """A capture without points can be matched by stereo, but not supervised by points."""
    empty, _ = scene(np.zeros((0, 3)), np.zeros((0, 3)))
    quick = METHODS["ngp"].presets["quick"]
    assert quick.field.depth_from == "stereo" and quick.stereo.pixels > 0
    make = METHODS["ngp"].make_field
    assert make(quick.field, empty, 1).depth_loss is not None
    unsupervised = dataclasses.replace(quick.field, depth_weight=0.0)
    assert make(unsupervised, empty, 1).depth_loss is None
    with pytest.raises(SceneError, match="no points that two training photographs show"):
        make(dataclasses.replace(quick.field, depth_from="points"), empty, 1)
