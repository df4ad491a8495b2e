"""The flag `--set`, which the programs that train share with those that load a stored run."""

from absl import flags

from experiments.methods import METHODS
from experiments.training.settings import describe_settings


flags.DEFINE_multi_string(
    "set",
    [],
    "name=value changes a setting of the preset, as in --set label_loss_weight=0.1 or --set "
    "magnification=2:4; repeatable; " + describe_settings(METHODS),
)
