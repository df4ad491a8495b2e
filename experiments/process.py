"""Make a capture with poses from photographs or a video, by structure from motion with COLMAP.

    python -m experiments.process --images=photographs --output_dir=capture
    python -m experiments.process --video=walk.mp4 --count=100 --output_dir=capture

The capture, a COLMAP model and its photographs, is what `experiments.run --scene=capture` reads.
The same command continues a process that was cut off after its last finished stage. The same
photographs give the same poses on the same machine.
"""

import os
import pathlib
import shlex
import sys

from absl import app, flags

import experiments
from experiments.command_line import check_unused, lock_output_dir, set_up, start
from experiments.processing.frames import LARGEST
from experiments.processing.jobs import ProcessingError, check_pycolmap
from experiments.processing.pairs import MOST_EXHAUSTIVE, PAIRINGS
from experiments.processing.photographs import FEWEST
from experiments.processing.pipeline import LENSES, PICTURE, Request, make_capture
from experiments.processing.stages import NAME, Stages
from experiments.processing.summary import summary_lines
from jaxcloseup.files import check_file
from jaxcloseup.scene import SceneError


FLAGS = flags.FLAGS
COUNT = 100
flags.declare_key_flag("output_dir")
flags.DEFINE_string("images", None, "folder of photographs")
flags.DEFINE_string("video", None, "a video, instead of photographs")
flags.DEFINE_integer(
    "count",
    None,
    f"largest number of frames to take from the video; default: {COUNT}",
    lower_bound=FEWEST,
)
flags.DEFINE_enum(
    "lens",
    "perspective",
    list(LENSES),
    "kind of lens; its distortion is measured, and undone when the capture is read",
)
flags.DEFINE_enum(
    "pairs",
    "auto",
    ["auto", *PAIRINGS],
    "which photographs are matched: exhaustive, all; sequential, neighbors and similar ones; "
    "retrieval, similar ones; auto, sequential for a video, exhaustive for up to "
    f"{MOST_EXHAUSTIVE} photographs, else retrieval",
)


def _check_flags() -> tuple[Request, pathlib.Path]:
    """Return what the flags ask for and the folder of the capture; nothing is written."""
    if (FLAGS.images is None) == (FLAGS.video is None):
        raise ProcessingError("give either --images=FOLDER or --video=FILE")
    if FLAGS.output_dir is None:
        raise ProcessingError("--output_dir is missing: name the folder of the capture")
    if FLAGS.images is not None and FLAGS.count is not None:
        raise ProcessingError("--count is for --video: remove photographs that you do not want")
    images, video = (None if x is None else pathlib.Path(x) for x in (FLAGS.images, FLAGS.video))
    if video is not None:
        try:
            check_file(video, most=LARGEST)
        except OSError as error:
            raise ProcessingError(
                f"--video={video} cannot be read ({error.strerror}): name a video file"
            ) from error
    check_pycolmap()
    request = Request(images, video, FLAGS.count or COUNT, FLAGS.lens, FLAGS.pairs)
    return request, pathlib.Path(FLAGS.output_dir)


def _prepare_to_stop(folder: pathlib.Path) -> None:
    """Let Ctrl-C remove unfinished files, and print how to continue."""
    command = shlex.join(["python", "-m", "experiments.process", *sys.argv[1:]])

    def say() -> str:
        for part in folder.rglob(f".*.{os.getpid()}.part*"):
            part.unlink(missing_ok=True)
        return f"stopped: continue it with {command}"

    experiments.when_stopped(say)


def main(argv: list[str]) -> None:
    """Make the capture that the flags describe."""
    if len(argv) > 1:
        raise app.UsageError(f"unexpected argument: {argv[1]}")
    set_up()
    try:
        request, folder = _check_flags()
        identity = request.identity()
        if not (folder / NAME).is_file():
            check_unused(folder)
        stages = Stages(folder, identity)
        _prepare_to_stop(folder)
        with lock_output_dir(folder):
            summary = make_capture(request, folder, stages)
    except (ProcessingError, SceneError, OSError) as error:
        sys.exit(f"experiments.process: {error}")
    print("\n".join(summary_lines(summary)))
    print(f"cameras and points from above: {folder / PICTURE}")
    print(f"to train on it: jaxcloseup run --scene={shlex.quote(str(folder))}")


if __name__ == "__main__":
    start(main)
