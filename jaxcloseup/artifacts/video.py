"""Write videos: MP4 if the extra `video` is installed, otherwise WebM or AVI with OpenCV."""

import contextlib
import functools
import os
import pathlib
import subprocess
from collections.abc import Callable, Iterable, Iterator

import cv2
import numpy as np

from jaxcloseup.artifacts.images import Image, to_uint8


# OpenCV's wheels can write VP8, which browsers play, and Motion JPEG, which needs no codec.
_OPENCV = {".webm": "VP80", ".avi": "MJPG"}


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
    frames = _even(frames)
    first = next(frames)
    size = first.shape[1], first.shape[0]
    try:
        stem.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(stem, error.strerror) from error
    for ending, open_writer in _formats():
        path = stem.with_name(stem.name + ending)
        part = stem.with_name(f".{stem.name}.{os.getpid()}.part{ending}")
        try:
            writer = open_writer(part, size, fps)
            if writer is None:
                continue
            add, close = writer
            count = 0
            try:
                for frame in _all_of(first, frames):
                    add(frame)
                    count += 1
            finally:
                close()
            # Codecs do not report a full disk.
            if _count(part) != count:
                raise _unwritable(path, "frames are missing, perhaps because the disk is full")
            part.replace(path)
        except OSError as error:
            if error.args and str(path) in str(error):
                raise
            reason = error.strerror or str(error).strip().splitlines()[-1]
            raise _unwritable(path, reason) from error
        finally:
            part.unlink(missing_ok=True)
        return path
    raise _unwritable(stem, "this OpenCV writes neither WebM nor AVI; install the extra `video`")


def _formats() -> Iterator[tuple[str, Callable]]:
    try:
        import imageio_ffmpeg

        program = imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):  # not installed, or installed without FFmpeg
        pass
    else:
        yield ".mp4", functools.partial(_open_ffmpeg, program)
    for ending, codec in _OPENCV.items():

        def open_opencv(path, size, fps, codec=codec):
            fourcc = cv2.VideoWriter_fourcc(*codec)
            with _silent():
                writer = cv2.VideoWriter(str(path), fourcc, fps, size)
            if not writer.isOpened():
                return None
            return (lambda frame: writer.write(frame[..., ::-1])), writer.release

        yield ending, open_opencv


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep what C++ prints from the terminal: OpenCV warns of VP8 in WebM, which is right."""
    held, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(held, 2)
        os.close(held)
        os.close(nothing)


def _open_ffmpeg(program, path, size, fps):
    """Open a pipe into FFmpeg; imageio-ffmpeg's own writer forks, which JAX's threads forbid."""
    frames = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", f"{fps:g}"]
    codec = ["-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    command = [program, "-y", "-v", "error", *frames, "-i", "-", *codec, str(path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    process = subprocess.Popen(command, **pipes)

    def add(frame):
        # If FFmpeg fails, the pipe is gone; `close` raises the reason.
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(np.ascontiguousarray(frame))

    def close():
        _, said = process.communicate()
        if process.returncode:
            lines = said.decode(errors="replace").strip().splitlines()
            raise OSError(f"FFmpeg failed: {lines[-1] if lines else process.returncode}")

    return add, close


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


def _all_of(first, rest):
    yield first
    yield from rest


def _count(path):
    video, count = cv2.VideoCapture(str(path)), 0
    while video.grab():
        count += 1
    video.release()
    return count


def _unwritable(path, reason):
    return OSError(
        f"{path} cannot be written ({reason}): choose another output folder or make room in this "
        "one."
    )
