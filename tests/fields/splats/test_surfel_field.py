"""Surfels as a field: loss, schedules, training that finds a surface, and overflow."""

import dataclasses

import chex
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from splat_scenes import random_scene, to_camera, to_surfels, trainer

from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.fields.splats import RasterizeConfig, SurfelConfig
from jaxcloseup.fields.splats.config import McmcConfig
from jaxcloseup.fields.splats.splat_field import camera_extent, surfel_field, with_expected_depth
from jaxcloseup.fields.splats.splat_optimizer import surfel_optimizer
from jaxcloseup.fields.splats.surfels import random_points
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.metrics.image_metrics import psnr
from jaxcloseup.photos.views import camera_at


STEPS = 200
CONFIG = SurfelConfig(
    capacity=400,
    sh_degree=1,
    sh_every=80,
    initial_opacity=0.5,
    regularize_from=50,
    means_lr=(2e-3, 2e-4),
    sh_lr=2e-2,
    rotation_lr=1e-2,
    means_lr_steps=STEPS,
    density=McmcConfig(every=25, start=25, stop=150, growth=1.1),
    raster=RasterizeConfig(capacity=2**13, near=0.2, tile=8, chunk=4, block=12),
)
EXTENT = 2.0
FIELD = surfel_field(CONFIG, extent=EXTENT)
OPTIMIZER = surfel_optimizer(CONFIG, extent=EXTENT)
start, run = trainer(FIELD, OPTIMIZER)


@pytest.fixture(scope="module")
def capture():
    places = [(x, y) for x in (-0.6, 0.0, 0.6) for y in (-0.4, 0.4)]
    return plane.make_views([plane.camera_above(x, y, 2.0, tilt=0.3 * y) for x, y in places])


@pytest.fixture(scope="module")
def trained(capture):
    rng = np.random.default_rng(0)
    state = start(rng.uniform([-1.6, -1.4, -0.15], [1.6, 1.4, 0.15], (250, 3)))
    first, _ = run(state, capture[0], STEPS // 2)
    last, metrics = run(first, capture[0], STEPS // 2)
    return state, first, last, metrics


render = jax.jit(lambda params, buffers, camera: FIELD.render(params, buffers, camera, None, None))


def test_measured_depth_pulls_what_is_drawn_to_it(trained, capture):
    """Its loss is that of NumPy, and falls when what lies before the surface fades."""
    state, camera = trained[2], camera_at(capture[0].cameras, 0)
    exact = np.asarray(capture[1][0])
    config = dataclasses.replace(CONFIG, depth_weight=2.0, depth_kept=0.25)
    field = surfel_field(config, extent=EXTENT)
    assert FIELD.depth_loss is None
    buffers = field.adapt(jax.random.key(0), state.replace(step=jnp.int32(STEPS // 2))).buffers
    trust = np.zeros(exact.shape, np.float32)
    trust[4:20, 4:28] = 0.5
    depth = np.where(trust > 0, exact, 0).astype(np.float32)

    @jax.jit
    @jax.value_and_grad
    def loss_of(params):
        image = field.render(params, buffers, camera, None, None)
        return field.depth_loss(image, jnp.asarray(depth), jnp.asarray(trust))

    value, gradient = loss_of(state.params)
    image = field.render(state.params, buffers, camera, None, None)
    seen, alpha = (np.asarray(x, np.float64) for x in (image.aux.expected_depth, image.alpha))
    error = np.abs(seen / exact - 1)
    expected = np.mean(2.0 * 0.5 * alpha * trust * error / (1 + error / 0.1))  # half of the weight
    np.testing.assert_allclose(value, expected, rtol=1e-4)
    # The plane is z = 0, and cameras look down: what is above it should fade.
    up = np.asarray(state.params.means[:, 2]) > 0.05
    fades = np.asarray(gradient.opacity_logits)
    assert np.sum(fades[up & (fades != 0)] > 0) > 0.7 * np.sum(up & (fades != 0))
    assert np.all(np.isfinite(jax.flatten_util.ravel_pytree(gradient)[0]))
    # At the end only the share that is kept remains.
    last = field.adapt(jax.random.key(0), state.replace(step=jnp.int32(10 * STEPS))).buffers
    np.testing.assert_allclose(last.hold, 2.0 * 0.25)


@jax.jit
@jax.value_and_grad
def judge(rgb, image, target, weight):
    return FIELD.loss(image._replace(rgb=rgb), target, weight)[0]


def test_training_finds_the_plane(trained, capture):
    views, depths = capture
    begun, _, state, metrics = trained
    assert metrics["overflow"] == 0
    errors = []
    for i in range(len(views.rgb)):
        camera = camera_at(views.cameras, i)
        image = render(state.params, state.buffers, camera)
        assert psnr(image.rgb, views.rgb[i]) > 26
        before = render(begun.params, begun.buffers, camera).depth
        errors.append([np.abs(d - depths[i]) / depths[i] for d in (before, image.depth)])
        # Normals start at random; this short training turns them half of the way.
        upwards = [
            np.mean(render(s.params, s.buffers, camera).aux.surfels.normal[..., 2])
            for s in (begun, state)
        ]
        assert upwards[1] > upwards[0] + 0.1
    before, after = np.median(np.stack(errors, 1).reshape(2, -1), axis=1)
    assert after < 0.7 * before


def test_an_image_may_change_its_colors_by_an_affine_map(trained, capture):
    """A photograph in other light costs 0.3 times its loss without the affine map."""
    state, camera = trained[2], camera_at(capture[0].cameras, 0)
    image = render(state.params, state.buffers, camera)
    change = jnp.array([[0.8, 0.1, 0.0], [0.0, 0.7, 0.1], [0.1, 0.0, 0.9]])
    target = jnp.matmul(image.rgb, change[None], precision="highest") + 0.05
    free = surfel_field(dataclasses.replace(CONFIG, color_ridge=1e-6), extent=EXTENT)
    ones = jnp.ones(target.shape[:2])

    def loss_of(field, weight):
        return jax.value_and_grad(
            lambda rgb: field.loss(image._replace(rgb=rgb), target, weight)[0]
        )(image.rgb)

    same, _ = FIELD.loss(image, image.rgb, ones)
    fixed = float(loss_of(FIELD, ones)[0] - same)
    assert fixed > 0.05
    np.testing.assert_allclose(float(loss_of(free, ones)[0] - same), 0.3 * fixed, atol=1e-3)
    value, gradient = loss_of(free, 0 * ones)
    assert np.isfinite(value)
    assert np.all(np.asarray(gradient) == 0)


def test_schedules_follow_the_step(trained):
    begun, middle, end, _ = trained
    for state, degree, regularize in ((begun, 0, 0), (middle, 1, 1), (end, 1, 1)):
        assert state.buffers.degree == degree
        assert state.buffers.regularize == regularize
    assert begun.buffers.alive.sum() == 250
    # Relocations come at 50, 75, 100 and 125, before `stop` at 150.
    assert middle.buffers.alive.sum() == int(int(int(250 * 1.1) * 1.1) * 1.1)
    assert end.buffers.alive.sum() == int(int(middle.buffers.alive.sum()) * 1.1)
    assert begun.step == 0
    assert end.step == STEPS


def test_a_saved_state_continues_to_the_same_bits(trained, capture, tmp_path):
    """The steps after the checkpoint include relocations and growth."""
    begun, middle, end, _ = trained
    Checkpoints(tmp_path, {}).save("baseline", STEPS // 2, middle, {})
    _, kept, _ = Checkpoints(tmp_path, {}).load("baseline", begun)
    again, _ = run(kept, capture[0], STEPS // 2)
    for now, before in zip(jax.tree.leaves(again), jax.tree.leaves(end), strict=True):
        if jax.dtypes.issubdtype(now.dtype, jax.dtypes.prng_key):
            now, before = jax.random.key_data(now), jax.random.key_data(before)
        np.testing.assert_array_equal(now, before)


def test_late_noise_is_as_small_as_late_learning_rates(trained):
    """The position noise follows the learning rate of the means."""
    state = trained[2].replace(step=jnp.int32(STEPS + 1))
    moves = []
    for late_lr_scale in (1.0, 0.1):
        field = surfel_field(
            dataclasses.replace(CONFIG, late_lr_scale=late_lr_scale), extent=EXTENT
        )
        after = field.adapt(jax.random.key(1), state)
        moves.append(np.asarray(after.params.means - state.params.means, np.float64))
    assert np.abs(moves[0]).max() > 1e-4
    assert np.linalg.norm(moves[1]) == pytest.approx(0.1 * np.linalg.norm(moves[0]), rel=1e-2)


def test_the_optimizer_forgets_surfels_that_changed(trained):
    """Adam's moments are 0 in rows that a relocation changed, and unchanged in other rows."""
    state = trained[1]
    state = state.replace(step=jnp.int32(50))
    moved = jax.jit(FIELD.adapt)(jax.random.key(1), state)
    changed = np.any(np.asarray(moved.params.log_scales != state.params.log_scales), axis=1)
    changed |= np.asarray(moved.buffers.alive & ~state.buffers.alive)
    alive = np.asarray(state.buffers.alive)
    assert changed.sum() > 10
    for moment in (moved.opt_state[0].mu, moved.opt_state[0].nu):
        assert np.all(np.asarray(moment.means)[changed] == 0)
    kept = alive & ~changed
    np.testing.assert_array_equal(
        np.asarray(moved.opt_state[0].mu.means)[kept], state.opt_state[0].mu.means[kept]
    )
    assert np.mean(np.any(np.asarray(moved.opt_state[0].mu.means)[kept] != 0, axis=1)) > 0.5
    assert moved.opt_state[0].count == state.opt_state[0].count


def test_the_first_step_moves_every_parameter_by_its_learning_rate():
    surfels = to_surfels(random_scene(0))
    gradient = jax.tree.map(lambda leaf: jnp.where(leaf > 0, 3.0, -0.5), surfels)
    with jax.numpy_dtype_promotion("standard"):
        updates, _ = OPTIMIZER.update(gradient, OPTIMIZER.init(surfels), surfels)
    expected = {
        "means": 2e-3 * EXTENT,
        "log_scales": 5e-3,
        "quaternions": 1e-2,
        "opacity_logits": 5e-2,
    }
    for name, learning_rate in expected.items():
        sign = np.sign(getattr(gradient, name))
        np.testing.assert_allclose(getattr(updates, name), -learning_rate * sign, rtol=1e-5)
    size = np.abs(updates.sh)
    np.testing.assert_allclose(size[:, 0], 2e-2, rtol=1e-5)
    np.testing.assert_allclose(size[:, 1:], 2e-2 / 20, rtol=1e-5)


def test_late_steps_are_smaller():
    config = dataclasses.replace(CONFIG, means_lr_steps=1, late_lr_scale=0.1)
    optimizer = surfel_optimizer(config, extent=EXTENT)
    surfels = to_surfels(random_scene(0))
    with jax.numpy_dtype_promotion("standard"):
        first, state = optimizer.update(surfels, optimizer.init(surfels), surfels)
        late, _ = optimizer.update(surfels, state, surfels)
    for name in ("log_scales", "quaternions", "opacity_logits", "sh"):
        np.testing.assert_allclose(getattr(late, name), 0.1 * getattr(first, name), rtol=1e-4)
    # The learning rate of the means has also decayed to its last value.
    np.testing.assert_allclose(late.means, 0.01 * first.means, rtol=1e-4)


@pytest.fixture(scope="module")
def image(trained, capture):
    state, views = trained[2], capture[0]
    camera = camera_at(views.cameras, 0)
    return render(state.params, state.buffers, camera)


def test_pixels_of_weight_zero_do_not_count(image, capture):
    target = capture[0].rgb[1]
    weight = jnp.ones(target.shape[:2]).at[:, 20:].set(0)
    value, gradient = judge(image.rgb, image, target, weight)
    other, same = judge(image.rgb, image, jnp.where(weight[..., None] > 0, target, 0.3), weight)
    assert value == other
    np.testing.assert_array_equal(gradient, same)
    assert np.all(np.asarray(gradient[:, 20:][:, 6:]) == 0)
    assert np.any(np.asarray(gradient[:, :20]) != 0)


@pytest.mark.parametrize("kind", ["nothing", "the border"])
def test_without_weight_the_loss_is_zero_and_not_nan(image, capture, kind):
    weight = jnp.zeros(capture[0].rgb.shape[1:3])
    if kind == "the border":
        weight = weight.at[0].set(1)
    value, gradient = judge(image.rgb, image, capture[0].rgb[0], weight)
    assert np.isfinite(value)
    assert (value == 0) == (kind == "nothing")
    assert np.isfinite(gradient).all()


def test_degree_zero_ignores_higher_harmonics(trained, capture):
    state = trained[2]
    camera = camera_at(capture[0].cameras, 0)
    bands = state.params.replace(sh=state.params.sh.at[:, 1:].add(0.5))
    low = state.buffers.replace(degree=jnp.int32(0))
    plain, banded = (render(params, low, camera).rgb for params in (state.params, bands))
    np.testing.assert_array_equal(plain, banded)
    assert np.any(render(bands, state.buffers, camera).rgb != plain)


def test_depth_is_the_median_or_expected_depth(trained, capture):
    state = trained[2]
    camera = camera_at(capture[0].cameras, 0)
    image = render(state.params, state.buffers, camera)
    buffers = with_expected_depth(state.buffers, True)
    chex.assert_trees_all_equal_shapes_and_dtypes(buffers, state.buffers)
    mean = render(state.params, buffers, camera)
    np.testing.assert_array_equal(image.depth, image.aux.surfels.median_depth)
    assert np.any(mean.depth != image.depth)
    assert np.median(np.abs(mean.depth / image.depth - 1)) < 0.05
    stacked = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), buffers)
    np.testing.assert_array_equal(with_expected_depth(stacked, False).expected, [0, 0])
    # The config chooses the depth of a new field.
    other = surfel_field(dataclasses.replace(CONFIG, depth="expected"), extent=EXTENT)
    for field, flag in ((FIELD, 0), (other, 1)):
        _, buffers = field.init(jax.random.key(0), jnp.eye(3), jnp.eye(3))
        assert buffers.expected == flag


def test_no_surfel_grows_beyond_the_largest_scale(trained):
    state = trained[2]
    before = np.asarray(state.params.log_scales, np.float64)
    largest = np.exp(np.median(before))
    config = dataclasses.replace(CONFIG, density=None, max_scale=float(largest / EXTENT))
    after = surfel_field(config, extent=EXTENT).adapt(jax.random.key(1), state)
    expected = np.minimum(before, np.log(largest))
    assert 0.4 < np.mean(expected < before) < 0.6
    np.testing.assert_allclose(after.params.log_scales, expected, rtol=1e-5)
    unchanged = state.params.replace(log_scales=after.params.log_scales)
    jax.tree.map(np.testing.assert_array_equal, after.params, unchanged)

    # Far from the cameras the bound is an angle.
    center = np.median(np.asarray(state.params.means), axis=0)
    distance = np.linalg.norm(np.asarray(state.params.means) - center, axis=-1)
    extent = float(np.median(distance))
    config = dataclasses.replace(config, max_scale=float(largest / extent))
    after = surfel_field(config, extent=extent, center=jnp.asarray(center)).adapt(
        jax.random.key(1), state
    )
    bound = largest * np.maximum(distance / extent, 1)
    expected = np.minimum(before, np.log(bound)[:, None])
    assert np.any((expected > np.log(largest)) & (expected < before))
    np.testing.assert_allclose(after.params.log_scales, expected, rtol=1e-5, atol=1e-6)


def test_without_density_control_only_the_schedule_changes(trained):
    state = trained[0].replace(step=jnp.int32(80))
    field = surfel_field(dataclasses.replace(CONFIG, density=None), extent=EXTENT)
    after = field.adapt(jax.random.key(1), state)
    jax.tree.map(np.testing.assert_array_equal, after.params, state.params)
    assert (after.buffers.degree, after.buffers.regularize) == (1, 1)


def test_a_field_with_more_capacity_renders_what_overflowed(trained, capture):
    """A caller of the loops grows the capacity until everything fits."""
    state, camera = trained[0], camera_at(capture[0].cameras, 0)

    def render_with(capacity):
        raster = dataclasses.replace(CONFIG.raster, capacity=capacity, compositor="loops")
        field = surfel_field(dataclasses.replace(CONFIG, raster=raster), extent=EXTENT)
        return jax.jit(field.render)(state.params, state.buffers, camera, None, None)

    capacity = 300
    image = render_with(capacity)
    assert image.overflow > 0
    while int(image.overflow) > 0:
        capacity *= 16
        image = render_with(capacity)
    assert 300 < capacity < CONFIG.raster.capacity
    jax.tree.map(np.testing.assert_array_equal, image, render_with(CONFIG.raster.capacity))
    np.testing.assert_array_equal(image.normal, image.aux.surfels.normal)


def test_invalid_settings_are_refused():
    with pytest.raises(ValueError, match="depth"):
        surfel_field(dataclasses.replace(CONFIG, depth="mean"), extent=EXTENT)
    with pytest.raises(ValueError, match="max_scale must be positive or None, not 0"):
        surfel_field(dataclasses.replace(CONFIG, max_scale=0), extent=EXTENT)
    with pytest.raises(ValueError, match="extent"):
        surfel_field(CONFIG, extent=0.0)
    with pytest.raises(TypeError, match="density must be None or one of McmcConfig"):
        surfel_field(dataclasses.replace(CONFIG, density="classic"), extent=EXTENT)
    with pytest.raises(ValueError, match="whole images"):
        FIELD.render(to_surfels(random_scene(0)), None, to_camera(), jnp.zeros((5, 2)), None)


def test_extent_is_the_largest_distance_to_the_mean_camera():
    poses = np.tile(np.eye(4)[:3], (3, 1, 1))
    poses[:, 0, 3] = [-1, 0, 4]
    cameras = Camera(jnp.asarray(poses, jnp.float32), jnp.ones((3, 4)), 4, 4)
    assert float(camera_extent(cameras)) == pytest.approx(1.1 * 3)


def test_random_points_lie_where_the_cameras_look(capture, key):
    cameras = capture[0].cameras
    points = np.asarray(random_points(key, cameras, near=0.5, far=6.0, count=300), float)
    assert points.shape == (300, 3)
    seen = np.zeros(300)
    for i in range(cameras.intrinsics.shape[0]):
        pose = np.asarray(cameras.camtoworld[i], float)
        x, y, z = ((points - pose[:, 3]) @ pose[:, :3]).T
        assert z.min() > 0
        column, row = plane.FOCAL * x / z + 16, plane.FOCAL * y / z + 12
        seen += (column > 0) & (column < 32) & (row > 0) & (row < 24)
    assert seen.min() >= 3
    assert seen.mean() > 4
    assert np.ptp(points[:, 2]) > 1
