"""Adaptive density control: which surfels are cloned, split and removed, and where they go."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from reference_splats import rotation_of
from splat_scenes import COUNT, HEIGHT, WIDTH, random_scene, to_camera, to_surfels, trainer

from jaxcloseup.fields.splats import RasterizeConfig, SurfelConfig
from jaxcloseup.fields.splats.adaptive import (
    AdaptiveConfig,
    ImageGradientState,
    apply_image_offset,
    refine,
    reset_opacities,
    with_image_offset,
)
from jaxcloseup.fields.splats.filters import smoothed
from jaxcloseup.fields.splats.splat_field import surfel_field
from jaxcloseup.fields.splats.splat_optimizer import surfel_optimizer
from jaxcloseup.geometry.cameras import points_to_pixels
from jaxcloseup.photos.views import camera_at


CONFIG = AdaptiveConfig(gradient=1.0, small=0.01, min_opacity=0.05, huge=0.1)
EXTENT = 2.0
SMALL, LARGE, HUGE = 0.01, 0.05, 0.5  # scales in world units, around CONFIG's times EXTENT
grow = jax.jit(functools.partial(refine, config=CONFIG, extent=EXTENT))


def scene_of(scales, opacities, num_scales=2):
    """Random splats with the given scales along the first tangent and the given opacities."""
    scene = random_scene(5)
    shares = np.array([1.0, 0.3, 0.1])[:num_scales]
    scene["log_scales"] = np.log(np.asarray(scales)[:, None] * shares)
    opacities = np.asarray(opacities, float)
    scene["opacity_logits"] = np.log(opacities) - np.log1p(-opacities)
    return with_image_offset(to_surfels(scene))


def gradients_of(mean):
    views = np.where(np.asarray(mean) > 0, 4.0, 0.0)
    return ImageGradientState(
        jnp.asarray(mean * views, jnp.float32), jnp.asarray(views, jnp.float32)
    )


def test_an_image_offset_moves_the_center_by_half_images():
    surfels, camera = with_image_offset(to_surfels(random_scene(2, depth=(0.5, 3.0)))), to_camera()
    before, depth = points_to_pixels(camera, surfels.means)
    image_offset = jnp.zeros((COUNT, 2)).at[3].set(jnp.array([0.1, -0.2]))
    after, depth_after = points_to_pixels(
        camera, apply_image_offset(surfels.replace(image_offset=image_offset), camera).means
    )
    expected = np.zeros((COUNT, 2))
    expected[3] = 0.1 * WIDTH / 2, -0.2 * HEIGHT / 2
    np.testing.assert_allclose(after - before, expected, atol=1e-3)
    np.testing.assert_allclose(depth_after, depth, rtol=1e-5)


@pytest.mark.parametrize("num_scales", [2, 3])
def test_small_surfels_are_cloned_large_split_faint_and_huge_removed(key, num_scales):
    scales, opacities, means = np.full(COUNT, SMALL), np.full(COUNT, 0.5), np.zeros(COUNT)
    means[[0, 1]] = 3.0, 2.0
    scales[1] = LARGE
    opacities[2] = 0.04
    scales[3] = HUGE
    means[4] = 0.99  # just below the threshold
    alive = np.arange(COUNT) < 10
    before = scene_of(scales, opacities, num_scales)
    gradients = gradients_of(means)
    after, now_alive, new, _ = grow(key, before, jnp.asarray(alive), gradients, remove_huge=True)
    assert int(now_alive.sum()) == 10 - 2 + 2
    # The surfel with the largest gradient takes the first free row; rows 2 and 3 were just removed.
    clone, halves = 2, (1, 3)
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(after, name)[clone], getattr(before, name)[0])
        np.testing.assert_array_equal(getattr(after, name)[0], getattr(before, name)[0])
    for row in halves:
        smaller = np.asarray(before.log_scales[1]) - np.log(1.6)
        np.testing.assert_allclose(after.log_scales[row], smaller, rtol=1e-5)
        np.testing.assert_array_equal(after.opacity_logits[row], before.opacity_logits[1])
        offset = np.asarray(after.means[row] - before.means[1], float)
        along = rotation_of(np.asarray(before.quaternions[1], float)).T @ offset
        assert np.abs(along[:2]).max() > 1e-4
        reach = np.array([1.0, 0.3, 0.1 if num_scales == 3 else 0.0]) * LARGE  # in a disc's plane
        assert np.all(np.abs(along) < 5 * reach + 1e-6) and (abs(along[2]) > 1e-5) == (
            num_scales == 3
        )
    np.testing.assert_array_equal(np.nonzero(new)[0], [1, 2, 3])
    untouched = [0, *range(4, 10)]
    np.testing.assert_array_equal(
        after.means[jnp.array(untouched)], before.means[jnp.array(untouched)]
    )
    kept, *_ = grow(key, before, jnp.asarray(alive), gradients, remove_huge=False)
    np.testing.assert_array_equal(kept.log_scales[3], before.log_scales[3])


def test_without_room_the_largest_gradients_come_first(key):
    gradients = gradients_of(np.linspace(1.5, 3, COUNT))
    alive = np.ones(COUNT, bool)
    alive[[4, 7]] = False
    before = scene_of(np.full(COUNT, SMALL), np.full(COUNT, 0.5))
    after, now_alive, new, source = grow(
        key, before, jnp.asarray(alive), gradients, remove_huge=False
    )
    assert now_alive.all()
    np.testing.assert_array_equal(np.nonzero(new)[0], [4, 7])
    np.testing.assert_array_equal(after.means[4], before.means[COUNT - 1])
    np.testing.assert_array_equal(after.means[7], before.means[COUNT - 2])
    np.testing.assert_array_equal(source[jnp.array([4, 7, 5])], [COUNT - 1, COUNT - 2, 5])


def test_a_reset_leaves_nothing_opaque():
    opacities = np.where(np.arange(COUNT) % 2, 0.9, 0.003)
    after = jax.nn.sigmoid(
        reset_opacities(scene_of(np.full(COUNT, SMALL), opacities), CONFIG).opacity_logits
    )
    np.testing.assert_allclose(after, np.where(np.arange(COUNT) % 2, 0.01, 0.003), rtol=1e-4)


def test_a_reset_counts_what_the_filter_in_space_takes():
    """Small surfels, of which the filter leaves little, are drawn as opaque as all others."""
    opacities = np.where(np.arange(COUNT) % 2, 0.9, 0.003)
    before = scene_of(np.full(COUNT, SMALL), opacities)
    interval = jnp.asarray(np.geomspace(0.1, 100, COUNT) * SMALL, jnp.float32)

    def drawn(surfels):
        return np.asarray(jax.nn.sigmoid(smoothed(surfels, interval).opacity_logits))

    after = drawn(reset_opacities(before, CONFIG, interval))
    np.testing.assert_allclose(after, np.minimum(drawn(before), 0.01), rtol=1e-3)
    assert drawn(before).max() > 0.8 and drawn(before).min() < 0.001


def test_training_records_image_gradients_and_adds_surfels():
    """The recorded gradient agrees with finite differences of the loss in the image offset."""
    density = AdaptiveConfig(every=20, start=19, stop=50, gradient=1e-5, reset_every=45)
    config = SurfelConfig(
        capacity=200,
        sh_degree=0,
        density=density,
        opacity_weight=0.0,
        scale_weight=0.0,
        regularize_from=1000,
        raster=RasterizeConfig(capacity=2**13, near=0.2, tile=8, chunk=4, block=12),
    )
    field, optimizer = surfel_field(config, extent=EXTENT), surfel_optimizer(config, extent=EXTENT)
    views, _ = plane.make_views([plane.camera_above(0.0, 0.0, 2.0)])
    points = np.random.default_rng(0).uniform([-1, -1, 0], [1, 1, 0], (80, 3)).astype(np.float32)
    start, run = trainer(field, optimizer)
    state = start(points)
    one, _ = run(state, views, 1)
    grown, _ = run(state, views, 21)
    faded, _ = run(state, views, 45)
    camera = camera_at(views.cameras, 0)

    @jax.jit
    def loss(image_offset):
        params = state.params.replace(image_offset=image_offset)
        rendering = field.render(params, state.buffers, camera, None, None)
        return field.loss(rendering, views.rgb[0], views.weight[0])[0]

    recorded = one.opt_state[0]
    strongest = int(jnp.argmax(recorded.total))
    differences = []
    for axis in range(2):
        step = jnp.zeros((200, 2)).at[strongest, axis].set(2e-3)
        differences.append((loss(step) - loss(-step)) / 4e-3)
    assert float(recorded.total[strongest]) == pytest.approx(
        float(np.hypot(*differences)), rel=0.05
    )
    assert int(grown.buffers.alive.sum()) > 80
    assert float(grown.opt_state[0].views.max()) == 1  # recorded anew after the refinement
    assert float(jnp.abs(grown.params.image_offset).max()) == 0
    assert float(jax.nn.sigmoid(faded.params.opacity_logits).max()) == pytest.approx(0.01, rel=1e-3)
    assert float(jnp.abs(faded.opt_state[1][0].mu.opacity_logits).max()) == 0
