"""Epipolar errors of matches, against projections of all depths."""

import numpy as np
import pytest
from textured_corner import HEIGHT, LENS, WIDTH, poses, project

from jaxcloseup.checks.epipolar import Cameras, capture_parallax, epipolar_errors, fit
from jaxcloseup.checks.matches import Matches


def seen_together(count=60):
    """World points and cameras, with matches that are exact."""
    rng = np.random.default_rng(1)
    cameras = Cameras(poses(4), np.tile(LENS, (4, 1)), np.tile([WIDTH, HEIGHT], (4, 1)))
    points = rng.uniform(0, 1.5, (count, 3))
    views, pixels = [], []
    for i in range(4):
        for j in range(i):
            views.append(np.tile([i, j], (count, 1)))
            pixels.append(np.stack([project(points, cameras, view) for view in (i, j)], 1))
    views, pixels = np.concatenate(views), np.concatenate(pixels)
    return Matches(views, pixels, np.zeros((len(views), 2, 3), np.uint8)), cameras


def test_epipolar_errors_are_distances_from_what_any_depth_shows():
    """The witness projects all depths of one camera's ray into the other, and conversely."""
    matches, cameras = seen_together()
    assert epipolar_errors(matches, cameras).max() < 1e-6
    rng = np.random.default_rng(2)
    moved = matches._replace(pixels=matches.pixels + rng.normal(scale=4, size=matches.pixels.shape))
    found = epipolar_errors(moved, cameras)
    depths = np.geomspace(0.05, 1e4, 40_000)
    for row in range(0, len(found), 37):
        errors = []
        for a, b in ((0, 1), (1, 0)):
            pose, lens = (x[moved.views[row, a]] for x in (cameras.camtoworld, cameras.intrinsics))
            local = np.append((moved.pixels[row, a] - lens[2:]) / lens[:2], 1)
            along = pose[:, 3] + depths[:, None] * (pose[:, :3] @ local)
            inside = project(along, cameras, moved.views[row, b])
            errors.append(np.linalg.norm(inside - moved.pixels[row, b], axis=1).min())
        # Angles times pixels at the radius: exact on the axis, within the lens's cosine elsewhere.
        assert found[row] == pytest.approx(np.mean(errors), rel=0.3, abs=0.05)


def test_points_behind_a_camera_do_not_fit():
    """A camera that looks away sees nothing, though epipolar lines are the same."""
    matches, cameras = seen_together()
    behind = cameras._replace(camtoworld=cameras.camtoworld * np.array([-1, 1, -1, 1]))
    assert fit(matches, behind).share < 0.05


def test_parallax_is_the_angle_at_surfaces_between_the_farthest_cameras():
    """A feature straight ahead of the middle of five cameras in a row, matched between neighbors.

    One pair that does not fit, and one without a distance, do not count.
    """
    places = np.array([-2.0, -1, 0, 1, 2])
    poses = np.tile(np.eye(3, 4), (5, 1, 1))
    poses[:, 0, 3] = places / 10
    cameras = Cameras(poses, np.tile(LENS, (5, 1)), np.tile([WIDTH, HEIGHT], (5, 1)))
    views = np.array([[1, 2], [2, 3], [3, 4], [0, 1]])
    seen = [project(np.array([[0.0, 0, 4]]), cameras, view)[0] for view in range(5)]
    pixels = np.array(seen)[views]
    pixels[3] += np.array([[0, 0], [30, 30]])
    matches = Matches(views, pixels, np.zeros((4, 2, 3), np.uint8))
    expected = 2 * np.degrees(np.arctan(0.2 / 4))
    assert capture_parallax(matches, cameras) == pytest.approx(expected, rel=0.01)
    poses[:, 0, 3] = 0
    assert capture_parallax(matches, cameras) == 0


@pytest.mark.parametrize(("pairs", "judged"), [(3, True), (2, False)])
def test_a_photograph_is_judged_by_three_pairs(pairs, judged):
    """Two pairs may both be of a pattern that repeats, and lie anywhere."""
    matches, cameras = seen_together()
    last = (matches.views == 3).any(1)
    pixels = np.where(last[:, None, None], matches.pixels[:, ::-1], matches.pixels)
    kept = ~last | (matches.views[:, 1] < pairs)
    found = fit(matches._replace(pixels=pixels).take(kept), cameras)
    np.testing.assert_array_equal(np.isfinite(found.by_best), [True, True, judged, judged])
    assert found.by_best[0] == 1 and not found.precise[3]
    assert not judged or found.by_best[3] < 0.3
