import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from tiny_training import settings

from jaxcloseup.geometry.cameras import pixel_grid
from jaxcloseup.geometry.poses import PoseSettings
from jaxcloseup.labels.make import PseudoSettings, label_sources, make_label, sample_virtual_camera
from jaxcloseup.labels.target_views import best_source, label_views


label = jax.jit(make_label)
POSITIONS = (-1.0, 0.0, 1.0, 0.5)
GRID = pixel_grid(plane.HEIGHT, plane.WIDTH)


@pytest.fixture(scope="module")
def capture():
    cameras = [plane.camera_above(x, 0.1 * x, 4.0, tilt=0.1 * x) for x in POSITIONS]
    views, depths = plane.make_views(cameras)
    closeup = plane.camera_above(0.2, 0.1, 1.2, tilt=0.2)
    return views, depths, closeup


def truth(camera):
    rgb, depth, points = plane.photograph(camera)
    return rgb, jnp.asarray(depth, jnp.float32), points


def seen_by_first(points, camera):
    """Which points lie in the photograph of a camera, from the definition."""
    pose = np.asarray(camera.camtoworld, np.float64)
    x, y, z = np.moveaxis((points - pose[:, 3]) @ pose[:, :3], -1, 0)
    u = plane.FOCAL * x / z + plane.WIDTH / 2
    v = plane.FOCAL * y / z + plane.HEIGHT / 2
    return (z > 0) & (u >= 0) & (u < plane.WIDTH) & (v >= 0) & (v < plane.HEIGHT)


def rays_cosine(points, one, other):
    """Cosines of the angles between the rays of two cameras, in float64."""
    rays = [points - np.asarray(c.camtoworld, np.float64)[:, 3] for c in (one, other)]
    norms = [np.linalg.norm(ray, axis=-1) for ray in rays]
    return np.sum(rays[0] * rays[1], axis=-1) / (norms[0] * norms[1])


def test_labels_from_exact_depth_are_the_true_colors(capture):
    views, depths, closeup = capture
    rgb, depth, _ = truth(closeup)
    result = label(closeup, GRID, depth, 1, views, depths, settings())
    kept = np.asarray(result.weight) > 0
    assert kept.mean() > 0.25  # the union, rounded to pixels, is sparse at this magnification
    np.testing.assert_allclose(result.rgb[kept], rgb[kept], atol=0.02)
    assert np.abs(np.asarray(result.forward)[kept] - rgb[kept]).max() < 0.17


def test_without_the_mask_every_pixel_that_the_source_sees_is_labeled(capture):
    views, depths, closeup = capture
    high = plane.camera_above(1.0, 0.0, 3.5)  # sees more than the first photograph does
    for camera in (closeup, high):
        rgb, depth, points = truth(camera)
        result = label(camera, GRID, depth, 0, views, depths, settings(use_mask=0.0))
        source = jax.tree.map(lambda leaf: leaf[0], views.cameras)
        np.testing.assert_array_equal(result.weight > 0, seen_by_first(points, source))
        kept = np.asarray(result.weight) > 0
        np.testing.assert_allclose(result.rgb[kept], rgb[kept], atol=0.04)


def test_a_photograph_that_lies_is_masked_by_the_others(capture):
    views, depths, closeup = capture
    _, depth, _ = truth(closeup)
    lying = views.replace(rgb=views.rgb.at[1].set(1 - views.rgb[1]))
    honest = label(closeup, GRID, depth, 1, views, depths, settings(leave_out_source=1.0))
    result = label(closeup, GRID, depth, 1, lying, depths, settings(leave_out_source=1.0))
    assert honest.weight.mean() > 0.2
    assert result.weight.mean() < 0.1 * honest.weight.mean()
    # With itself in the union, the liar vouches for itself.
    fooled = label(closeup, GRID, depth, 1, lying, depths, settings())
    assert fooled.weight.mean() > 2 * result.weight.mean()


def test_depth_agreement_rejects_what_the_source_does_not_see(capture):
    views, depths, closeup = capture
    _, depth, _ = truth(closeup)
    occluded = depths.at[1, :, : plane.WIDTH // 2].multiply(0.5)  # a wall before the left half
    loose = label(closeup, GRID, depth, 1, views, occluded, settings(use_mask=0.0))
    strict = settings(use_mask=0.0, depth_tolerance=0.05)
    tight = label(closeup, GRID, depth, 1, views, occluded, strict)
    landed_left = np.asarray(loose.weight) > np.asarray(tight.weight)
    assert jnp.all(loose.weight == 1)
    assert 0.1 < landed_left.mean() < 0.9
    assert landed_left[:, :4].all()


def test_the_released_label_is_the_forward_warp(capture):
    views, depths, closeup = capture
    _, depth, _ = truth(closeup)
    result = label(closeup, GRID, depth, 1, views, depths, settings(forward_label=1.0))
    kept = np.asarray(result.weight) > 0
    np.testing.assert_array_equal(result.rgb, result.forward)
    assert not np.array_equal(result.rgb[kept], result.backward[kept])


def test_labels_end_at_the_largest_angle_between_rays(capture):
    views, depths, closeup = capture
    _, depth, points = truth(closeup)
    wide = settings(use_mask=0.0)
    kept = label(closeup, GRID, depth, 1, views, depths, wide).weight > 0
    cosine = rays_cosine(points, closeup, jax.tree.map(lambda leaf: leaf[1], views.cameras))
    limit = float(np.median(np.arccos(cosine)))
    narrow = wide.replace(max_ray_angle=jnp.float32(limit))
    result = label(closeup, GRID, depth, 1, views, depths, narrow)
    clear = np.abs(np.arccos(cosine) - limit) > 1e-3  # of what is not float32's rounding
    expected = np.asarray(kept) & (np.arccos(cosine) < limit)
    np.testing.assert_array_equal((result.weight > 0)[clear], expected[clear])
    assert 0.3 < np.asarray(result.weight).mean() < 0.7


def test_blended_labels_are_the_mean_of_the_photographs_that_see_most(capture):
    views, depths, closeup = capture
    _, depth, points = truth(closeup)
    # Photographs of one color each tell whose colors are in a label.
    levels = np.array([0.1, 0.2, 0.4, 0.8])
    flat = views.replace(rgb=jnp.broadcast_to(levels.reshape(-1, 1, 1, 1), views.rgb.shape) * 1.0)
    flat = flat.replace(rgb=flat.rgb.astype(jnp.float32))
    blank = depths.at[3].set(0)  # confirms nothing: never blended
    strict = settings(use_mask=0.0, depth_tolerance=0.02)
    alone = label(closeup, GRID, depth, 1, flat, blank, strict)
    several = label(
        closeup, GRID, depth, 1, flat, blank, strict.replace(num_sources=jnp.float32(9))
    )
    seen = np.stack(
        [label(closeup, GRID, depth, i, flat, blank, strict).weight > 0 for i in range(4)]
    )
    assert not seen[3].any()
    mean = (levels.reshape(-1, 1, 1) * seen).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    np.testing.assert_allclose(several.rgb[..., 0], mean, atol=1e-5)
    np.testing.assert_array_equal(several.weight > 0, seen.any(axis=0))
    np.testing.assert_allclose(np.asarray(alone.rgb[..., 0])[seen[1]], 0.2, atol=1e-6)
    # The second of two sources is the view that sees most under small angles.
    cosines = [
        rays_cosine(points, closeup, plane.camera_above(x, 0.1 * x, 4.0, tilt=0.1 * x))
        for x in POSITIONS
    ]
    second = 1 + int(np.argmax([(seen[i] * cosines[i]).sum() for i in (1, 2, 3)]))
    two = label(closeup, GRID, depth, 0, flat, blank, strict.replace(num_sources=jnp.float32(2)))
    both = seen[0] & seen[second]
    mean = (levels[0] + levels[second]) / 2
    np.testing.assert_allclose(np.asarray(two.rgb[..., 0])[both], mean, atol=1e-5)


def test_settings_of_the_contract_are_enough(capture):
    views, depths, closeup = capture
    _, depth, _ = truth(closeup)
    paper = PseudoSettings(
        PoseSettings(jnp.array([2.0, 8.0]), jnp.float32(0.5), jnp.float32(jnp.inf)),
        use_mask=jnp.float32(1),
        rgb_tolerance=jnp.float32(0.15),
        depth_tolerance=jnp.float32(jnp.inf),
    )
    by_default = label(closeup, GRID, depth, 1, views, depths, paper)
    spelt_out = label(closeup, GRID, depth, 1, views, depths, settings())
    np.testing.assert_array_equal(by_default.weight, spelt_out.weight)
    assert paper.label_loss_weight == 0.5


def test_undefined_depth_and_weightless_photographs_give_no_label(capture):
    views, depths, closeup = capture
    _, depth, _ = truth(closeup)
    for undefined in (0.0, -1.0, jnp.nan, jnp.inf):
        some = depth.at[:5].set(undefined)
        result = label(closeup, GRID, some, 1, views, depths, settings(use_mask=0.0))
        np.testing.assert_array_equal(result.weight[:5], 0)
        assert jnp.all(jnp.isfinite(result.rgb))
        assert result.weight[5:].mean() > 0.9
    blank = views.replace(weight=views.weight.at[1].set(0))
    result = label(closeup, GRID, depth, 1, blank, depths, settings(use_mask=0.0))
    np.testing.assert_array_equal(result.weight, 0)


def test_colors_do_not_mix_with_what_a_mask_leaves_out(capture):
    views, depths, closeup = capture
    _, depth, _ = truth(closeup)
    half = plane.WIDTH // 2
    gray = views.replace(rgb=jnp.full_like(views.rgb, 0.8))
    masked = gray.replace(rgb=gray.rgb.at[:, :, half:].set(0))
    masked = masked.replace(weight=masked.weight.at[:, :, half:].set(0))
    result = label(closeup, GRID, depth, 1, masked, depths, settings(use_mask=0.0))
    kept = np.asarray(result.weight) > 0
    assert 0.2 < kept.mean() < 0.8
    np.testing.assert_allclose(result.rgb[kept], 0.8, atol=1e-3)


def test_weights_of_64_bits_are_taken_beside_cameras_of_32(capture):
    views, depths, closeup = capture
    _, depth, _ = truth(closeup)
    expected = label(closeup, GRID, depth, 1, views, depths, settings())
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        double = views.replace(weight=jnp.asarray(np.asarray(views.weight), jnp.float64))
        found = label(closeup, GRID, depth, 1, double, depths, settings())
    np.testing.assert_allclose(found.rgb, expected.rgb, atol=1e-6)


def test_settings_stack_and_no_gradient_flows(capture):
    views, depths, closeup = capture
    _, depth, _ = truth(closeup)
    arms = jax.tree.map(lambda *leaves: jnp.stack(leaves), settings(), settings(use_mask=0.0))
    both = jax.jit(jax.vmap(make_label, (None,) * 6 + (0,)))(
        closeup, GRID, depth, 1, views, depths, arms
    )
    for arm, alone in enumerate((settings(), settings(use_mask=0.0))):
        expected = label(closeup, GRID, depth, 1, views, depths, alone)
        np.testing.assert_array_equal(both.weight[arm], expected.weight)

    def total(depth, closeup, views, depths):
        return jnp.sum(label(closeup, GRID, depth, 1, views, depths, settings()).rgb)

    of_all = jax.grad(total, argnums=(0, 1, 2, 3), allow_int=True)
    views = views.replace(rgb=jnp.asarray(views.rgb, jnp.float32))
    for gradient in jax.tree.leaves(of_all(depth, closeup, views, depths)):
        np.testing.assert_array_equal(gradient, 0)


def test_virtual_cameras_come_from_every_view_and_keep_to_their_anchors(capture):
    views, depths, _ = capture
    sample = jax.jit(jax.vmap(sample_virtual_camera, (0, None, None)))
    keys = jax.random.split(jax.random.key(0), 64)
    sources = label_sources(views, depths)
    cameras, index = sample(keys, sources, settings())
    assert set(np.asarray(index).tolist()) == {0, 1, 2, 3}
    heights = np.asarray(cameras.position)[:, 2]
    assert heights.min() > 4 / 8 - 1e-3  # the anchor is on the plane, 4 below the photographs
    assert heights.max() < 4 / 2 + 1e-3
    cameras, _ = sample(keys, sources, settings(fixed_anchors=1.0))
    ground = np.asarray(cameras.position)[:, :2]
    assert len(np.unique(np.round(ground, 1), axis=0)) > 4  # magnification still varies


def test_fixed_anchors_keep_out_of_what_weighs_nothing(capture):
    views, depths, _ = capture
    left = views.replace(weight=views.weight.at[:, :, plane.WIDTH // 2 :].set(0))
    sample = jax.jit(jax.vmap(sample_virtual_camera, (0, None, None)))
    keys = jax.random.split(jax.random.key(0), 64)
    cameras, index = sample(keys, label_sources(left, depths), settings(fixed_anchors=1.0))
    assert jnp.all(cameras.position[:, 0] < views.cameras.position[index, 0])


def test_best_source_sees_most_of_the_target(capture):
    views, depths, _ = capture
    for index, x in enumerate((-1.0, 0.0, 1.0)):
        target = plane.camera_above(x, 0.1 * x, 3.9, tilt=0.1 * x)
        assert best_source(target, views, depths) == index


def test_best_source_does_not_look_through_walls(capture):
    views, depths, _ = capture
    target = plane.camera_above(0.0, 0.0, 3.9)
    _, depth, _ = truth(target)
    assert best_source(target, views, depths, depth=jnp.asarray(depth, jnp.float32)) == 1
    # The same photograph, if it saw the plane's underside two units further down.
    behind = depths.at[1].multiply(1.5)
    assert best_source(target, views, behind) == 1
    assert best_source(target, views, behind, depth=jnp.asarray(depth, jnp.float32)) != 1


def test_target_views_may_have_the_published_source(capture):
    views, depths, _ = capture
    behind = depths.at[1].multiply(1.5)  # as above: most of its pixels land, of hidden points
    stacked, exact = plane.make_views([plane.camera_above(0.0, 0.0, 3.9)])
    label_all, sources = jax.jit(label_views), label_sources(views, behind)
    seen = [
        label_all(stacked.cameras, exact, sources, settings(use_mask=0.0, **changed)).rgb
        for changed in ({}, {"source_tolerance": jnp.inf})
    ]
    camera = jax.tree.map(lambda leaf: leaf[0], stacked.cameras)
    for rgb, given in zip(seen, (exact[0], None), strict=True):
        source = best_source(camera, views, behind, depth=given)
        alone = label(camera, GRID, exact[0], source, views, behind, settings(use_mask=0.0))
        np.testing.assert_allclose(rgb[0], alone.rgb, atol=1e-6)
    assert np.abs(seen[0] - seen[1]).max() > 0.01


def test_target_views_are_labeled_from_their_best_source(capture):
    views, depths, closeup = capture
    targets = [closeup, plane.camera_above(-0.9, 0.0, 2.0)]
    stacked, exact = plane.make_views(targets)
    labels = label_views(stacked.cameras, exact, label_sources(views, depths), settings())
    assert labels.rgb.shape == stacked.rgb.shape
    for i, camera in enumerate(targets):
        source = best_source(camera, views, depths, depth=exact[i])
        alone = label(camera, GRID, exact[i], source, views, depths, settings())
        np.testing.assert_allclose(labels.rgb[i], alone.rgb, atol=1e-6)
        np.testing.assert_array_equal(labels.weight[i], alone.weight)
        kept = np.asarray(labels.weight[i]) > 0
        assert kept.mean() > 0.2
        np.testing.assert_allclose(labels.rgb[i][kept], stacked.rgb[i][kept], atol=0.03)
