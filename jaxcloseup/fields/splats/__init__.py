"""Differentiable 2-D and 3-D Gaussian splatting in plain JAX: projections, rasterizer, field."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "adaptive": "OffsetSurfels",
        "config": "AdaptiveConfig GaussianConfig McmcConfig RasterizeConfig SurfelConfig",
        "density": "DensityControl density_control",
        "ellipsoids": "project_ellipsoids",
        "filters": "sampling_intervals smoothed",
        "projection": "Discs project_discs surfel_columns to_camera",
        "layout": "Footprints",
        "rasterize": "SplatImage",
        "refinement": "join_surfels surfels_where_wrong",
        "regularizers": "depth_to_normal normal_inconsistency scale_free_distortion",
        "render": "SurfelAux render_surfels",
        "selective_adam": "scale_by_selective_adam",
        "spherical_harmonics": "rgb_to_sh sh_basis sh_to_rgb",
        "splat_field": (
            "SurfelBuffers SurfelFieldAux camera_extent surfel_field with_expected_depth"
        ),
        "splat_optimizer": "surfel_optimizer",
        "surfels": "Surfels random_points surfels_from_points",
    },
)
