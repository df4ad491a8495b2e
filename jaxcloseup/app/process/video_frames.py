"""Choose sharp frames of a video, spread evenly over the camera's motion."""

import itertools
import os
import pathlib
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from jaxcloseup.app.process.counting import progress
from jaxcloseup.app.process.options import FEWEST
from jaxcloseup.app.process.photo_folder import Copied
from jaxcloseup.app.process.solver_process import ProcessingError
from jaxcloseup.io.files import check_file, write_file


LARGEST = 2**42  # bytes of a video
_SHARP_WIDTH, _MOTION_WIDTH = 960, 160  # pixels of the reduced frames
_LEAST_MOTION = 0.1  # widths of a frame in the whole video; a tripod has less
_ENOUGH = 3  # frames to compare in the middle of a part
_BLURRED = 0.5  # share of the sharpness of frames nearby
_QUALITY = 95  # of JPEG files
_WIDEST = 4.0  # times that a pixel is wider than high, or higher; anamorphic lenses have 2


def choose_frames(sharpness: np.ndarray, motion: np.ndarray, count: int) -> list[int]:
    """Choose frames of a video.

    The video is divided into `count` parts of equal motion, so a camera that stands still for a
    while adds no frames. Each part contributes its sharpest frame, unless nearby frames are more
    than twice as sharp. Sharpness depends on the content of a frame, so frames far apart are not
    compared. If the middle half of a part has at least three frames, only these are compared, which
    spreads the chosen ones more evenly.

    Args:
      sharpness: `[F]` sharpness of each frame, in any unit.
      motion: `[F]` how far the picture moved since the frame before; 0 for the first.
      count: largest number of frames to choose.

    Returns:
      The indices in order; fewer than `count` where the video jumps or is blurred.
    """
    if len(sharpness) <= count:
        return list(range(len(sharpness)))
    path = np.cumsum(motion)
    part = path[-1] / count
    chosen = set()
    for i in range(count):
        away = np.abs(path - (i + 0.5) * part)
        reach = part / 4 if np.sum(away <= part / 4) >= _ENOUGH else part / 2
        near = np.flatnonzero(away <= reach)
        if len(near):
            best = near[np.argmax(sharpness[near])]
            if sharpness[best] >= _BLURRED * sharpness[away <= 1.5 * part].max():
                chosen.add(int(best))
    return sorted(chosen)


def extract_frames(
    video: pathlib.Path, count: int, folder: pathlib.Path
) -> tuple[list[Copied], int]:
    """Write the best frames of a video into a folder, upright, as JPEG files.

    Args:
      video: the file.
      count: largest number of frames.
      folder: folder for the frames, which are named by their index in the video.

    Returns:
      The frames, and the number of frames of the video.

    Raises:
      ProcessingError: the video cannot be read, has fewer than 3 frames, or shows no motion.
      OSError: a frame cannot be written.
    """
    sharpness, motion = _survey(video)
    total = float(motion.sum())
    if total < _LEAST_MOTION:
        raise ProcessingError(
            f"--video={video} hardly moves ({total:.2f} of its width in all): poses need a camera "
            "that moves around the scene"
        )
    chosen = choose_frames(sharpness, motion, count)
    copied: list[Copied] = []
    with progress("writing frames", "frames") as report:
        for index, frame in _frames(video, chosen):
            name = f"frame_{index:06d}.jpg"
            write_file(folder / name, _jpeg(frame))
            copied.append(Copied(name, f"frame {index}", [frame.shape[1], frame.shape[0]]))
            report(len(copied), len(chosen))
    return copied, len(sharpness)


def _survey(video: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Measure sharpness `[F]`, and motion `[F]` in widths of a frame, for all frames of a video."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    before, sharpness, motion = None, [], []
    with progress("looking for sharp frames", "frames") as report:
        claimed = int(open_video(video).get(cv2.CAP_PROP_FRAME_COUNT))
        for _, frame in _frames(video):
            gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            sharpness.append(cv2.Laplacian(_reduced(gray, _SHARP_WIDTH), cv2.CV_32F).var())
            small = _reduced(gray, _MOTION_WIDTH)
            moved = 0.0
            if before is not None:
                vectors = flow.calc(before, small, None)  # type: ignore[call-overload]
                moved = np.median(np.linalg.norm(vectors, axis=-1))
            motion.append(moved / small.shape[1])
            before = small
            report(len(motion), claimed if claimed >= len(motion) else None)
    if len(motion) < FEWEST:
        raise ProcessingError(
            f"--video={video} has {len(motion)} readable frames: poses need at least {FEWEST}"
        )
    return np.array(sharpness), np.array(motion)


def open_video(video: pathlib.Path) -> cv2.VideoCapture:
    """Open a video.

    Raises:
      ProcessingError: it cannot be read, or is none.
    """
    # Without these levels, FFmpeg and OpenCV print errors of their own.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.getLogLevel()
    try:
        check_file(video, most=LARGEST)
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        opened = cv2.VideoCapture(str(video))
    except OSError as error:
        raise ProcessingError(
            f"--video={video} cannot be read ({error.strerror}): name a video file"
        ) from error
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not opened.isOpened():
        raise ProcessingError(
            f"--video={video} is not a video that can be read: export it again, as MP4"
        )
    return opened  # it turns frames upright as the file says


def _frames(
    video: pathlib.Path, chosen: Sequence[int] | None = None
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield indices and frames of a video, uint8 BGR `[H, W, 3]`: the chosen ones, or all.

    Frames are enlarged along one side where the video's pixels are not square.
    """
    opened = open_video(video)
    try:
        across, down = _stretch(opened)
        for index in itertools.count():
            if (chosen is not None and index > chosen[-1]) or not opened.grab():
                return
            if chosen is None or index in chosen:
                good, frame = opened.retrieve()
                if not good:
                    return
                size = round(across * frame.shape[1]), round(down * frame.shape[0])
                yield index, cv2.resize(frame, size, interpolation=cv2.INTER_CUBIC)
    finally:
        opened.release()


def _stretch(opened: cv2.VideoCapture) -> tuple[float, float]:
    """Return factors of a frame's width and height, at least 1, that make its pixels square."""
    ratio = opened.get(cv2.CAP_PROP_SAR_NUM) / (opened.get(cv2.CAP_PROP_SAR_DEN) or 1)
    if not 1 / _WIDEST <= ratio <= _WIDEST:  # as files that do not say it have 0
        return 1.0, 1.0
    if opened.get(cv2.CAP_PROP_ORIENTATION_META) % 180:  # frames are turned, the ratio is not
        ratio = 1 / ratio
    return max(1.0, ratio), max(1.0, 1 / ratio)


def _reduced(gray: np.ndarray, width: int) -> np.ndarray:
    if gray.shape[1] <= width:
        return gray
    height = max(1, round(gray.shape[0] * width / gray.shape[1]))
    return cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)


def _jpeg(frame: np.ndarray) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return cv2.imencode(".jpg", frame, options)[1].tobytes()
