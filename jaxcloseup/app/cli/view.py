"""View a finished or interrupted run in a browser, and choose close-ups to render there.

    jaxcloseup view --run=outputs/table/surfels/...

The page shows surfels as Gaussian splats, and a NeRF as the points that it started from. A click on
the scene puts a close-up camera in front of that point; a click on a training camera moves you to
it. The run's own renderer makes the pictures below the buttons. Each visitor has a close-up camera
and pictures of their own. The program needs the extra "viewer".
"""

import sys

from absl import flags

from jaxcloseup.app.cli.flags import STORED_RUN, run_from_flags
from jaxcloseup.app.cli.invocation import program_name
from jaxcloseup.app.cli.start import in_one_sentence, loading, set_up
from jaxcloseup.app.cli.topics import share


FLAGS = flags.FLAGS
share(STORED_RUN)
flags.DEFINE_string(
    "host", "127.0.0.1", "address to serve at; the default serves this computer only"
)
flags.DEFINE_integer("port", 7007, "port to serve at", lower_bound=1, upper_bound=65535)


def main(_: list[str]) -> None:
    """Serve the run that the flags name until Ctrl-C."""
    with loading():
        from jaxcloseup.app import progress
        from jaxcloseup.app.run.kept_detail import detail_path
        from jaxcloseup.app.store.stored_run import RunError, load_run_scene, restore
        from jaxcloseup.artifacts.checkpoints import CheckpointError
        from jaxcloseup.photos.scene import SceneError
    set_up()
    try:
        from jaxcloseup.app.view import server, welcome
        from jaxcloseup.app.view.viewer import Viewer
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        name = program_name("view")
        sys.exit(f'{name}: viser is missing: install jaxcloseup with the extra "viewer"')
    expected = (RunError, server.ServeError, SceneError, CheckpointError, OSError)
    with in_one_sentence("view", *expected), progress.showing():
        record, stage = run_from_flags()
        server.check_address(FLAGS.host, FLAGS.port)
        scene = load_run_scene(record, FLAGS.data)
        programs, state = restore(record, scene, stage)
        viser_server = server.serve(FLAGS.host, FLAGS.port)
        viewer = Viewer(
            viser_server, programs, state, stage=stage, kept=detail_path(record.folder, stage)
        )
        welcome.welcome_visitors(viser_server, viewer)
    print(f"open http://{FLAGS.host}:{FLAGS.port} in a browser; press Ctrl-C to stop", flush=True)
    while True:
        viewer.work()
