"""Look at a finished or cut-off run in a browser, choose close-ups there and have them rendered.

    python -m experiments.view --run=outputs/table/surfels/...

Surfels are shown as Gaussian splats, of a NeRF the points that it began with. A click on the scene
puts a camera in front of what is there, a click on a training camera brings one there. What is
shown below the buttons is rendered by the run's own renderer. All who look share one camera and one
picture. Needs the extra "viewer".
"""

import contextlib
import sys

from absl import app, flags

from experiments.command_line import set_up
from experiments.training.stored_run import RunError, load_run_scene, restore
from experiments.viewing.flags import named_run
from jaxcloseup.artifacts.checkpoints import CheckpointError
from jaxcloseup.scene import SceneError


FLAGS = flags.FLAGS
for _name in ("run", "stage", "data", "set"):
    flags.declare_key_flag(_name)
flags.DEFINE_string("host", "127.0.0.1", "address to serve at; by default for this computer alone")
flags.DEFINE_integer("port", 7007, "port to serve at", lower_bound=1, upper_bound=65535)


def main(argv: list[str]) -> None:
    """Serve the run that the flags name until interrupted."""
    if len(argv) > 1:
        raise app.UsageError(f"unexpected argument: {argv[1]}")
    set_up()
    try:
        from experiments.viewing import page, server
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        sys.exit('experiments.view: needs viser: install jaxcloseup with the extra "viewer"')
    try:
        record, stage = named_run()
        server.check_address(FLAGS.host, FLAGS.port)
        scene = load_run_scene(record, FLAGS.data)
        programs, state = restore(record, scene, stage)
        server = server.serve(FLAGS.host, FLAGS.port)
        page = page.Viewer(server, programs, state, stage=stage, seed=record.identity["seed"])
    except (RunError, server.ServeError, SceneError, CheckpointError, OSError) as error:
        sys.exit(f"experiments.view: {error}")
    print(f"open http://{FLAGS.host}:{FLAGS.port} in a browser; Ctrl-C ends this", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            page.work()
    server.stop()


if __name__ == "__main__":
    app.run(main)
