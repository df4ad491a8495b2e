"""The zoom ladder on the plane z = 0: cameras that move nearer to one point."""

import dataclasses
import xml.etree.ElementTree as ET

import jax.numpy as jnp
import numpy as np
import plane
import pytest

from jaxcloseup.app.report.plots import Curve, gains_over, line_plot, zoom_curves
from jaxcloseup.app.score.ladder import MAGNIFICATIONS, describe_ladder, ladder_targets
from jaxcloseup.geometry.cameras import pixels_to_points, points_to_pixels
from jaxcloseup.photos.views import camera_at


@pytest.fixture(scope="module")
def ladder():
    cameras = [plane.camera_above(x, 0.1 * x, 4.0, tilt=0.1 * x) for x in (-1.0, 0.0, 1.0)]
    far = [plane.camera_above(0.3, 0.0, 4.0), plane.camera_above(0, 0.2, 3.5)]
    scene, _ = plane.make_scene(cameras, far)
    exact = jnp.stack([plane.surface(camera).depth for camera in cameras])
    return scene, ladder_targets(scene, exact)


def test_each_rung_is_magnification_times_nearer_to_one_point(ladder):
    scene, targets = ladder
    assert list(targets) == [f"zoom_{m:g}" for m in MAGNIFICATIONS]
    for i, name in enumerate(scene.names["test_far"]):
        nearer = [m for m in MAGNIFICATIONS if m >= 1]
        centers = np.stack([targets[f"zoom_{m:g}"][i].camera.position for m in nearer])
        assert targets["zoom_1"][i].name == name
        np.testing.assert_allclose(centers[0], scene.test_far.cameras.position[i], atol=1e-6)
        # All cameras stand on one line, which meets the plane at the anchor.
        anchor = centers[0] + (centers[1] - centers[0]) * 2
        np.testing.assert_allclose(anchor[2], 0, atol=1e-5)
        for m, center in zip(nearer, centers, strict=True):
            np.testing.assert_allclose(anchor - center, (anchor - centers[0]) / m, atol=1e-5)
            np.testing.assert_array_equal(
                targets[f"zoom_{m:g}"][i].camera.rotation, scene.test_far.cameras.rotation[i]
            )


def test_the_rung_below_1_sees_twice_as_far_to_each_side(ladder):
    scene, targets = ladder
    for i, target in enumerate(targets["zoom_0.5"]):
        view, camera = camera_at(scene.test_far.cameras, i), target.camera
        np.testing.assert_array_equal(camera.camtoworld, view.camtoworld)
        # A point that the view has at some offset from its center lies at half of it.
        center = np.asarray(view.intrinsics[2:])
        pixels = np.array([[3.0, 2.0], [20.0, 9.0]], np.float32)
        points = pixels_to_points(view, pixels, np.float32([2.0, 3.0]))
        seen, _ = points_to_pixels(camera, points)
        np.testing.assert_allclose(np.asarray(seen) - center, (pixels - center) / 2, atol=1e-4)


def test_targets_hold_the_exact_surface(ladder):
    _, targets = ladder
    for rung in targets.values():
        for target in rung:
            np.testing.assert_allclose(
                target.surface.depth, plane.surface(target.camera).depth, rtol=1e-5
            )
            assert target.seen.max() == 3


def test_a_capture_has_no_ladder(ladder):
    scene, _ = ladder
    assert ladder_targets(dataclasses.replace(scene, surface=None), jnp.zeros((3, 4, 5))) == {}


def test_curves_and_gains():
    def splits(*psnr):
        return {"test": {"psnr": 1.0}} | {
            f"zoom_{m:g}": {"psnr": value} for m, value in zip((1, 4, 16), psnr, strict=True)
        }

    stages = {"control": splits(30.0, 25.0, None), "closeup": splits(29.5, 26.0, 20.0)}
    curves = zoom_curves(stages)
    assert curves == [
        Curve("control", [1, 4], [30.0, 25.0]),
        Curve("closeup", [1, 4, 16], [29.5, 26.0, 20.0]),
    ]
    assert gains_over(curves, "control")[1] == Curve("closeup", [1, 4], [-0.5, 1.0])
    assert gains_over(curves[1:], "control") == []
    assert describe_ladder(stages["control"]).endswith("4x 25.00, 16x -")


def test_a_plot_is_one_svg_element_with_its_labels():
    curves = [Curve("arm & leg", [1, 2], [0.0, 1.0], [-1.0, 0.5], [1.0, 1.5])]
    plot = line_plot(curves, x="times nearer", y="dB", title="Gain", doubling=True, level=0)
    root = ET.fromstring(plot)
    assert root.tag.endswith("svg")
    words = {element.text for element in root.iter() if element.text}
    assert {"arm & leg", "times nearer", "dB", "Gain"} <= words
    assert plot == line_plot(curves, x="times nearer", y="dB", title="Gain", doubling=True, level=0)
