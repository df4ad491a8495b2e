"""The methods: one module each, and the table of them, written by hand."""

from jaxcloseup.app.methods import (
    dsnerf,
    gaussians,
    mip_gaussians,
    mipnerf,
    nerf,
    ngp,
    surfels,
    tensorf,
    zipnerf,
)
from jaxcloseup.app.methods.method import (
    CoarseConfig,
    LabelConfig,
    Method,
    Preset,
    TargetConfig,
    WindowConfig,
)
from jaxcloseup.labels.config import pseudo_settings


METHODS: dict[str, Method] = {
    "nerf": nerf.METHOD,
    "dsnerf": dsnerf.METHOD,
    "mipnerf": mipnerf.METHOD,
    "ngp": ngp.METHOD,
    "tensorf": tensorf.METHOD,
    "zipnerf": zipnerf.METHOD,
    "surfels": surfels.METHOD,
    "gaussians": gaussians.METHOD,
    "mip_gaussians": mip_gaussians.METHOD,
}

__all__ = [
    "METHODS",
    "CoarseConfig",
    "LabelConfig",
    "Method",
    "Preset",
    "TargetConfig",
    "WindowConfig",
    "pseudo_settings",
]
