"""Differentiable 2-D Gaussian splatting in plain JAX: discs, projection, a tile rasterizer."""

from jaxcloseup.splats.rasterize import RasterizeConfig
from jaxcloseup.splats.render import SurfelAux, render_surfels
from jaxcloseup.splats.surfels import Surfels, surfels_from_points


__all__ = [
    "RasterizeConfig",
    "SurfelAux",
    "Surfels",
    "render_surfels",
    "surfels_from_points",
]
