"""Flags of the programs that load a stored run."""

from absl import flags

from jaxcloseup.app.cli import set_flag


flags.adopt_module_key_flags(set_flag)
flags.DEFINE_string("run", None, "folder of a run of experiments.run")
flags.DEFINE_string("stage", None, "stage to render; default: closeup, else control, else baseline")
flags.DEFINE_string(
    "data", None, "folder of the run's capture, if the capture was moved since training"
)
