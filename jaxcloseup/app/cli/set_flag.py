"""The flag `--set`, which the programs that train share with those that load a stored run."""

from absl import flags


flags.DEFINE_multi_string(
    "set",
    [],
    "name=value changes a setting of the preset, as in --set label_loss_weight=0.1 or --set "
    "magnification=2:4; repeatable; --set=help lists all settings with the values that they have",
)
