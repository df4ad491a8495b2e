"""Mip-Splatting (Yu et al. 2024): volumetric Gaussians with a filter in space and one in images."""

import dataclasses

from jaxcloseup.app.methods import gaussians
from jaxcloseup.app.methods.gaussians import GaussianTrainingConfig
from jaxcloseup.app.methods.method import Preset


_MOST = 1024  # a divisor that no photograph is reduced by: the filter is that of reduced ones


def with_filters(preset: Preset) -> Preset:
    """Return the preset with both filters, in space for photographs as large as steps read.

    Where settings or a scene have steps read smaller photographs, `bound_filter` follows.
    """
    reduced = preset.downscale or _MOST
    finest = reduced if preset.windows is None else preset.windows.finest
    coarse = preset.coarse
    if coarse is not None:
        coarse = dataclasses.replace(coarse, field=_filtered(coarse.field, reduced))
    field = _filtered(preset.field, finest)
    return dataclasses.replace(preset, method="mip_gaussians", field=field, coarse=coarse)


def _filtered(config: GaussianTrainingConfig, finest: int) -> GaussianTrainingConfig:
    raster = dataclasses.replace(config.raster, antialias=True)
    return dataclasses.replace(config, smoothed_at=finest, raster=raster)


METHOD = dataclasses.replace(
    gaussians.METHOD,
    help="Mip-Splatting, 3D Gaussians that are filtered (Yu et al. 2024)",
    presets={name: with_filters(preset) for name, preset in gaussians.METHOD.presets.items()},
)
