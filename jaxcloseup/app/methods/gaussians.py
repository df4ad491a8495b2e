"""3D Gaussian splatting (Kerbl et al. 2023): volumetric Gaussians in place of surfels."""

import dataclasses

from jaxcloseup.app.methods import surfels
from jaxcloseup.app.methods.method import Preset, TargetConfig
from jaxcloseup.fields.splats.config import GaussianConfig


@dataclasses.dataclass(frozen=True)
class GaussianTrainingConfig(surfels.SplatTraining, GaussianConfig):
    """Volumetric Gaussians and their training."""


def of_gaussians(preset: Preset) -> Preset:
    """Return the preset for volumetric Gaussians: the same training, the published filter."""
    coarse = preset.coarse
    if coarse is not None:
        coarse = dataclasses.replace(coarse, field=_as_gaussians(coarse.field))
    field = _as_gaussians(preset.field)
    return dataclasses.replace(preset, method="gaussians", field=field, coarse=coarse)


def _as_gaussians(config: surfels.SurfelTrainingConfig) -> GaussianTrainingConfig:
    names = {field.name for field in dataclasses.fields(GaussianTrainingConfig)}
    values = {name: value for name, value in vars(config).items() if name in names}
    raster = dataclasses.replace(config.raster, antialias=False)
    return GaussianTrainingConfig(**values | {"distortion_weight": 0.0, "raster": raster})


def _pruned_as_published(preset: Preset) -> Preset:
    """Return the preset of clone, split and prune that keeps fainter splats than surfels'."""
    density = dataclasses.replace(preset.field.density, min_opacity=0.005)
    return dataclasses.replace(preset, field=dataclasses.replace(preset.field, density=density))


PAPER_MCMC = of_gaussians(surfels.PAPER)
PAPER = _pruned_as_published(of_gaussians(surfels.PAPER_ADAPTIVE))
_QUICK = of_gaussians(surfels.QUICK)
# The published learning rates; what is faster for surfels was not measured for volumes.
QUICK = dataclasses.replace(
    _QUICK,
    field=dataclasses.replace(
        _QUICK.field, sh_lr=2.5e-3, scale_lr=5e-3, max_scale=0.5, surfels_per_target=0
    ),
    targets=TargetConfig("residual", lr_scale=5.0, control_lr_scale=5.0),
)
QUICK_ADAPTIVE = _pruned_as_published(of_gaussians(surfels.QUICK_ADAPTIVE))

METHOD = dataclasses.replace(
    surfels.METHOD,
    help="3D Gaussian splatting (Kerbl et al. 2023)",
    presets={
        "quick": QUICK,
        "paper": PAPER,
        "quick_adaptive": QUICK_ADAPTIVE,
        "paper_mcmc": PAPER_MCMC,
    },
)
