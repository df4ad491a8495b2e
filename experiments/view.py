"""View a finished or interrupted run in a browser, and choose close-ups to render there.

    python -m experiments.view --run=outputs/table/surfels/...

The page shows surfels as Gaussian splats, and a NeRF as the points that it started from. A click on
the scene puts a close-up camera in front of that point; a click on a training camera moves you to
it. The run's own renderer makes the pictures below the buttons. All visitors share one close-up
camera and one picture. The program needs the extra "viewer".
"""

import sys

from absl import app, flags

from experiments.command_line import set_up, start
from experiments.training.detail import detail_path
from experiments.training.stored_run import RunError, load_run_scene, restore
from experiments.viewing.flags import run_from_flags
from jaxcloseup.artifacts.checkpoints import CheckpointError
from jaxcloseup.scene import SceneError


FLAGS = flags.FLAGS
for _name in ("run", "stage", "data", "set"):
    flags.declare_key_flag(_name)
flags.DEFINE_string(
    "host", "127.0.0.1", "address to serve at; the default serves this computer only"
)
flags.DEFINE_integer("port", 7007, "port to serve at", lower_bound=1, upper_bound=65535)


def main(argv: list[str]) -> None:
    """Serve the run that the flags name until Ctrl-C."""
    if len(argv) > 1:
        raise app.UsageError(f"unexpected argument: {argv[1]}")
    set_up()
    try:
        from experiments.viewing import page, server
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        sys.exit('experiments.view: viser is missing: install jaxcloseup with the extra "viewer"')
    try:
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
    except (RunError, server.ServeError, SceneError, CheckpointError, OSError) as error:
        sys.exit(f"experiments.view: {error}")
    print(f"open http://{FLAGS.host}:{FLAGS.port} in a browser; press Ctrl-C to stop", flush=True)
    while True:
        viewer.work()


if __name__ == "__main__":
    start(main)
