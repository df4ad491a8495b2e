"""Poses from photographs or a video: what `experiments.process` does."""

import os
import pathlib
import shlex
import sys

from absl import flags

from jaxcloseup.app.cli.interrupt import when_stopped
from jaxcloseup.app.cli.start import check_unused, lock_output_dir, set_up
from jaxcloseup.app.process.capture_stages import NAME, Stages
from jaxcloseup.app.process.capture_summary import summary_lines
from jaxcloseup.app.process.choices import COUNT
from jaxcloseup.app.process.pipeline import PICTURE, Request, make_capture
from jaxcloseup.app.process.solver_process import ProcessingError, check_pycolmap
from jaxcloseup.app.process.video_frames import LARGEST
from jaxcloseup.app.progress import showing
from jaxcloseup.io.files import check_file
from jaxcloseup.photos.scene import SceneError


FLAGS = flags.FLAGS


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

    when_stopped(say)


def main() -> None:
    """Make the capture that the flags describe."""
    set_up()
    try:
        request, folder = _check_flags()
        identity = request.identity()
        if not (folder / NAME).is_file():
            check_unused(folder)
        stages = Stages(folder, identity)
        _prepare_to_stop(folder)
        with lock_output_dir(folder), showing():
            summary = make_capture(request, folder, stages)
    except (ProcessingError, SceneError, OSError) as error:
        sys.exit(f"experiments.process: {error}")
    print("\n".join(summary_lines(summary)))
    print(f"cameras and points from above: {folder / PICTURE}")
    print(f"to train on it: jaxcloseup run --scene={shlex.quote(str(folder))}")
