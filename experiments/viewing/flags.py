"""Flags of the programs that load a stored run, and the run that the flags name."""

import pathlib

from absl import flags

from experiments.training import set_flag
from experiments.training.stored_run import (
    RunError,
    StoredRun,
    change_settings,
    choose_stage,
    read_run,
)


FLAGS = flags.FLAGS
flags.adopt_module_key_flags(set_flag)
flags.DEFINE_string("run", None, "folder of a run of experiments.run")
flags.DEFINE_string("stage", None, "stage to render; default: closeup, else control, else baseline")
flags.DEFINE_string(
    "data", None, "folder of the run's capture, if the capture was moved since training"
)


def run_from_flags() -> tuple[StoredRun, str]:
    """Return the run that `--run` names, with the settings of `--set`, and the stage to render.

    Raises:
      RunError: the run, the stage or a setting does not exist.
    """
    if FLAGS.run is None:
        raise RunError("--run is missing: name the folder of a run of experiments.run")
    run = read_run(pathlib.Path(FLAGS.run))
    return change_settings(run, FLAGS.set), choose_stage(run, FLAGS.stage)
