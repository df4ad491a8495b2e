"""The methods: one module each, and the table of them, written by hand."""

from experiments.methods import dsnerf, nerf, ngp, surfels
from experiments.methods.method import (
    CoarseConfig,
    LabelConfig,
    Method,
    Preset,
    WindowConfig,
    pseudo_settings,
)


METHODS: dict[str, Method] = {
    "nerf": nerf.METHOD,
    "dsnerf": dsnerf.METHOD,
    "ngp": ngp.METHOD,
    "surfels": surfels.METHOD,
}

__all__ = [
    "METHODS",
    "CoarseConfig",
    "LabelConfig",
    "Method",
    "Preset",
    "WindowConfig",
    "pseudo_settings",
]
