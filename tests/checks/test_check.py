"""Captures that do not fit their photographs are noticed, named and corrected."""

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest
from textured_corner import HEIGHT, LENS, WIDTH, draw, poses, project, write_corner, write_points

from jaxcloseup.captures.contents import list_photographs
from jaxcloseup.captures.corrections import correct_frames
from jaxcloseup.captures.load import load_scene
from jaxcloseup.captures.photo import Reading
from jaxcloseup.captures.world_frames import frame_intrinsics
from jaxcloseup.checks.check import check_capture
from jaxcloseup.checks.epipolar import Cameras
from jaxcloseup.checks.evidence import gather
from jaxcloseup.checks.judge import judge
from jaxcloseup.checks.order import find_order
from jaxcloseup.photos.scene import SceneError


FLIP = np.diag([1.0, -1, -1, 1])


@pytest.fixture(scope="session")
def corner(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corner") / "capture"
    write_corner(folder)
    return folder


@pytest.fixture(scope="session")
def evidence(corner):
    return gather(list_photographs(corner).frames, Reading())


@pytest.fixture(scope="session")
def judged(evidence):
    """A function that judges a folder with the same photographs, which are not matched anew."""

    def check(folder, corrections=()):
        listed = list_photographs(folder, corrections=corrections)
        lenses = [frame_intrinsics(frame, WIDTH, HEIGHT) for frame in listed.frames]
        scales = [WIDTH / (frame.size or (WIDTH,))[0] for frame in listed.frames]
        cameras = evidence.cameras._replace(
            camtoworld=np.stack([frame.camtoworld for frame in listed.frames]),
            intrinsics=np.stack(lenses) * np.array(scales)[:, None],
        )
        return judge(evidence._replace(cameras=cameras), listed.points, opengl=True)

    return check


@pytest.fixture
def copy(corner, tmp_path):
    """A copy of the capture, and a function that changes its fields."""
    folder = shutil.copytree(corner, tmp_path / "copy")

    def change(edit):
        fields = json.loads((folder / "transforms.json").read_text())
        edit(fields)
        (folder / "transforms.json").write_text(json.dumps(fields))
        return folder

    return change


def each_matrix(function):
    def edit(fields):
        for frame in fields["frames"]:
            frame["transform_matrix"] = function(np.array(frame["transform_matrix"])).tolist()

    return edit


@pytest.mark.parametrize("seed", range(3))
def test_any_order_of_poses_is_found(evidence, seed):
    order = np.random.default_rng(seed).permutation(len(evidence.names))
    mixed = evidence.cameras._replace(camtoworld=evidence.cameras.camtoworld[order])
    found = find_order(evidence.matches, mixed)
    np.testing.assert_array_equal(order[found], np.arange(len(order)))
    assert find_order(evidence.matches, evidence.cameras) is None


def test_a_right_capture_fits(evidence, corner):
    found = judge(evidence, list_photographs(corner).points, opengl=True)
    assert (found.verdict, found.corrections, found.points) == ("fits", (), ())
    assert "poses fit: 0." in found.sentence and "points fit" in found.sentence
    assert check_capture(corner) == check_capture(corner) == dataclasses.replace(found)


KEYS = ("fl_x", "fl_y", "cx", "cy")
MISTAKES = {
    "axes": (each_matrix(lambda matrix: matrix @ FLIP), ("axes",)),
    "inverse": (each_matrix(np.linalg.inv), ("inverse",)),
    "opencv w2c": (each_matrix(lambda matrix: np.linalg.inv(matrix @ FLIP)), ("inverse", "axes")),
    "size": (
        lambda fields: fields.update(
            {key: 2 * fields[key] for key in ("fl_x", "fl_y", "cx", "cy")}
        ),
        ("size=2",),
    ),
    "stale size": (lambda fields: fields.update(w=2 * WIDTH, h=2 * HEIGHT), ("size=0.5",)),
    "reverse": (
        lambda fields: [
            frame.update(transform_matrix=pose)
            for frame, pose in zip(
                fields["frames"],
                [frame["transform_matrix"] for frame in fields["frames"]][::-1],
                strict=True,
            )
        ],
        ("order=11,10,9,8,7,6,5,4,3,2,1,0",),
    ),
}


@pytest.mark.filterwarnings("ignore::jaxcloseup.photos.scene.ImageSizeWarning")
@pytest.mark.parametrize(("edit", "corrections"), MISTAKES.values(), ids=MISTAKES)
def test_known_mistakes_are_named_and_corrected(copy, corner, judged, edit, corrections):
    folder = copy(edit)
    found = judged(folder)
    assert (found.verdict, found.corrections) == ("misfit", corrections)
    mended, right = (
        list_photographs(path, corrections=fixes).frames
        for path, fixes in ((folder, corrections), (corner, ()))
    )
    for a, b in zip(mended, right, strict=True):
        np.testing.assert_allclose(a.camtoworld, b.camtoworld, atol=1e-9)
    assert judged(folder, corrections).verdict == "fits"
    scene = load_scene(folder, corrections=corrections)
    expected = load_scene(corner).train.cameras
    np.testing.assert_allclose(scene.train.cameras.intrinsics, expected.intrinsics, rtol=1e-5)
    np.testing.assert_allclose(scene.train.cameras.camtoworld, expected.camtoworld, atol=1e-4)


def test_turned_photographs_are_turned_back(copy, corner):
    folder = copy(lambda fields: None)
    for path in (folder / "images").iterdir():
        cv2.imwrite(str(path), np.rot90(cv2.imread(str(path)), 3).copy())
    found = check_capture(folder)
    assert (found.verdict, found.corrections) == ("misfit", ("turn=1",))
    scene, right = load_scene(folder, corrections=["turn=1"]), load_scene(corner)
    np.testing.assert_array_equal(scene.train.rgb, right.train.rgb)


def test_cropped_photographs_have_another_principal_point(copy):
    folder = copy(lambda fields: None)
    for path in (folder / "images").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path))[:, 60:])
    found = check_capture(folder)
    assert found.verdict == "misfit"
    (correction,) = found.corrections
    name, _, value = correction.partition("=")
    moved = np.array([float(x) for x in value.split(",")])
    np.testing.assert_allclose(moved * [WIDTH - 60, HEIGHT], [-60, 0], atol=3)
    frames = list_photographs(folder, corrections=found.corrections).frames
    assert name == "center" and frames[0].lens[0]["cx"] == pytest.approx(WIDTH / 2 - 60, abs=3)


def test_noise_is_no_known_mistake(evidence, corner):
    rng = np.random.default_rng(0)
    turned = evidence.cameras.camtoworld.copy()
    turned[:, :, 3] += rng.normal(scale=0.3, size=turned[:, :, 3].shape)
    found = judge(
        evidence._replace(cameras=evidence.cameras._replace(camtoworld=turned)),
        list_photographs(corner).points,
        opengl=True,
    )
    assert found.verdict == "misfit" and not found.corrections
    assert "no known mistake" in found.sentence


def test_exchanged_photographs_are_named(evidence):
    order = np.arange(len(evidence.names))
    order[[2, 8]] = 8, 2
    cameras = evidence.cameras._replace(camtoworld=evidence.cameras.camtoworld[order])
    found = judge(evidence._replace(cameras=cameras), np.zeros((0, 3)), opengl=True)
    assert "the poses of 02.png and 08.png are exchanged" in found.sentence


@pytest.mark.parametrize(
    ("change", "instead"),
    [
        (lambda points: points[:, [1, 2, 0]] * [1, -1, -1], None),
        (lambda points: np.random.default_rng(0).uniform(0, 3, points.shape), ("points=none",)),
        (lambda points: points + np.array([0, 0, 50]), ("points=none",)),  # where nobody looks
    ],
)
def test_points_in_another_world_are_found(copy, corner, judged, change, instead):
    folder = copy(lambda fields: None)
    points = list_photographs(corner).points
    write_points(folder, change(points))
    found = judged(folder)
    assert found.verdict == "fits"
    if instead is None:
        mended = list_photographs(folder, corrections=found.points).points
        np.testing.assert_allclose(mended, points, atol=1e-6)
    else:
        assert found.points == instead
        assert not len(list_photographs(folder, corrections=instead).points)


def test_photographs_without_features_are_not_judged(tmp_path):
    write_corner(tmp_path / "flat")
    for path in (tmp_path / "flat/images").iterdir():
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    found = check_capture(tmp_path / "flat")
    assert found.verdict == "unknown" and "not checked" in found.sentence
    assert any("are constant" in note for note in found.notes)


def test_photographs_from_one_place_are_noticed(evidence, corner, tmp_path):
    """A camera that turns on the spot says nothing of depth, and its poses fit."""
    turning = poses()[3:8]
    turning[:, :, 3] = turning[0, :, 3]
    write_corner(tmp_path / "spot", turning)
    found = check_capture(tmp_path / "spot")
    assert found.verdict == "fits"
    assert any("move by at most 0.0 degrees" in note for note in found.notes)
    whole = judge(evidence, list_photographs(corner).points, opengl=True)
    assert not any("more places" in note for note in whole.notes)


def test_dark_and_blurred_photographs_are_named(copy):
    folder = copy(lambda fields: None)
    for name, change in (
        ("03", lambda image: cv2.GaussianBlur(image, None, 4)),
        ("07", lambda image: (0.6 * image).astype(np.uint8)),
    ):
        path = folder / f"images/{name}.png"
        cv2.imwrite(str(path), change(cv2.imread(str(path))))
    notes = " ".join(check_capture(folder).notes)
    assert "1 of 12 photographs are blurred beside the others: 03.png" in notes
    assert "exposure differs 1.7 times between photographs, from 07.png" in notes


def test_unknown_corrections_are_refused(corner):
    frames = list_photographs(corner).frames
    for wrong in ("mirror", "size=x", "center=1", "order=0,99"):
        with pytest.raises(SceneError, match=f"correction {wrong!r} is unknown"):
            correct_frames(frames, [wrong], opengl=True)


def test_drawn_corner_shows_what_it_says():
    """The capture of these tests itself: a pixel's point projects to this pixel."""
    _, points = draw(poses()[3])
    cameras = Cameras(poses(), np.tile(LENS, (12, 1)), np.tile([WIDTH, HEIGHT], (12, 1)))
    found = project(points[100, 40][None], cameras, 3)
    np.testing.assert_allclose(found[0], [40.5, 100.5], atol=1e-6)


def test_a_repeated_pattern_is_no_misfit(corner, evidence):
    """Most matches of each pair are a period off; the rest tell right poses from wrong ones."""
    points, found = list_photographs(corner).points, evidence.matches
    wrong = np.arange(len(found.views)) % 5 > 1  # three of five
    pixels = found.pixels.copy()
    pixels[wrong, 1] += (60, 45)
    repeated = evidence._replace(matches=found._replace(pixels=pixels))
    checked = judge(repeated, points, opengl=True)
    assert checked.verdict == "fits"
    assert "poses fit: 0." in checked.sentence and "as where a pattern repeats" in checked.sentence
    cameras, rng = evidence.cameras, np.random.default_rng(0)
    for pixel in (3, 30):  # turned at random by so many pixels
        turned = cameras.camtoworld.copy()
        for pose in turned:
            pose[:, :3] @= cv2.Rodrigues(rng.normal(scale=pixel / LENS[0], size=3))[0]
        other = repeated._replace(cameras=cameras._replace(camtoworld=turned))
        assert judge(other, points, opengl=True).verdict == "misfit"
