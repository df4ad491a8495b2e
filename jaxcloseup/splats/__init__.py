"""Differentiable 2-D and 3-D Gaussian splatting in plain JAX: projections, rasterizer, field."""

from jaxcloseup.splats.adaptive import AdaptiveConfig, OffsetSurfels
from jaxcloseup.splats.config import GaussianConfig, SurfelConfig
from jaxcloseup.splats.density import DensityControl, density_control
from jaxcloseup.splats.ellipsoids import project_ellipsoids
from jaxcloseup.splats.field import (
    SurfelBuffers,
    SurfelFieldAux,
    camera_extent,
    surfel_field,
    surfel_optimizer,
    with_expected_depth,
)
from jaxcloseup.splats.filters import sampling_intervals, smoothed
from jaxcloseup.splats.mcmc import McmcConfig
from jaxcloseup.splats.projection import Discs, project_discs, surfel_columns, to_camera
from jaxcloseup.splats.rasterize import Footprints, RasterizeConfig, SplatImage, rasterize
from jaxcloseup.splats.refinement import join_surfels, surfels_where_wrong
from jaxcloseup.splats.regularizers import (
    depth_to_normal,
    normal_inconsistency,
    scale_free_distortion,
)
from jaxcloseup.splats.render import SurfelAux, render_surfels
from jaxcloseup.splats.selective_adam import scale_by_selective_adam
from jaxcloseup.splats.spherical_harmonics import rgb_to_sh, sh_basis, sh_to_rgb
from jaxcloseup.splats.surfels import Surfels, random_points, surfels_from_points


__all__ = [
    "AdaptiveConfig",
    "DensityControl",
    "Discs",
    "Footprints",
    "GaussianConfig",
    "McmcConfig",
    "OffsetSurfels",
    "RasterizeConfig",
    "SplatImage",
    "SurfelAux",
    "SurfelBuffers",
    "SurfelConfig",
    "SurfelFieldAux",
    "Surfels",
    "camera_extent",
    "density_control",
    "depth_to_normal",
    "join_surfels",
    "normal_inconsistency",
    "project_discs",
    "project_ellipsoids",
    "random_points",
    "rasterize",
    "render_surfels",
    "rgb_to_sh",
    "sampling_intervals",
    "scale_by_selective_adam",
    "scale_free_distortion",
    "sh_basis",
    "sh_to_rgb",
    "smoothed",
    "surfel_columns",
    "surfel_field",
    "surfel_optimizer",
    "surfels_from_points",
    "surfels_where_wrong",
    "to_camera",
    "with_expected_depth",
]
