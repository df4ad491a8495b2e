"""The methods: one module each, and the table of them, written by hand."""

from experiments.methods import nerf, surfels
from experiments.methods.method import LabelConfig, Method, Preset, pseudo_settings


METHODS: dict[str, Method] = {"nerf": nerf.METHOD, "surfels": surfels.METHOD}

__all__ = ["METHODS", "LabelConfig", "Method", "Preset", "pseudo_settings"]
