import base64
import io
import re

import cv2
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest

from jaxcloseup.artifacts.images import (
    color_counts,
    colorize_depth,
    colorize_error,
    colorize_normals,
    colorize_support,
    encode_webp_animation,
    side_by_side,
    to_uint8,
    webp_data_uri,
    write_png,
)
from jaxcloseup.io.files import write_file
from jaxcloseup.metrics.image_metrics import quantize


@pytest.fixture
def image():
    return np.random.default_rng(0).uniform(-0.1, 1.1, (5, 7, 3)).astype(np.float32)


def read_png(path):
    return cv2.imread(str(path))[..., ::-1]


def test_to_uint8():
    values = np.array([[-1, 0, 0.5], [1, 2, np.nan]], np.float32)
    expected = np.array([[0, 0, 128], [255, 255, 0]])
    np.testing.assert_array_equal(to_uint8(values), np.stack([expected] * 3, -1))
    np.testing.assert_array_equal(to_uint8(jnp.asarray(values)), to_uint8(values))
    assert to_uint8(np.full((2, 2, 3), np.inf)).tolist() == [[[255] * 3] * 2] * 2
    with pytest.raises(ValueError, match=r"got \(2, 3, 4\)"):
        to_uint8(np.zeros((2, 3, 4)))


def test_write_png(tmp_path, image):
    path = tmp_path / "new" / "folder é" / "a.png"
    write_png(path, image)
    loaded = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)[..., ::-1]
    # The file holds the same values as the metrics see.
    np.testing.assert_array_equal(loaded, np.rint(np.asarray(quantize(jnp.asarray(image))) * 255))
    write_png(path, np.full((2, 3, 3), 7, np.uint8))
    assert cv2.imdecode(np.fromfile(path, np.uint8), -1).shape == (2, 3, 3)
    assert [file.name for file in path.parent.iterdir()] == ["a.png"]


def test_failed_write_leaves_the_old_file(tmp_path, image, monkeypatch):
    write_png(tmp_path / "a.png", image)
    before = (tmp_path / "a.png").read_bytes()

    def fail(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", fail)
    with pytest.raises(OSError, match=r"a\.png cannot be written \(No space left on device\)"):
        write_file(tmp_path / "a.png", b"other")
    assert (tmp_path / "a.png").read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]


def test_unwritable_path(tmp_path, image):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"file/a\.png cannot be written .*: choose another"):
        write_png(tmp_path / "file" / "a.png", image)


def test_webp_data_uri():
    y, x = np.mgrid[:30, :40]
    image = np.stack([6 * x, 8 * y, 3 * (x + y)], axis=-1).astype(np.uint8)
    address = webp_data_uri(image)
    head, _, body = address.partition(",")
    assert head == "data:image/webp;base64" and re.fullmatch(r"[A-Za-z0-9+/=]+", body)
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(body), np.uint8), cv2.IMREAD_COLOR)
    difference = np.abs(decoded[..., ::-1].astype(int) - image)  # OpenCV stores blue first
    assert difference.mean() < 3
    assert len(webp_data_uri(image, quality=10)) < len(address)


def test_webp_animation():
    frames = [np.full((20, 30, 3), (40 * i, 100, 200), np.uint8) for i in range(5)]
    data = encode_webp_animation(frames, fps=10)
    with PIL.Image.open(io.BytesIO(data)) as shown:
        assert (shown.n_frames, shown.size, shown.info["loop"]) == (5, (30, 20), 0)
        for i in range(5):
            shown.seek(i)
            assert np.abs(np.asarray(shown.convert("RGB"), int) - frames[i]).max() < 12
            assert shown.info["duration"] == 100


def test_colorize_depth():
    depth = np.array([[1.0, 2, 4, 0], [np.nan, np.inf, -1, 9]])
    valid = np.ones((2, 4), bool)
    valid[1, 3] = False
    colors = colorize_depth(depth, near=1, far=4, valid=valid)
    assert colors.dtype == np.uint8 and colors.shape == (2, 4, 3)
    # Turbo runs from dark red through green (1/2 is at a third of [1/4, 1]) to dark blue; invalid
    # pixels are black.
    red, green, blue = colors[0, :3].astype(int).T
    assert red[0] > 100 > green[0] and blue[0] < 20
    assert green[1] > 200 > red[1]
    assert blue[2] > red[2] and green[2] < 60
    assert not colors[0, 3].any() and not colors[1].any()
    assert colors[0, :3].any(-1).all()
    np.testing.assert_array_equal(
        colorize_depth(jnp.asarray([[1.0, 2, 4]]), near=1, far=4), colors[:1, :3]
    )


def test_colorize_depth_is_robust():
    depth = np.linspace(2, 3, 400).reshape(20, 20)
    stray = depth.copy()
    stray[0, 0], stray[0, 1] = 1e-6, 1e6
    assert np.abs(colorize_depth(stray)[1:].astype(int) - colorize_depth(depth)[1:]).max() < 12
    assert colorize_depth(np.full((2, 2), 3.0)).shape == (2, 2, 3)
    assert not colorize_depth(np.zeros((2, 2))).any()


def test_colorize_error():
    error = np.linspace(0, 0.5, 9)[None]
    colors = colorize_error(error).astype(int)
    assert (np.diff(colors.sum(-1)[0, :5]) > 0).all()  # brighter up to an error of 0.25
    assert (colors[0, 4:] == colors[0, 4]).all() and colors[0, 0].sum() < 10
    np.testing.assert_array_equal(colorize_error(-error), colors)
    np.testing.assert_array_equal(colorize_error(np.repeat(error[..., None], 3, -1)), colors)
    np.testing.assert_array_equal(colorize_error(error * 2, highest=0.5), colors)


def test_side_by_side(image):
    tall = np.zeros((9, 4), np.float32)
    row = side_by_side([image, tall], gap=2)
    assert row.shape == (9, 13, 3) and row.dtype == np.uint8
    np.testing.assert_array_equal(row[:5, :7], to_uint8(image))
    assert (row[5:, :7] == 255).all() and (row[:, 7:9] == 255).all() and not row[:, 9:].any()


def test_labels():
    panel = np.full((10, 60, 3), 200, np.uint8)
    row = side_by_side([panel, panel], labels=["a", "très long label that cannot fit"], gap=4)
    strip = row[:-10]
    np.testing.assert_array_equal(row[-10:, :60], panel)
    for left in (0, 64):
        ink = np.argwhere(strip[:, left : left + 60].min(-1) < 128)
        assert len(ink) > 3 and ink[:, 1].max() < 59
    assert (strip[:, 60:64] == 255).all()
    with pytest.raises(ValueError, match="zip"):
        side_by_side([panel], labels=["a", "b"])


def test_colorize_normals():
    normal = np.array([[[0.0, 0, 2], [-0.1, 0, 0], [0, 0, 0], [np.nan, 0, 0]]])
    expected = [[128, 128, 255], [0, 128, 128], [0, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(colorize_normals(normal)[0].astype(int), expected, atol=1)


def test_support_is_drawn_in_steps_with_unseen_pixels_in_magenta():
    footprint = np.array([[0.5, 1, 1.5, 2, 3.9, 8, 9, 100, np.inf]])
    count = np.array([[12, 9, 8, 4, 3, 2, 1, 1, 0]])
    picture = colorize_support(count, footprint)
    factor = 360 // 9
    assert picture.shape == (24 + factor + 24, 2 * 360 + 8, 3)
    sharp, often = (picture[24 + factor // 2, left : left + 360 : factor] for left in (0, 368))
    unseen = [230, 0, 126]
    for row, groups in ((sharp, "aabbcdeeu"), (often, "aabccdeeu")):
        colors = {group: row[i].tolist() for i, group in enumerate(groups)}
        assert colors["u"] == unseen
        assert [colors[group] for group in groups] == row.tolist()
        steps = [sum(colors[group]) for group in "abcde"]
        assert steps == sorted(steps, reverse=True) and len(set(steps)) == 5
    colors, strip = color_counts(count[0])
    np.testing.assert_array_equal(colors, often)
    np.testing.assert_array_equal(strip, picture[-24:, 368:])
    # The legend shows the same colors in the same order.
    legend = picture[-12, 8:360:60].tolist()
    assert legend == [sharp[i].tolist() for i in (0, 2, 4, 5, 6, 8)]
