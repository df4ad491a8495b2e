"""Volume rendering: rays and samples, encodings, networks, compositing, and the fields on them."""

from jaxcloseup.volume.compositing import Composite, composite, composite_intervals
from jaxcloseup.volume.coordinates import contract, contraction_scale, spaced, unspaced
from jaxcloseup.volume.depth_supervision import (
    DepthSupervision,
    Sightings,
    depth_divergence,
    mean_divergence,
)
from jaxcloseup.volume.encodings import positional_encoding
from jaxcloseup.volume.hash_grid import HashGridConfig, grid_rows, hash_features, init_hash_grid
from jaxcloseup.volume.intervals import Histogram, IntervalConfig, Round, interval_field
from jaxcloseup.volume.nerf import NerfConfig, nerf
from jaxcloseup.volume.networks import (
    Raw,
    apply_mlp,
    apply_network,
    dense,
    init_mlp,
    init_network,
)
from jaxcloseup.volume.ngp import NgpConfig, ngp
from jaxcloseup.volume.rays import Rays, Traced, VolumeAux, photometric_loss, ray_field
from jaxcloseup.volume.regularizers import distortion, proposal_penalty
from jaxcloseup.volume.renderer import Samples, VolumeConfig, volume_field
from jaxcloseup.volume.samplers import importance, interval_quantiles, resample, stratified


__all__ = [
    "Composite",
    "DepthSupervision",
    "HashGridConfig",
    "Histogram",
    "IntervalConfig",
    "NerfConfig",
    "NgpConfig",
    "Raw",
    "Rays",
    "Round",
    "Samples",
    "Sightings",
    "Traced",
    "VolumeAux",
    "VolumeConfig",
    "apply_mlp",
    "apply_network",
    "composite",
    "composite_intervals",
    "contract",
    "contraction_scale",
    "dense",
    "depth_divergence",
    "distortion",
    "grid_rows",
    "hash_features",
    "importance",
    "init_hash_grid",
    "init_mlp",
    "init_network",
    "interval_field",
    "interval_quantiles",
    "mean_divergence",
    "nerf",
    "ngp",
    "photometric_loss",
    "positional_encoding",
    "proposal_penalty",
    "ray_field",
    "resample",
    "spaced",
    "stratified",
    "unspaced",
    "volume_field",
]
