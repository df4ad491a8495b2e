"""Volume rendering: rays and samples, encodings, networks, compositing, and the fields on them."""

from jaxcloseup.volume.compositing import Composite, composite, composite_intervals
from jaxcloseup.volume.cones import (
    Moments,
    frustum_gaussians,
    frustum_moments,
    frustum_samples,
    integrated_encoding,
)
from jaxcloseup.volume.coordinates import contract, contraction_scale, spaced, unspaced
from jaxcloseup.volume.depth_supervision import (
    DepthSupervision,
    Sightings,
    depth_divergence,
    mean_divergence,
)
from jaxcloseup.volume.encodings import positional_encoding
from jaxcloseup.volume.hash_grid import HashGridConfig, grid_rows, hash_features, init_hash_grid
from jaxcloseup.volume.interpolation import weighted_rows
from jaxcloseup.volume.intervals import Histogram, IntervalConfig, Round, interval_field
from jaxcloseup.volume.mipnerf import MipNerfConfig, mipnerf
from jaxcloseup.volume.nerf import NerfConfig, nerf
from jaxcloseup.volume.networks import (
    Raw,
    apply_mlp,
    apply_network,
    dense,
    exponential_density,
    init_mlp,
    init_network,
    rays_in_cache,
)
from jaxcloseup.volume.ngp import NgpConfig, ngp
from jaxcloseup.volume.rays import Rays, Traced, VolumeAux, photometric_loss, ray_field
from jaxcloseup.volume.regularizers import (
    antialiased_proposal_penalty,
    distortion,
    proposal_penalty,
)
from jaxcloseup.volume.renderer import Samples, VolumeConfig, volume_field
from jaxcloseup.volume.samplers import importance, interval_quantiles, resample, stratified, widen
from jaxcloseup.volume.tensorf import TensorfBuffers, TensorfConfig, factor_products, tensorf
from jaxcloseup.volume.zipnerf import (
    ZipNerfConfig,
    downweighted_features,
    mean_squares,
    zipnerf,
)


__all__ = [
    "Composite",
    "DepthSupervision",
    "HashGridConfig",
    "Histogram",
    "IntervalConfig",
    "MipNerfConfig",
    "Moments",
    "NerfConfig",
    "NgpConfig",
    "Raw",
    "Rays",
    "Round",
    "Samples",
    "Sightings",
    "TensorfBuffers",
    "TensorfConfig",
    "Traced",
    "VolumeAux",
    "VolumeConfig",
    "ZipNerfConfig",
    "antialiased_proposal_penalty",
    "apply_mlp",
    "apply_network",
    "composite",
    "composite_intervals",
    "contract",
    "contraction_scale",
    "dense",
    "depth_divergence",
    "distortion",
    "downweighted_features",
    "exponential_density",
    "factor_products",
    "frustum_gaussians",
    "frustum_moments",
    "frustum_samples",
    "grid_rows",
    "hash_features",
    "importance",
    "init_hash_grid",
    "init_mlp",
    "init_network",
    "integrated_encoding",
    "interval_field",
    "interval_quantiles",
    "mean_divergence",
    "mean_squares",
    "mipnerf",
    "nerf",
    "ngp",
    "photometric_loss",
    "positional_encoding",
    "proposal_penalty",
    "ray_field",
    "rays_in_cache",
    "resample",
    "spaced",
    "stratified",
    "tensorf",
    "unspaced",
    "volume_field",
    "weighted_rows",
    "widen",
    "zipnerf",
]
