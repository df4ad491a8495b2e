"""Read the stored run that the flags name."""

import pathlib
import sys

from absl import flags

from jaxcloseup.app.methods.settings import describe_settings
from jaxcloseup.app.store.stored_run import (
    RunError,
    StoredRun,
    change_settings,
    choose_stage,
    read_run,
)


FLAGS = flags.FLAGS


def run_from_flags() -> tuple[StoredRun, str]:
    """Return the run that `--run` names, with the settings of `--set`, and the stage to render.

    `--set=help` ends the program instead.

    Raises:
      RunError: the run, the stage or a setting does not exist.
    """
    if FLAGS.run is None:
        raise RunError("--run is missing: name the folder of a run of experiments.run")
    run = read_run(pathlib.Path(FLAGS.run))
    if "help" in FLAGS.set:
        print(describe_settings(run.preset))
        sys.exit(0)
    return change_settings(run, FLAGS.set), choose_stage(run, FLAGS.stage)
