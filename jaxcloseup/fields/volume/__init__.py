"""Volume rendering: rays and samples, encodings, networks, compositing, and the fields on them."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "compositing": "Composite composite composite_intervals",
        "cones": "Moments frustum_gaussians frustum_moments frustum_samples integrated_encoding",
        "config": ("HashGridConfig MipNerfConfig NerfConfig NgpConfig TensorfConfig ZipNerfConfig"),
        "coordinates": "contract contraction_scale spaced unspaced",
        "depth_supervision": (
            "DepthSupervision PixelSupervision PointSupervision Sightings depth_divergence "
            "mean_divergence measured_divergence"
        ),
        "encodings": "positional_encoding",
        "hash_fields": "hash_field",
        "hash_grid": "grid_rows hash_features init_hash_grid",
        "interpolation": "weighted_rows",
        "intervals": "Histogram IntervalConfig Round interval_field",
        "mipnerf": "mipnerf_field",
        "nerf": "nerf_field",
        "networks": (
            "Raw apply_colors apply_mlp apply_network dense exponential_density init_colors "
            "init_mlp init_network rays_in_cache"
        ),
        "ngp": "ngp_field",
        "rays": "Extent Rays Traced VolumeAux photometric_loss ray_field",
        "regularizers": "antialiased_proposal_penalty distortion proposal_penalty",
        "renderer": "Samples VolumeConfig volume_field",
        "samplers": "importance interval_quantiles resample stratified widen",
        "tensorf": "TensorfBuffers factor_products tensorf_field",
        "zipnerf": "downweighted_features mean_squares zipnerf_field",
    },
)
