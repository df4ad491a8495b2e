import jax
import numpy as np
import pytest
from tiny_capture import POSE, write_image, write_json

from jaxcloseup.app.view.camera_paths import CameraError
from jaxcloseup.app.view.photograph_pixels import file_pixel, pinhole_pixel
from jaxcloseup.captures.distortion import (
    from_pinhole,
    read_distortion,
    to_pinhole,
    undistort,
    undistortion_map,
)
from jaxcloseup.captures.load import load_scene


WIDTH, HEIGHT = 60, 44
INTRINSICS = (50.0, 46.0, 31.3, 20.4)
LENSES = {
    "RADIAL": {"k1": -0.15, "k2": 0.02},
    "OPENCV": {"k1": 0.08, "k2": -0.03, "p1": 0.02, "p2": -0.015, "k3": 0.01},
    "FULL_OPENCV": {
        "k1": -0.1,
        "k2": 0.1,
        "p1": 0.01,
        "p2": 0.0,
        "k3": 0.05,
        "k4": 0.3,
        "k6": 0.02,
    },
    "OPENCV_FISHEYE": {"k1": 0.05, "k2": -0.02, "k3": 0.004, "k4": -0.001},
    "FISHEYE": {},
}


def bend(x, y, model, coefficients):
    """Distort a ray (x, y, 1) to the image plane, in focal lengths; the formulas written out."""
    k1, k2, k3, k4, k5, k6, p1, p2 = (
        coefficients.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
    )
    r = np.sqrt(x**2 + y**2)
    if "FISHEYE" in model:
        angle = np.arctan(r)
        bent = angle + k1 * angle**3 + k2 * angle**5 + k3 * angle**7 + k4 * angle**9
        scale = bent / np.maximum(r, 1e-12)
        return x * scale, y * scale
    scale = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    return (
        x * scale + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
        y * scale + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
    )


def straighten(u, v, model, coefficients):
    """Invert `bend` by fixed-point iteration."""
    x, y = np.zeros_like(u), np.zeros_like(v)
    for _ in range(400):
        bent_x, bent_y = bend(x, y, model, coefficients)
        x, y = x + 0.5 * (u - bent_x), y + 0.5 * (v - bent_y)
    np.testing.assert_allclose(bend(x, y, model, coefficients), (u, v), atol=1e-9)
    return x, y


def colors(x, y):
    """Colors uint8 `[..., 3]` of rays (x, y, 1), smooth over several pixels."""
    waves = np.stack([np.sin(5 * x + 1), np.cos(6 * y - x), np.sin(4 * x * y + 3 * y)], -1)
    return np.rint(127.5 + 120 * waves).astype(np.uint8)


def grid():
    """Pixel centers on the image plane, in focal lengths."""
    fx, fy, cx, cy = INTRINSICS
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return (column - cx) / fx, (row - cy) / fy


@pytest.mark.parametrize("model", LENSES)
def test_rays_keep_their_colors(model):
    lens = LENSES[model]
    distortion = read_distortion("lens", {"camera_model": model, **lens})
    remap = undistortion_map(distortion, INTRINSICS, WIDTH, HEIGHT)
    photograph = colors(*straighten(*grid(), model, lens))
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    image, weight = undistort(photograph, mask, remap)

    fx, fy, cx, cy = INTRINSICS
    x, y = bend(*grid(), model, lens)
    column, row = fx * x + cx, fy * y + cy
    np.testing.assert_allclose(remap.x + 0.5, column, atol=1e-4)
    np.testing.assert_allclose(remap.y + 0.5, row, atol=1e-4)
    inside = (column >= 0) & (column <= WIDTH) & (row >= 0) & (row <= HEIGHT)
    np.testing.assert_array_equal(weight, np.where(inside, 255, 0))
    well_inside = (abs(column - WIDTH / 2) < WIDTH / 2 - 2) & (abs(row - HEIGHT / 2) < 20)
    assert well_inside.mean() > 0.6
    error = image[well_inside].astype(int) - colors(*grid())[well_inside]
    assert abs(error).max() <= 2 and abs(error).mean() < 0.5
    # The distortion is large enough to be visible.
    assert abs(photograph.astype(int) - colors(*grid())).max() > 10


@pytest.mark.parametrize("model", LENSES)
def test_pixels_of_a_file_are_found_in_the_pinhole_photograph(model):
    lens, (fx, fy, cx, cy) = LENSES[model], INTRINSICS
    distortion = read_distortion("lens", {"camera_model": model, **lens})
    for pixel in ((3.0, 5.5), (30.2, 20.0), (55.5, 40.0)):
        bent = (np.array(pixel) - (cx, cy)) / (fx, fy)
        x, y = straighten(*(bent[:, None]), model, lens)
        expected = np.array([fx * x[0] + cx, fy * y[0] + cy])
        found = to_pinhole(distortion, np.array(INTRINSICS), pixel)
        np.testing.assert_allclose(found, expected, atol=1e-3)
        back = from_pinhole(distortion, np.array(INTRINSICS), tuple(expected))
        np.testing.assert_allclose(back, pixel, atol=1e-3)


def test_pixels_beyond_the_fold_have_no_direction():
    distortion = read_distortion("lens", {"k1": -0.5})
    intrinsics = np.array([20.0, 20.0, 30.0, 22.0])
    assert np.isnan(to_pinhole(distortion, intrinsics, (55.0, 22.0))).all()  # 2/3 sqrt(2/3) is 0.54
    np.testing.assert_allclose(to_pinhole(distortion, intrinsics, (30.0, 22.0)), (30.0, 22.0))


def test_directions_beyond_the_fold_are_not_shown():
    """r (1 - 0.5 r^2) peaks at r = sqrt(2/3); beyond it, the photograph would repeat."""
    distortion = read_distortion("lens", {"k1": -0.5})
    remap = undistortion_map(distortion, (20.0, 20.0, 30.0, 22.0), WIDTH, HEIGHT)
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    radius = np.hypot(column - 30, row - 22) / 20
    np.testing.assert_array_equal(remap.inside, radius < np.sqrt(2 / 3))


def test_masks_are_undistorted_with_their_photographs():
    distortion = read_distortion("lens", {"camera_model": "RADIAL", **LENSES["RADIAL"]})
    remap = undistortion_map(distortion, INTRINSICS, WIDTH, HEIGHT)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, 40:] = 255
    weight = undistort(np.zeros((HEIGHT, WIDTH, 3), np.uint8), mask, remap)[1]
    clear = abs(remap.x - 39.5) > 1
    np.testing.assert_array_equal(weight[clear] > 0, (remap.x > 39.5)[clear])


@pytest.mark.parametrize(
    "lens", [{}, {"camera_model": "OPENCV", "k1": 0.0, "p2": 0}, {"camera_model": "PINHOLE"}]
)
def test_a_pinhole_has_no_distortion(lens):
    assert read_distortion("lens", lens) is None


def test_transforms_with_a_distorted_lens(tmp_path):
    """Loading gives pinhole photographs with the file's focal lengths and principal point."""
    fx, fy, cx, cy = INTRINSICS
    lens = LENSES["OPENCV"]
    write_image(tmp_path / "a.png", colors(*straighten(*grid(), "OPENCV", lens)))
    pose = {"file_path": "a.png", "transform_matrix": POSE.tolist()}
    about = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": WIDTH, "h": HEIGHT}
    write_json(tmp_path / "transforms.json", [{**pose, **about, **lens}])
    scene = load_scene(tmp_path)
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0], INTRINSICS, rtol=1e-6)
    weight, rgb = jax.device_get((scene.train.weight[0], scene.train.rgb[0]))
    assert set(np.unique(weight)) <= {0.0, 1.0} and weight.mean() > 0.8
    inner = np.s_[8:-8, 8:-8]
    assert abs(rgb.astype(int) - colors(*grid()))[inner].max() <= 2
    # With integer pixel centers in the file, the principal point lies half a pixel further.
    about |= {"cx": cx - 0.5, "cy": cy - 0.5}
    write_json(tmp_path / "transforms.json", [{**pose, **about, **lens}])
    shifted = load_scene(tmp_path, half_pixel=True)
    np.testing.assert_array_equal(shifted.train.rgb[0], rgb)
    # instant-ngp's files mark a fisheye with a flag.
    write_json(tmp_path / "transforms.json", [{**pose, **about, "is_fisheye": True}])
    assert not np.array_equal(load_scene(tmp_path).train.rgb[0], rgb)


@pytest.mark.parametrize("downscale", [1, 2])
def test_pixels_count_in_the_photograph_as_it_is(tmp_path, downscale):
    """Also where training reads it smaller."""
    fx, fy, cx, cy = INTRINSICS
    lens = {"k1": -0.15, "k2": 0.02}
    write_image(tmp_path / "a.png", colors(*straighten(*grid(), "RADIAL", lens)))
    pose = {"file_path": "a.png", "transform_matrix": POSE.tolist()}
    about = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": WIDTH, "h": HEIGHT}
    write_json(tmp_path / "transforms.json", [{**pose, **about, **lens}])
    scene = load_scene(tmp_path, downscale=downscale)
    asked = np.array([52.0, 36.0])
    x, y = straighten(*((asked - (cx, cy)) / (fx, fy))[:, None], "RADIAL", lens)
    expected = fx * x[0] + cx, fy * y[0] + cy
    assert np.abs(np.array(expected) - asked).max() > 0.7
    found = pinhole_pixel(scene, 0, tuple(asked))
    np.testing.assert_allclose(found, expected, atol=0.01)
    assert file_pixel(scene, 0, found) == (52, 36)
    with pytest.raises(CameraError, match=r"--at=a:59.5,43.5 is cut off where the distortion"):
        pinhole_pixel(scene, 0, (59.5, 43.5), given="--at=a:")
    with pytest.raises(CameraError, match="60 x 44 pixels of the photograph"):
        pinhole_pixel(scene, 0, (60, 43.5))
