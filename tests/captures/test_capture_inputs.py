import struct
import zlib

import cv2
import numpy as np
import PIL.Image
import pytest
from tiny_capture import HEIGHT, PROPERTIES, WIDTH, vertices, write_image, write_ply

from jaxcloseup.captures import photo_files as images
from jaxcloseup.captures.depth_range import near_far_from_cameras, near_far_from_points
from jaxcloseup.captures.load import SceneError
from jaxcloseup.captures.photo_files import read_image
from jaxcloseup.captures.points import read_ply_points
from jaxcloseup.photos.scene import PointsWarning


# Decoding.


def test_gray_deep_and_transparent_images(tmp_path):
    gray = np.arange(48, dtype=np.uint8).reshape(HEIGHT, WIDTH)
    write_image(tmp_path / "gray.png", gray)
    np.testing.assert_array_equal(
        read_image(tmp_path / "gray.png"), np.repeat(gray[..., None], 3, 2)
    )
    deep = np.zeros((HEIGHT, WIDTH, 3), np.uint16)
    deep[0, 0] = [65535, 257 * 100 + 128, 257 * 100 + 129]
    write_image(tmp_path / "deep.png", deep)
    assert read_image(tmp_path / "deep.png")[0, 0].tolist() == [255, 100, 101]
    deep_alpha = np.full((HEIGHT, WIDTH, 4), 65535, np.uint16)
    deep_alpha[..., 1:] = 0
    write_image(tmp_path / "deep_alpha.png", deep_alpha)
    assert read_image(tmp_path / "deep_alpha.png", background=0.5)[0, 0].tolist() == [128] * 3


def test_exif_orientation_is_not_applied(tmp_path):
    write_image(tmp_path / "a.jpg")
    data = (tmp_path / "a.jpg").read_bytes()
    tiff = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, 6, 0)  # rotated by 90 degrees
    app1 = b"\xff\xe1" + struct.pack(">H", 8 + len(tiff)) + b"Exif\0\0" + tiff
    (tmp_path / "a.jpg").write_bytes(data[:2] + app1 + data[2:])
    assert cv2.imread(str(tmp_path / "a.jpg")).shape == (WIDTH, HEIGHT, 3)  # the tag is well-formed
    assert read_image(tmp_path / "a.jpg").shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("keep", [0.0, 0.02, 0.5, 0.99])
def test_truncated_images(tmp_path, suffix, keep, capfd):
    write_image(tmp_path / f"a{suffix}", np.random.default_rng(0).integers(0, 256, (64, 64, 3)))
    data = (tmp_path / f"a{suffix}").read_bytes()
    (tmp_path / f"a{suffix}").write_bytes(data[: int(len(data) * keep)])
    with pytest.raises(SceneError, match=r"a\.(jpg|png) is not a readable image or is trunc"):
        read_image(tmp_path / f"a{suffix}")


def test_truncated_jpeg_with_a_complete_thumbnail(tmp_path, capfd):
    write_image(tmp_path / "a.jpg")
    whole = (tmp_path / "a.jpg").read_bytes()
    app1 = b"\xff\xe1" + struct.pack(">H", 2 + len(whole)) + whole
    (tmp_path / "a.jpg").write_bytes(whole[:2] + app1 + whole[2:])
    assert read_image(tmp_path / "a.jpg").shape == (HEIGHT, WIDTH, 3)
    (tmp_path / "a.jpg").write_bytes(whole[:2] + app1 + whole[2:-2])
    with pytest.raises(SceneError, match="truncated"):
        read_image(tmp_path / "a.jpg")


def test_not_an_image(tmp_path):
    (tmp_path / "a.png").write_text("hello")
    with pytest.raises(SceneError, match="not a readable image"):
        read_image(tmp_path / "a.png")
    write_image(tmp_path / "a.tiff", np.zeros((4, 4, 3), np.float32))
    with pytest.raises(SceneError, match="holds float32 values"):
        read_image(tmp_path / "a.tiff")
    with pytest.raises(SceneError, match=r"cannot be read \(No such file"):
        read_image(tmp_path / "b.png")


def test_a_header_with_a_huge_image_size(tmp_path):
    write_image(tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    header = b"IHDR" + struct.pack(">II", 100_000, 100_000) + data[24:29]
    huge = data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]
    (tmp_path / "a.png").write_bytes(huge)
    with pytest.raises(SceneError, match=r"a\.png has more than 170 megapixels"):
        read_image(tmp_path / "a.png")


def test_small_files_of_many_pixels_are_refused_before_they_are_decoded(tmp_path, monkeypatch):
    def refuse(*_):
        pytest.fail("decoded")

    with monkeypatch.context() as patch:
        patch.setattr(cv2, "imdecode", refuse)
        patch.setattr(images, "MOST_PIXELS", WIDTH * HEIGHT - 1)
        for suffix in (".png", ".jpg", ".bmp", ".tiff", ".webp"):
            write_image(tmp_path / f"a{suffix}")
            with pytest.raises(SceneError, match="megapixels and is too large to decode"):
                read_image(tmp_path / f"a{suffix}")
    monkeypatch.setattr(PIL.Image, "MAX_IMAGE_PIXELS", WIDTH * HEIGHT - 1)  # Pillow would warn
    assert read_image(tmp_path / "a.png").shape == (HEIGHT, WIDTH, 3)
    monkeypatch.setattr(PIL.Image, "MAX_IMAGE_PIXELS", 1)  # and raise
    with pytest.raises(SceneError, match="megapixels and is too large to decode"):
        read_image(tmp_path / "a.png")


def test_cmyk_becomes_rgb(tmp_path):
    """Full cyan removes all red."""
    image = pytest.importorskip("PIL.Image")
    image.new("CMYK", (WIDTH, HEIGHT), (255, 0, 0, 0)).save(tmp_path / "a.jpg")
    red, green, blue = read_image(tmp_path / "a.jpg")[2, 3].tolist()
    assert red < 60 and green > 150 and blue > 150


# Points.


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("color", ["u1", "u2", "f4"])
def test_ply_encodings(tmp_path, encoding, color):
    properties = [("blue", color), ("nx", "f4"), *PROPERTIES[:3][::-1], ("segment", "i4")]
    properties += [("red", color), ("green", color)]
    rows = vertices(properties)
    write_ply(tmp_path / "p.ply", rows, encoding, after=b"3 0 1 2\n")
    points, rgb = read_ply_points(tmp_path / "p.ply")
    scale = {"u1": 255, "u2": 65535, "f4": 1}[color]
    assert points.dtype == rgb.dtype == np.float32
    np.testing.assert_allclose(points, np.stack([rows[axis] for axis in "xyz"], -1), rtol=1e-6)
    for channel, name in enumerate(("red", "green", "blue")):
        np.testing.assert_allclose(rgb[:, channel], rows[name] / scale, rtol=1e-5)


def test_ply_oddities(tmp_path):
    rows = vertices(PROPERTIES[:3])
    rows["y"][1] = np.nan
    write_ply(tmp_path / "p.ply", rows, "ascii", newline="\r\n")
    with pytest.warns(PointsWarning, match="1 of 5 points are not finite"):
        points, rgb = read_ply_points(tmp_path / "p.ply")
    assert points.shape == (4, 3) and (rgb == 0.5).all()
    rows = vertices([*PROPERTIES[:3], ("red", "f4"), ("green", "f4"), ("blue", "f4")])
    rows["red"] = 255
    write_ply(tmp_path / "p.ply", rows)
    assert (read_ply_points(tmp_path / "p.ply")[1][:, 0] == 1).all()
    write_ply(tmp_path / "p.ply", vertices(count=0))
    assert read_ply_points(tmp_path / "p.ply")[0].shape == (0, 3)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply_cut_short(tmp_path, encoding):
    write_ply(tmp_path / "p.ply", vertices(), encoding)
    data = (tmp_path / "p.ply").read_bytes()
    for cut in (20, 60):
        (tmp_path / "p.ply").write_bytes(data[:-cut])
        with pytest.raises(SceneError, match=r"p\.ply ends before its 5 vertices do"):
            read_ply_points(tmp_path / "p.ply")


XYZ = (
    "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\n"
    "property float z\n{}end_header\n"
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not a PLY file"),
        ("hello\nend_header\n", "is not a PLY file"),
        ("ply\nformat gzip 1.0\nend_header\n", "is not a PLY file"),
        ("ply\nformat ascii 1.0\nelement face 1\nend_header\n", "does not begin with vertices"),
        ("ply\nformat ascii 1.0\nend_header\n", "does not begin with vertices"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
            "plain properties x, y, z",
        ),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1\n",
            "plain properties x, y, z",
        ),
        (XYZ.format(-1, ""), "a count of -1"),
        (XYZ.format(1, "property float x\n") + "1 2 3 4\n", "a property name appears twice"),
        (XYZ.format(1, "") + "a b c\n", "has words instead of numbers"),
        (XYZ.format(2, "") + "1 2 3\n", "ends before its 2 vertices do"),
    ],
)
def test_ply_errors(tmp_path, text, message):
    (tmp_path / "p.ply").write_text(text)
    with pytest.raises(SceneError, match=message):
        read_ply_points(tmp_path / "p.ply")


# Depth range.


def look_at(position, target):
    """An OpenCV pose `[3, 4]`."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward, position], -1)


def test_near_far_from_points():
    """Cameras see a ball of radius 1 from distances 4 and 2; stray points are ignored."""
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    stray = np.array([[0, 3.99, 0], [0, -500.0, 0]])
    poses = np.stack([look_at([0, 4, 0], [0, 0, 0]), look_at([0, -2, 0], [0, 0, 0])])
    lens, sizes = np.array([[20.0, 20, 20, 20]] * 2), np.array([[40, 40]] * 2)
    near, far = near_far_from_points(np.concatenate([ball, stray]), poses, lens, sizes)
    assert 0.5 < near < 1 and 5 < far < 10
    assert near_far_from_points(ball, poses[:1] - [0, 0, 0, 9], lens[:1], sizes[:1]) is None


def test_near_far_from_cameras():
    subject = np.array([1.0, 2, 3])
    offsets = np.array([[4, 0, 0], [0, 5, 1], [-3, -1, 0.5], [1, 2, 2]])
    poses = np.stack([look_at(subject + offset, subject) for offset in offsets])
    distances = np.linalg.norm(offsets, axis=1)
    near, far = near_far_from_cameras(poses)
    np.testing.assert_allclose([near, far], [distances.min() / 10, distances.max() * 4])
    # Parallel axes do not meet; diverging ones meet behind the cameras.
    parallel = np.repeat(poses[:1], 3, 0)
    parallel[:, 0, 3] += [0, 3, 6]
    np.testing.assert_allclose(near_far_from_cameras(parallel), [0.3, 300])
    np.testing.assert_allclose(near_far_from_cameras(poses[:1]), [0.1, 100])
    outward = poses * np.array([1, 1, -1, 1])
    low, high = near_far_from_cameras(outward)
    assert 0 < low < high
