"""The viewer of a stored run: what `experiments.view` does."""

import sys

from absl import flags

from jaxcloseup.app import progress
from jaxcloseup.app.cli.start import set_up
from jaxcloseup.app.run.kept_detail import detail_path
from jaxcloseup.app.store.stored_run import RunError, load_run_scene, restore
from jaxcloseup.app.view.chosen_run import run_from_flags
from jaxcloseup.artifacts.checkpoints import CheckpointError
from jaxcloseup.photos.scene import SceneError


FLAGS = flags.FLAGS


def main() -> None:
    """Serve the run that the flags name until Ctrl-C."""
    set_up()
    try:
        from jaxcloseup.app.view import server, visitor
        from jaxcloseup.app.view import viewer as page
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        sys.exit('experiments.view: viser is missing: install jaxcloseup with the extra "viewer"')
    try:
        with progress.showing():
            record, stage = run_from_flags()
            server.check_address(FLAGS.host, FLAGS.port)
            scene = load_run_scene(record, FLAGS.data)
            programs, state = restore(record, scene, stage)
            viser_server = server.serve(FLAGS.host, FLAGS.port)
            viewer = page.Viewer(
                viser_server,
                programs,
                state,
                stage=stage,
                seed=record.identity["seed"],
                kept=detail_path(record.folder, stage),
            )
            visitor.welcome_visitors(viser_server, viewer)
    except (RunError, server.ServeError, SceneError, CheckpointError, OSError) as error:
        sys.exit(f"experiments.view: {error}")
    print(f"open http://{FLAGS.host}:{FLAGS.port} in a browser; press Ctrl-C to stop", flush=True)
    while True:
        viewer.work()
