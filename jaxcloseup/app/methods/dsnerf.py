"""DS-NeRF: a NeRF whose depth the capture's points supervise (Deng et al., CVPR 2022)."""

import dataclasses

from jaxcloseup.app.methods import nerf
from jaxcloseup.app.methods.method import Preset


# The paper's 0.1 multiplies a normal distribution that is not normalized: for a deviation of 1 cm
# in meters that is 0.0025 of a normalized one. 0.003 costs a quick NeRF 1.2 dB on ordinary views.
_DEPTH_WEIGHT = 0.001


def supervised(preset: Preset) -> Preset:
    """Return the NeRF's preset with supervision of depth."""
    field = dataclasses.replace(preset.field, depth_weight=_DEPTH_WEIGHT)
    return dataclasses.replace(preset, method="dsnerf", field=field)


METHOD = dataclasses.replace(
    nerf.METHOD,
    help="a NeRF whose depth the capture's points supervise (Deng et al. 2022)",
    presets={"quick": supervised(nerf.QUICK), "paper": supervised(nerf.PAPER)},
)
