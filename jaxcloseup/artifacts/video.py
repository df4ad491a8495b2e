"""Write videos: MP4 by FFmpeg if the extra `video` is installed, otherwise WebM by OpenCV."""

import contextlib
import itertools
import math
import os
import pathlib
import threading
from collections.abc import Iterable, Iterator

import cv2
import imageio.v2 as imageio
import numpy as np

from jaxcloseup.artifacts.images import Image, to_uint8


ENDINGS = _MP4, _WEBM = ".mp4", ".webm"
_CODEC = "VP80"  # VP8, which OpenCV's wheels can write and browsers play
_LEAST_FPS = 1.0  # of files; slower videos repeat their frames, because WebM counts milliseconds


def write_video(stem: str | pathlib.Path, frames: Iterable[Image], *, fps: float) -> pathlib.Path:
    """Write frames as a video, atomically, and create its folder.

    Args:
      stem: path without suffix; the format decides the suffix.
      frames: one or more images of one size, as for `write_png`. Odd sides grow by a copy of the
        last row or column, because codecs need even sides.
      fps: frames per second.

    Returns:
      The path of the file.

    Raises:
      OSError: the video cannot be written; the message gives the reason.
      ValueError: the frames differ in size, or there are none.
    """
    stem = pathlib.Path(stem)
    repeated = max(1, math.ceil(_LEAST_FPS / fps))
    shown = (frame for frame in _even(frames) for _ in range(repeated))
    first = next(shown)
    ending = _MP4 if _has_ffmpeg() else _WEBM
    path = stem.with_name(stem.name + ending)
    part = stem.with_name(f".{stem.name}.{os.getpid()}.part{ending}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        writer = (_Mp4 if ending == _MP4 else _WebM)(part, first.shape, repeated * fps)
        count = 0
        try:
            for frame in itertools.chain([first], shown):
                writer.add(frame)
                count += 1
        finally:
            writer.close()
        # Codecs do not report a full disk.
        if _count(part) != count:
            raise OSError("frames are missing, perhaps because the disk is full")
        part.replace(path)
    except OSError as error:
        reason = error.strerror or str(error).strip().splitlines()[-1]
        raise _unwritable(path, reason) from error
    finally:
        with contextlib.suppress(NotADirectoryError):
            part.unlink(missing_ok=True)
    return path


def _has_ffmpeg() -> bool:
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):  # not installed, or installed without FFmpeg
        return False
    return True


class _Mp4:
    """H.264 by FFmpeg, at a quality that looks like the frames."""

    def __init__(self, path: pathlib.Path, shape: tuple[int, ...], fps: float) -> None:
        # Otherwise imageio-ffmpeg forks, which JAX's threads forbid.
        os.environ["IMAGEIO_FFMPEG_NO_PREVENT_SIGINT"] = "1"
        self._writer = imageio.get_writer(
            path,
            format="FFMPEG",
            mode="I",
            fps=fps,
            codec="libx264",
            quality=None,
            pixelformat="yuv420p",
            macro_block_size=2,
            ffmpeg_log_level="error",
            output_params=["-crf", "16", "-movflags", "+faststart"],
        )

    def add(self, frame: np.ndarray) -> None:
        self._writer.append_data(frame)

    def close(self) -> None:
        self._writer.close()


class _WebM:
    """WebM by OpenCV."""

    def __init__(self, path: pathlib.Path, shape: tuple[int, ...], fps: float) -> None:
        fourcc = cv2.VideoWriter.fourcc(*_CODEC)
        with _silent():
            self._writer = cv2.VideoWriter(str(path), fourcc, fps, (shape[1], shape[0]))
        if not self._writer.isOpened():
            raise OSError("this OpenCV writes no WebM; install the extra `video`")

    def add(self, frame: np.ndarray) -> None:
        self._writer.write(frame[..., ::-1])

    def close(self) -> None:
        self._writer.release()


_one_at_a_time = threading.Lock()  # two threads would put back each other's output


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep what C++ prints from the terminal: OpenCV warns of VP8 in WebM, which is right."""
    with _one_at_a_time:
        held, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 2)
        try:
            yield
        finally:
            os.dup2(held, 2)
            os.close(held)
            os.close(nothing)


def _even(frames: Iterable[Image]) -> Iterator[np.ndarray]:
    """Convert the frames to uint8 and pad them to even sides."""
    shape = None
    for frame in frames:
        frame = to_uint8(frame)
        height, width = frame.shape[:2]
        if shape not in (None, frame.shape):
            raise ValueError(
                f"all frames of a video must have one size, got {shape} and {frame.shape}."
            )
        shape = frame.shape
        yield np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    if shape is None:
        raise ValueError("a video needs at least one frame.")


def _count(path: pathlib.Path) -> int:
    video, count = cv2.VideoCapture(str(path)), 0
    while video.grab():
        count += 1
    video.release()
    return count


def _unwritable(path: pathlib.Path, reason: str) -> OSError:
    return OSError(
        f"{path} cannot be written ({reason}): choose another output folder or make room in this "
        "one."
    )
