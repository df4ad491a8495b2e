"""Multi-view stereo against NumPy in float64, and on walls drawn by ray casting."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import textured_corner
from textured_corner import SMALL, SMALL_LENS, corner_views

from jaxcloseup.geometry.cameras import pixel_grid
from jaxcloseup.native import library
from jaxcloseup.photos.views import camera_at
from jaxcloseup.stereo import (
    StereoConfig,
    choose_neighbors,
    count_consistent,
    estimate_depths,
    match_planes,
    pack_photographs,
    plane_normals,
    relative_transforms,
)


WIDTH, HEIGHT = SMALL
LENS = SMALL_LENS
CONFIG = StereoConfig(neighbors=4, best=2, levels=2, sweep=24, iterations=(3, 2))
needs_library = pytest.mark.skipif(
    not library.available(), reason="there is no native library, and loops take minutes"
)


def test_patches_lie_about_their_center():
    assert StereoConfig(radius=6, stride=3).stride == 3
    for radius, stride in ((4, 3), (12, 1)):  # one aside, one with 25 samples a side
        with pytest.raises(ValueError, match=f"^stride {stride} must divide twice the radius"):
            StereoConfig(radius=radius, stride=stride)


def exact_planes(views, points):
    """Depths `[V, H, W]` and planes `[V, 3, H, W]` of points, by differences in float64."""
    poses = np.asarray(views.cameras.camtoworld, np.float64)
    local = np.einsum("vhwc,vck->vhwk", points - poses[:, None, None, :, 3], poses[..., :3])
    inverse = 1 / local[..., 2]
    along_y, along_x = np.gradient(inverse, axis=(1, 2))
    return local[..., 2], np.stack([inverse, along_x, along_y], axis=1)


def to_other(camera, other, pixel, inverse):
    """Project a pixel with an inverse depth into another camera, in float64."""
    (pose, lens), (there, their_lens) = (
        (np.asarray(of.camtoworld, np.float64), np.asarray(of.intrinsics, np.float64))
        for of in (camera, other)
    )
    ray = np.append((pixel - lens[2:]) / lens[:2], 1)
    x, y, z = there[:, :3].T @ (pose[:, :3] @ ray / inverse + pose[:, 3] - there[:, 3])
    return np.array([x, y]) / z * their_lens[:2] + their_lens[2:], z


def test_a_plane_carries_pixels_as_its_homography_does():
    """K (R + t n / d) K^-1, of the plane n X = d in the first camera's frame."""
    views, _ = corner_views(2)
    camera, other = (camera_at(views.cameras, i) for i in range(2))
    pose, there = (np.asarray(of.camtoworld, np.float64) for of in (camera, other))
    normal, distance = np.array([0.3, -0.2, -0.9]), -2.5
    turn = there[:, :3].T @ pose[:, :3]
    move = there[:, :3].T @ (pose[:, 3] - there[:, 3])
    lens = np.array([[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1]])
    homography = lens @ (turn + np.outer(move, normal) / distance) @ np.linalg.inv(lens)
    # Inverse depth is n . ray / d.
    slopes = normal @ np.linalg.inv(lens) / distance
    pixels = np.asarray(pixel_grid(HEIGHT, WIDTH), np.float64)
    ends = np.concatenate([pixels, np.ones((HEIGHT, WIDTH, 1))], axis=-1)
    inverse = ends @ slopes
    expected = ends @ homography.T
    matrix, offset = relative_transforms(camera, jax.tree.map(lambda leaf: leaf[None], other))
    found = ends @ np.asarray(matrix[0]).T + inverse[..., None] * np.asarray(offset[0])
    np.testing.assert_allclose(
        found[..., :2] / found[..., 2:], expected[..., :2] / expected[..., 2:], atol=1e-3
    )
    planes = np.stack([inverse, *(np.full_like(inverse, slope) for slope in slopes[:2])])
    normals = plane_normals(camera, pixel_grid(HEIGHT, WIDTH), jnp.asarray(planes, jnp.float32))
    world = pose[:, :3] @ normal / np.linalg.norm(normal)
    np.testing.assert_allclose(normals, np.broadcast_to(world, normals.shape), atol=1e-5)


def slow_cost(views, gray, pixel, plane, neighbors, config):
    """The mean of the best costs at one pixel (row, column), sample by sample."""
    row, column = pixel
    camera, counts = camera_at(views.cameras, 0), np.asarray(views.weight[0]) > 0
    steps = range(-config.radius, config.radius + 1, config.stride)
    center = np.array([column + 0.5, row + 0.5])
    costs = []
    for neighbor in neighbors:
        other = camera_at(views.cameras, neighbor)
        landed, ahead = to_other(camera, other, center, plane[0])
        shown = ahead > 0 and plane[0] > 0 and neighbor >= 0
        if not shown or not np.all((landed >= 0) & (landed < (WIDTH, HEIGHT))):
            costs.append(1.0)
            continue
        own, theirs, weights = [], [], []
        for dy in steps:
            for dx in steps:
                at = np.clip(row + dy, 0, HEIGHT - 1), np.clip(column + dx, 0, WIDTH - 1)
                apart = (gray[0][at] - gray[0][row, column]) / config.gray_sigma
                far = (dx * dx + dy * dy) / (2 * config.radius**2)
                weights.append(np.exp(-(apart**2) - far) * counts[at])
                own.append(gray[0][at])
                inverse = plane[0] + dx * plane[1] + dy * plane[2]
                there, _ = to_other(camera, other, center + np.array([dx, dy]), inverse)
                x, y = np.clip(there - 0.5, 0, (WIDTH - 1, HEIGHT - 1))
                left, top = int(x), int(y)
                square = np.pad(gray[neighbor], (0, 1), mode="edge")[top : top + 2, left : left + 2]
                theirs.append(np.array([1 + top - y, y - top]) @ square @ [1 + left - x, x - left])
        share = np.array(weights) / max(np.sum(weights), 1e-12)
        own, theirs = (np.array(grays) - share @ grays for grays in (own, theirs))
        variances = (share @ own**2 + config.noise) * (share @ theirs**2 + config.noise)
        costs.append(min(1 - share @ (own * theirs) / np.sqrt(variances), 1))
    missing = [1.0] * config.best
    return np.mean(sorted([*costs, *missing])[: config.best])


@pytest.mark.parametrize("native", [False, pytest.param(True, marks=needs_library)])
@pytest.mark.parametrize("neighbors", [[1, 2, 3, 4], [2, -1], [3]])
def test_costs_are_those_of_a_slow_loop(neighbors, native):
    views, points = corner_views()
    views = views.replace(weight=views.weight.at[0, :, :9].set(0))
    gray = np.round(np.asarray(views.rgb, np.float64).mean(-1))
    _, planes = exact_planes(views, points)
    # Right, too near, tilted, and behind the camera.
    tried = np.stack([planes[0] * factor for factor in (1, 1.1, -1)] + [planes[0]])
    tried[3, 1] += 0.004
    photographs = pack_photographs(views.cameras, jnp.asarray(gray, jnp.float32), views.weight)
    found = match_planes(
        *(photographs, jnp.int32(0), jnp.array(neighbors, jnp.int32)),
        *(jnp.asarray(tried, jnp.float32), CONFIG),
        native=native,
    )
    for pixel in ((0, 0), (18, 10), (20, 30), (35, 47), (12, 25), (30, 8)):
        for plane, costs in zip(tried[:, :, *pixel], np.asarray(found), strict=True):
            slow = slow_cost(views, gray, pixel, plane, neighbors, CONFIG)
            assert costs[pixel] == pytest.approx(slow, abs=2e-3)
    assert np.asarray(found[2]).min() == 1 and np.median(found[0]) < np.median(found[1])


@needs_library
@pytest.mark.parametrize("platform", ["cpu", "cuda"])
def test_only_programs_for_cpus_call_the_library(platform):
    views, _ = corner_views(4)
    match = jax.jit(functools.partial(estimate_depths, config=CONFIG))
    traced = match.trace(jax.random.key(0), views, jnp.array([[1, 2, 3]] * 4), 1.0, 9.0)
    program = traced.lower(lowering_platforms=(platform,)).as_text()
    assert ("jaxcloseup_stereo" in program) == (platform == "cpu")


def test_consistency_is_that_of_a_slow_loop():
    views, points = corner_views(4)
    rng = np.random.default_rng(0)
    _, planes = exact_planes(views, points)
    planes[:, :1] *= 1 + 0.01 * rng.normal(size=(4, 1, HEIGHT, WIDTH))
    planes[:, :, 5:9, 7:20] = 0
    neighbors, camera = [2, -1, 1], camera_at(views.cameras, 0)
    found = count_consistent(
        *(views.cameras, jnp.asarray(planes, jnp.float32), jnp.int32(0)),
        *(jnp.array(neighbors, jnp.int32), CONFIG),
    )
    different = 0
    for row in range(0, HEIGHT, 3):
        for column in range(0, WIDTH, 5):
            inverse, count = planes[0, 0, row, column], 0
            for neighbor in neighbors if inverse > 0 else []:
                other, pixel = camera_at(views.cameras, neighbor), np.array([column, row]) + 0.5
                (x, y), ahead = to_other(camera, other, pixel, inverse)
                if neighbor < 0 or ahead <= 0 or not (0 <= x < WIDTH and 0 <= y < HEIGHT):
                    continue
                plane = planes[neighbor, :, int(y), int(x)]
                at = np.array([x - int(x) - 0.5, y - int(y) - 0.5])
                observed = plane[0] + plane[1:] @ at
                if plane[0] <= 0 or observed <= 0:
                    continue
                back, _ = to_other(other, camera, np.array([x, y]), observed)
                # Where the ray crosses the neighbor's plane, by bisection.
                low, high = 0.5 * inverse, 2 * inverse
                for _ in range(40):
                    middle = (low + high) / 2
                    there, z = to_other(camera, other, pixel, middle)
                    ahead_of = 1 / z < plane[0] + plane[1:] @ (there - [int(x) + 0.5, int(y) + 0.5])
                    low, high = (middle, high) if ahead_of else (low, middle)
                near = abs(low / inverse - 1) <= CONFIG.depth_tolerance
                count += near and np.linalg.norm(back - pixel) < CONFIG.pixel_tolerance
            different += count != int(found.count[row, column])
    assert different <= 2  # at the very limits
    assert {0, 1, 2} == set(np.unique(found.count))


def test_two_photographs_away_from_each_other_are_no_neighbors():
    views, _ = corner_views()
    turned = views.cameras.camtoworld.at[1, :, ::2].multiply(-1)
    cameras = views.cameras.replace(camtoworld=turned.at[1, :, 3].set([9.0, 9.0, 9.0]))
    for points in (None, np.random.default_rng(0).uniform(0, 1, (300, 3))):
        found = choose_neighbors(cameras, 2.0, 6.0, CONFIG, points)
        assert (found[1] == -1).all() and not (found == 1).any()
        for view in (0, 2, 3, 4):
            chosen = found[view][found[view] >= 0]
            assert len(chosen) == len(set(chosen)) == 3 and view not in chosen


@needs_library
def test_depth_of_drawn_walls_is_found_and_repeats_to_the_last_bit():
    views, points = corner_views()
    views = views.replace(weight=views.weight.at[0, :6].set(0))
    depth, _ = exact_planes(views, points)
    neighbors = jnp.asarray(choose_neighbors(views.cameras, 1.0, 20.0, CONFIG))
    estimate = jax.jit(estimate_depths, static_argnames="config")
    maps = estimate(jax.random.key(0), views, neighbors, 1.0, 20.0, config=CONFIG)
    again = estimate(jax.random.key(0), views, neighbors, 1.0, 20.0, config=CONFIG)
    for own, other in zip(maps, again, strict=True):
        assert (np.asarray(own) == np.asarray(other)).all()
    confident = np.asarray(maps.confidence) > 0
    error = np.abs(np.asarray(maps.depth) / depth - 1)[confident]
    assert not confident[0, :6].any() and confident.mean() > 0.6
    assert np.median(error) < 2e-3 and np.mean(error < 0.01) > 0.95
    # Normals are those of the walls, beside their edges.
    wall = np.abs(points @ textured_corner.WALLS.T - textured_corner.OFFSETS).argmin(-1)
    normals = textured_corner.WALLS / np.linalg.norm(textured_corner.WALLS, axis=1, keepdims=True)
    cosine = np.abs(np.sum(np.asarray(maps.normal) * normals[wall], axis=-1))[confident]
    assert np.median(cosine) > np.cos(np.deg2rad(8))


def test_a_photograph_without_neighbors_has_no_confidence():
    views, _ = corner_views(2)
    config = dataclasses.replace(CONFIG, levels=1, iterations=(1,), sweep=2)
    none = jnp.full((2, 1), -1, jnp.int32)
    maps = estimate_depths(jax.random.key(0), views, none, 1.0, 20.0, config)
    assert not np.asarray(maps.confidence).any() and np.isfinite(np.asarray(maps.depth)).all()


def test_colors_above_white_are_white():
    """A bright photograph at the middle exposure has some."""
    views, _ = corner_views()
    gray = jnp.full(views.weight.shape, 306.0)
    quads = pack_photographs(views.cameras, gray, views.weight).quads
    assert quads.dtype == jnp.uint32 and (np.asarray(quads) == 0xFFFFFFFF).all()
