import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import plane
import pytest
from tiny_training import RATE, fresh_state, one_color_field, settings

from jaxcloseup.labels.make import label_sources
from jaxcloseup.photos.views import sample_image, sample_pixels
from jaxcloseup.photos.windows import view_windows
from jaxcloseup.training.config import TrainConfig
from jaxcloseup.training.steps import closeup_step, labeled_step, pseudo_step, run_steps, train_step


@pytest.fixture(scope="module")
def capture():
    cameras = [plane.camera_above(x, 0.0, 4.0) for x in (-0.5, 0.0, 0.5)]
    return plane.make_views(cameras)


@functools.cache
def bind(step, **config):
    bound = functools.partial(
        step, field=one_color_field(), optimizer=optax.sgd(RATE), config=TrainConfig(**config)
    )
    return jax.jit(bound)


def drawn(state, views, count):
    """The photographs' colors that a step of this state sees."""
    key = jax.random.split(jax.random.fold_in(state.key, state.step), 4)[0]
    batch = sample_image(key, views) if count is None else sample_pixels(key, views, count)
    return batch.rgb.reshape(-1, 3)


@pytest.mark.parametrize("count", [64, None])
def test_a_step_on_photographs_is_gradient_descent_on_their_pixels(capture, count):
    views, _ = capture
    state = fresh_state()
    after, metrics = bind(train_step, num_rays=count)(state, views)
    rgb = drawn(state, views, count)
    # d/dc mean |c - t|^2 = 2 (c - mean t)
    expected = state.params - RATE * 2 * (state.params - rgb.mean(axis=0))
    np.testing.assert_allclose(after.params, expected, atol=1e-6)
    assert after.step == 1
    error = jnp.mean(jnp.sum((rgb - state.params[None]) ** 2, axis=-1))
    np.testing.assert_allclose(metrics["loss"], error, rtol=1e-5)


@pytest.mark.parametrize("count", [64, None])
def test_when_nothing_is_labeled_half_the_photographs_loss_remains(capture, count):
    views, depths = capture
    state = fresh_state()
    step = bind(pseudo_step, num_rays=count, num_label_rays=count and 256)
    after, metrics = step(state, views, depths, settings(rgb_tolerance=0.0))
    expected = state.params - RATE * (state.params - drawn(state, views, count).mean(axis=0))
    np.testing.assert_allclose(after.params, expected, atol=1e-6)
    assert metrics["label_coverage"] == 0
    assert jnp.isfinite(metrics["loss"])


def test_labels_pull_with_half_the_weight_whatever_their_number(capture):
    views, depths = capture
    # Photographs are black beyond what is drawn, labels white: their shares can be read off.
    white = views.replace(rgb=jnp.ones_like(views.rgb))
    state = fresh_state()
    step = bind(pseudo_step, num_rays=64, num_label_rays=256)
    after, metrics = step(state, white, depths, settings())
    assert 0 < metrics["label_coverage"] < 1
    # Both means are white: (L_c + L_pl) / 2 has the gradient 2 (c - 1), as each has alone.
    np.testing.assert_allclose(
        after.params, state.params - RATE * 2 * (state.params - 1), atol=1e-6
    )
    # With loss summed per mean, a coverage under 1 does not weaken the labels.
    pooled = bind(pseudo_step, num_rays=64, num_label_rays=256, label_rule="pooled")
    after_pooled, _ = pooled(state, white, depths, settings())
    np.testing.assert_allclose(after_pooled.params, after.params, atol=1e-6)


def test_pooling_weighs_photographs_and_labels_by_their_pixels(capture):
    views, depths = capture
    state = fresh_state()
    arguments = views, depths, settings(use_mask=0.0)
    halves, metrics = bind(pseudo_step, num_rays=64, num_label_rays=256)(state, *arguments)
    pooled, _ = bind(pseudo_step, num_rays=64, num_label_rays=256, label_rule="pooled")(
        state, *arguments
    )
    photographs = drawn(state, views, 64).mean(axis=0)
    # Solve the mean label out of the first step; predict the second from it.
    pull = (state.params - halves.params) / RATE  # = (c - p) + (c - l)
    labels = 2 * state.params - photographs - pull
    kept = metrics["label_coverage"] * 256
    mean = (64 * photographs + kept * labels) / (64 + kept)
    expected = state.params - RATE * 2 * (state.params - mean)
    np.testing.assert_allclose(pooled.params, expected, atol=1e-5)


@pytest.mark.parametrize("rule", ["pooled", "released"])
def test_windows_and_labels_of_other_sizes_are_pooled(capture, rule):
    """Every pixel has the field's one color, so the loss is that of all pixels, wherever from."""
    views, depths = capture
    windows = view_windows(views, plane.HEIGHT // 2, plane.WIDTH // 2)
    state, sources = fresh_state(), label_sources(views, depths)
    step = bind(closeup_step, num_rays=64, num_label_rays=256, label_rule=rule)
    after, metrics = step(state, windows, sources, settings(use_mask=0.0))
    assert 0 < metrics["label_coverage"] <= 1 and np.isfinite(metrics["loss"])
    assert np.abs(after.params - state.params).max() > 0
    with pytest.raises(ValueError, match="pools single pixels: give num_rays"):
        TrainConfig(num_rays=None, num_label_rays=256, label_rule=rule)


def test_the_control_sees_the_same_photographs(capture):
    views, depths = capture
    state = fresh_state()
    step = bind(pseudo_step, num_rays=64, num_label_rays=256)
    unlabeled, _ = step(state, views, depths, settings(rgb_tolerance=0.0))
    control, _ = bind(train_step, num_rays=64)(state, views)
    half_way = (control.params - state.params) / 2
    np.testing.assert_allclose(unlabeled.params - state.params, half_way, atol=1e-6)


@pytest.mark.parametrize("rule", ["paper", "pooled"])
def test_without_label_weight_a_step_is_the_control(capture, rule):
    views, depths = capture
    state = fresh_state()
    step = bind(pseudo_step, num_rays=64, num_label_rays=256, label_rule=rule)
    arm, metrics = step(state, views, depths, settings(label_loss_weight=0.0, use_mask=0.0))
    assert metrics["label_coverage"] > 0
    control, _ = bind(train_step, num_rays=64)(state, views)
    np.testing.assert_allclose(arm.params, control.params, atol=1e-6)


def test_lr_scale_scales_what_a_step_with_labels_changes(capture):
    views, depths = capture
    state = fresh_state()
    step = bind(pseudo_step, num_rays=64, num_label_rays=256)
    whole, _ = step(state, views, depths, settings())
    half, _ = step(state, views, depths, settings().replace(lr_scale=jnp.float32(0.5)))
    np.testing.assert_allclose(
        half.params - state.params, (whole.params - state.params) / 2, atol=1e-6
    )


@pytest.mark.parametrize(("rule", "noisy"), [("paper", False), ("released", True)])
def test_the_released_rule_alone_renders_label_depth_with_noise(capture, rule, noisy):
    views, depths = capture
    keys = []

    def render(params, buffers, camera, pixels, key):
        if camera.intrinsics.ndim == 1:  # the virtual view
            keys.append(key)
        return one_color_field().render(params, buffers, camera, pixels, key)

    step = functools.partial(
        pseudo_step,
        field=one_color_field()._replace(render=render),
        optimizer=optax.sgd(RATE),
        config=TrainConfig(num_rays=64, num_label_rays=256, label_rule=rule),
    )
    jax.eval_shape(step, fresh_state(), views, depths, settings())
    assert (keys[0] is not None) == noisy


@pytest.mark.parametrize("count", [64, None])
@pytest.mark.parametrize("share", [0.0, 0.25])
def test_labeled_views_count_with_their_share(capture, count, share):
    views, _ = capture
    white = jnp.zeros(views.weight.shape).at[:, :, :5].set(1)
    labels = views.replace(rgb=jnp.where(white[..., None] > 0, 1.0, 0.3), weight=white)
    state = fresh_state()
    step = bind(labeled_step, num_rays=count, num_label_rays=count and 4096)
    after, metrics = step(state, views, labels, settings(label_loss_weight=share))
    photographs = drawn(state, views, count).mean(axis=0)
    pull = (1 - share) * (state.params - photographs) + share * (state.params - 1)
    np.testing.assert_allclose(after.params, state.params - RATE * 2 * pull, atol=1e-6)
    assert metrics["skipped"] == 0


def test_steps_in_one_scan_equal_steps_one_by_one(capture):
    views, depths = capture
    step = bind(pseudo_step, num_rays=64, num_label_rays=256)
    data = views, depths, settings()

    @jax.jit
    def run_two(state):
        return run_steps(lambda state: step(state, *data), state, count=2)

    at_once, metrics = run_two(fresh_state())
    first, first_metrics = step(fresh_state(), *data)
    second, second_metrics = step(first, *data)
    np.testing.assert_allclose(at_once.params, second.params, rtol=1e-6)
    mean = (first_metrics["loss"] + second_metrics["loss"]) / 2
    np.testing.assert_allclose(metrics["loss"], mean, rtol=1e-5)
    other, _ = step(fresh_state(seed=1), *data)
    assert not np.array_equal(first.params, other.params)


@pytest.mark.parametrize("step", ["photographs", "labels"])
def test_a_step_that_is_not_finite_changes_nothing_but_the_count(capture, step):
    views, depths = capture
    broken = views.replace(rgb=views.rgb.at[:, 3, 4].set(jnp.nan))
    state = fresh_state()
    if step == "photographs":
        after, metrics = bind(train_step, num_rays=None)(state, broken)
        _, fine = bind(train_step, num_rays=None)(state, views)
    else:
        run = bind(pseudo_step, num_rays=None, num_label_rays=None)
        after, metrics = run(state, broken, depths, settings())
        _, fine = run(state, views, depths, settings())
    assert metrics["skipped"] == 1
    assert fine["skipped"] == 0
    assert after.step == state.step + 1
    jax.tree.map(np.testing.assert_array_equal, after.params, state.params)
    jax.tree.map(np.testing.assert_array_equal, after.opt_state, state.opt_state)
