"""Check whether a capture's poses, lenses and points fit its photographs.

    jaxcloseup check capture

Photographs are matched by what they show, and the matches are held against the poses. The result is
one sentence, and a page with the cameras from above and the photographs that fit least. Where poses
do not fit, known mistakes are tried: other axes, inverse matrices, intrinsics of another size,
another order, quarter turns, points in another world. The same check begins every run.
"""

import pathlib
import sys

from absl import flags

from jaxcloseup.app.cli.flags import CAPTURE, OUTPUT
from jaxcloseup.app.cli.invocation import program_name
from jaxcloseup.app.cli.output_folder import check_unused, dated
from jaxcloseup.app.cli.start import in_one_sentence, loading, set_up
from jaxcloseup.app.cli.topics import share


FLAGS = flags.FLAGS
OPERANDS = 1  # the capture's folder
share(CAPTURE, OUTPUT)


def main(arguments: list[str]) -> None:
    """Check the capture that the command line names; exit with 1 if it does not fit."""
    name = program_name("check")
    if len(arguments) != 2:
        sys.exit(f"{name}: name one folder, as in {name} capture")
    if FLAGS.fix:
        sys.exit(f"{name}: --fix is for training: give it to {program_name('run')}")
    with loading():
        from jaxcloseup.app import progress
        from jaxcloseup.app.report.check_page import write_check
        from jaxcloseup.app.run.capture_check import check_scene, reading_of, said_of
        from jaxcloseup.captures.contents import list_photographs
        from jaxcloseup.checks.judge import MISFIT
        from jaxcloseup.photos.scene import SceneError
    set_up()
    path = pathlib.Path(arguments[1])
    options = {flag: FLAGS[flag].value for flag in CAPTURE}
    with in_one_sentence("check", SceneError, OSError):
        folder = check_unused(
            FLAGS.output_dir or dated(pathlib.Path("outputs", path.resolve().name, "check"))
        )
        with progress.showing():
            found = check_scene(str(path), options)
        listed = list_photographs(path, format=FLAGS.format)
        page = write_check(folder, path.resolve().name, found, listed, reading_of(options))
    print("\n".join([*listed.notes, *said_of(found)]))
    print(f"page: {page}")
    if found.verdict == MISFIT:
        sys.exit(1)
