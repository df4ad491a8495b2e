"""Flags of the programs that load a stored run, and the run that they name."""

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
flags.DEFINE_string("run", None, "folder of the run")
flags.DEFINE_string("stage", None, "stage to render; default: closeup, or the last that trained")
flags.DEFINE_string("data", None, "where the run's capture lies now, if it was moved")


def named_run() -> tuple[StoredRun, str]:
    """The run that `--run` names with the settings of `--set`, and its stage that `--stage` names.

    Raises:
      RunError: there is none.
    """
    if FLAGS.run is None:
        raise RunError("--run is missing: name the folder of a run of experiments.run")
    run = read_run(pathlib.Path(FLAGS.run))
    return change_settings(run, FLAGS.set), choose_stage(run, FLAGS.stage)
