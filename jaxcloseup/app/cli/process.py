"""Make a capture with poses from photographs or a video, by structure from motion with COLMAP.

    jaxcloseup process --images=photographs --output_dir=capture
    jaxcloseup process --video=walk.mp4 --count=100 --output_dir=capture

The capture, a COLMAP model and its photographs, is what `jaxcloseup run --scene=capture` reads.
The same command continues a process that was cut off after its last finished stage. The same
photographs give the same poses on the same machine.
"""

import pathlib
import shlex
import sys
from typing import TYPE_CHECKING

from absl import flags

from jaxcloseup.app.cli.flags import OUTPUT
from jaxcloseup.app.cli.interrupt import when_stopped
from jaxcloseup.app.cli.invocation import program_command
from jaxcloseup.app.cli.output_folder import check_unused, lock_output_dir, remove_unfinished
from jaxcloseup.app.cli.start import in_one_sentence, loading, set_up
from jaxcloseup.app.cli.topics import share
from jaxcloseup.app.process.options import COUNT, FEWEST, LENSES, MOST_EXHAUSTIVE, PAIRINGS


if TYPE_CHECKING:
    from jaxcloseup.app.process.pipeline import Request

FLAGS = flags.FLAGS
share(OUTPUT)
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


def main(_: list[str]) -> None:
    """Make the capture that the flags describe."""
    with loading():
        from jaxcloseup.app import progress
        from jaxcloseup.app.process.capture_stages import NAME, Stages
        from jaxcloseup.app.process.capture_summary import summary_lines
        from jaxcloseup.app.process.pipeline import PICTURE, make_capture
        from jaxcloseup.app.process.solver_process import ProcessingError
        from jaxcloseup.app.run.capture_check import check_scene, said_of
        from jaxcloseup.photos.scene import SceneError
    set_up()
    with in_one_sentence("process", ProcessingError, SceneError, OSError):
        request, folder = _check_flags()
        identity = request.identity()
        if not (folder / NAME).is_file():
            check_unused(folder)
        stages = Stages(folder, identity)
        _prepare_to_stop(folder)
        with lock_output_dir(folder), progress.showing():
            summary = make_capture(request, folder, stages)
            found = check_scene(str(folder), {})
    print("\n".join([*summary_lines(summary), *said_of(found)]))
    print(f"cameras and points from above: {folder / PICTURE}")
    run = " ".join(program_command("run"))
    print(f"to train on it: {run} --scene={shlex.quote(str(folder))}")


def _check_flags() -> "tuple[Request, pathlib.Path]":
    """Return what the flags ask for and the folder of the capture; nothing is written."""
    from jaxcloseup.app.process.pipeline import Request
    from jaxcloseup.app.process.solver_process import ProcessingError, check_pycolmap

    if (FLAGS.images is None) == (FLAGS.video is None):
        raise ProcessingError("give either --images=FOLDER or --video=FILE")
    if FLAGS.output_dir is None:
        raise ProcessingError("--output_dir is missing: name the folder of the capture")
    if FLAGS.images is not None and FLAGS.count is not None:
        raise ProcessingError("--count is for --video: remove photographs that you do not want")
    images, video = (None if x is None else pathlib.Path(x) for x in (FLAGS.images, FLAGS.video))
    check_pycolmap()
    request = Request(images, video, FLAGS.count or COUNT, FLAGS.lens, FLAGS.pairs)
    return request, pathlib.Path(FLAGS.output_dir)


def _prepare_to_stop(folder: pathlib.Path) -> None:
    """Let Ctrl-C remove unfinished files, and print how to continue."""
    command = shlex.join([*program_command("process"), *sys.argv[1:]])

    def say() -> str:
        remove_unfinished(folder)
        return f"stopped: continue it with {command}"

    when_stopped(say)
