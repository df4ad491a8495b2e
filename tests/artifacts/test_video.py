import sys

import cv2
import numpy as np
import pytest

from jaxcloseup.artifacts import video
from jaxcloseup.artifacts.video import write_video


def frames(height, width, count=7):
    """Smooth images that grow brighter."""
    y, x = np.mgrid[:height, :width]
    image = np.stack([x / width, y / height, 0.5 + 0 * x], -1)
    return [0.3 + 0.4 * image + 0.03 * i for i in range(count)]


def read(path):
    capture, images = cv2.VideoCapture(str(path)), []
    while True:
        more, image = capture.read()
        if not more:
            return images, capture.get(cv2.CAP_PROP_FPS)
        images.append(image[..., ::-1] / 255)


@pytest.fixture
def opencv_only(monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)


def check(path, ending, images):
    assert path.suffix == ending
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    found, fps = read(path)
    assert len(found) == len(images)
    assert fps == pytest.approx(12, abs=0.1)
    for new, old in zip(found, images, strict=True):
        height, width = old.shape[:2]
        assert new.shape == (height + height % 2, width + width % 2, 3)
        assert np.abs(new[:height, :width] - old).mean() < 0.02


@pytest.mark.parametrize("size", [(64, 96), (63, 97)])
def test_webm_by_opencv_keeps_every_frame(tmp_path, opencv_only, size, capfd):
    images = frames(*size)
    path = write_video(tmp_path / "new" / "a", images, fps=12)
    assert capfd.readouterr() == ("", "")
    check(path, ".webm", images)


def test_opencv_without_webm_is_an_os_error(tmp_path, opencv_only, monkeypatch):
    monkeypatch.setattr(video, "_CODEC", "none")
    with pytest.raises(OSError, match=r"a\.webm cannot be written .*install the extra `video`"):
        write_video(tmp_path / "a", frames(64, 96), fps=12)
    assert not list(tmp_path.iterdir())


def test_mp4_with_the_extra(tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra video")
    images = frames(63, 97)
    check(write_video(tmp_path / "a", images, fps=12), ".mp4", images)


@pytest.mark.parametrize("opened", [0, 2])
def test_a_truncated_video_is_removed(tmp_path, monkeypatch, opened):
    monkeypatch.setattr(video, "_count", lambda path: opened)
    with pytest.raises(OSError, match=r"a\.\w+ cannot be written \(frames are missing"):
        write_video(tmp_path / "a", frames(32, 32), fps=12)
    assert not list(tmp_path.iterdir())


def test_wrong_frames(tmp_path):
    with pytest.raises(ValueError, match="at least one frame"):
        write_video(tmp_path / "a", [], fps=12)
    with pytest.raises(ValueError, match="must have one size"):
        write_video(tmp_path / "a", [*frames(32, 32), *frames(30, 32)], fps=12)
    assert not list(tmp_path.iterdir())


def test_an_unwritable_folder_is_an_os_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"cannot be written .*: choose another output folder"):
        write_video(tmp_path / "file" / "a", frames(32, 32), fps=12)


def test_slow_videos_repeat_their_frames(tmp_path, opencv_only):
    """WebM counts milliseconds, and loses frames that last longer than some seconds."""
    images = frames(64, 96)
    found, fps = read(write_video(tmp_path / "a", images, fps=0.1))
    assert len(found) == 10 * len(images) and fps == pytest.approx(1, abs=0.01)
    assert np.abs(found[-1] - images[-1]).mean() < 0.02
