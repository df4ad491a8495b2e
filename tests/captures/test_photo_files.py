"""Decoding of photographs and masks."""

import struct

import cv2
import numpy as np
import PIL.Image
import pytest
from tiny_capture import HEIGHT, WIDTH, tiff, write_image

from jaxcloseup.captures import photo_files
from jaxcloseup.captures.load import SceneError
from jaxcloseup.captures.photo_files import decode_image, read_image, size_of_image


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


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_tiff_orientation_is_not_applied(tmp_path, order, kind, channels):
    """OpenCV would turn the image; the witness is the same image in a PNG."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, np.iinfo(kind).max, (HEIGHT, WIDTH, channels)).astype(kind)
    write_image(tmp_path / "a.png", image[..., 0] if channels == 1 else image)
    (tmp_path / "a.tif").write_bytes(tiff(image, order, 1))
    plain = decode_image(tmp_path / "a.tif")
    np.testing.assert_array_equal(plain, decode_image(tmp_path / "a.png"))
    for orientation in range(2, 9):
        (tmp_path / "a.tif").write_bytes(tiff(image, order, orientation))
        np.testing.assert_array_equal(decode_image(tmp_path / "a.tif"), plain)


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


@pytest.mark.parametrize("marker", [b"\xff\xdb", b"\xff\xda"])
@pytest.mark.parametrize("extra", [b"\xff", b"\xff\xff\xff", b"\x00\x07"])
def test_bytes_between_segments_of_a_jpeg_are_skipped(tmp_path, marker, extra):
    write_image(tmp_path / "a.jpg")
    whole = (tmp_path / "a.jpg").read_bytes()
    at = whole.index(marker)
    (tmp_path / "b.jpg").write_bytes(whole[:at] + extra + whole[at:])
    np.testing.assert_array_equal(read_image(tmp_path / "b.jpg"), read_image(tmp_path / "a.jpg"))
    (tmp_path / "b.jpg").write_bytes(whole[:at] + extra + whole[at:-2])
    with pytest.raises(SceneError, match="truncated"):
        read_image(tmp_path / "b.jpg")


def test_no_file(tmp_path):
    with pytest.raises(SceneError, match=r"cannot be read \(No such file"):
        read_image(tmp_path / "b.png")


def test_small_files_of_many_pixels_are_refused_before_they_are_decoded(tmp_path, monkeypatch):
    def refuse(*_):
        pytest.fail("decoded")

    with monkeypatch.context() as patch:
        patch.setattr(cv2, "imdecode", refuse)
        patch.setattr(photo_files, "MOST_PIXELS", WIDTH * HEIGHT - 1)
        for suffix in (".png", ".jpg", ".bmp", ".tiff", ".webp"):
            write_image(tmp_path / f"a{suffix}")
            with pytest.raises(SceneError, match="megapixels and is too large to decode"):
                read_image(tmp_path / f"a{suffix}")
    monkeypatch.setattr(PIL.Image, "MAX_IMAGE_PIXELS", WIDTH * HEIGHT - 1)  # Pillow would warn
    assert read_image(tmp_path / "a.png").shape == (HEIGHT, WIDTH, 3)
    assert size_of_image(tmp_path / "a.png") == (WIDTH, HEIGHT)
    monkeypatch.setattr(PIL.Image, "MAX_IMAGE_PIXELS", 1)  # and raise
    with pytest.raises(SceneError, match="megapixels and is too large to decode"):
        read_image(tmp_path / "a.png")


def test_cmyk_becomes_rgb(tmp_path):
    """Full cyan removes all red."""
    PIL.Image.new("CMYK", (WIDTH, HEIGHT), (255, 0, 0, 0)).save(tmp_path / "a.jpg")
    red, green, blue = read_image(tmp_path / "a.jpg")[2, 3].tolist()
    assert red < 60 and green > 150 and blue > 150


def test_palettes_become_rgb(tmp_path):
    picture = PIL.Image.new("P", (WIDTH, HEIGHT), 1)
    picture.putpalette([0, 0, 0, 10, 20, 30])
    picture.save(tmp_path / "a.png")
    assert read_image(tmp_path / "a.png")[0, 0].tolist() == [10, 20, 30]
