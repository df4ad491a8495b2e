"""DS-NeRF: a NeRF whose depth the capture's points supervise (Deng et al., CVPR 2022)."""

import dataclasses

from experiments.methods import nerf
from experiments.methods.method import Preset


def supervised(preset: Preset) -> Preset:
    """The NeRF's preset with the paper's weight of depth."""
    field = dataclasses.replace(preset.field, depth_weight=0.1)
    return dataclasses.replace(preset, method="dsnerf", field=field)


METHOD = nerf.METHOD._replace(
    presets={"quick": supervised(nerf.QUICK), "paper": supervised(nerf.PAPER)},
)
