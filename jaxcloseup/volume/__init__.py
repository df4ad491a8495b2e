"""Volume rendering: ray samples, encodings, compositing, a renderer, and the NeRF built on it."""

from jaxcloseup.volume.compositing import Composite, composite
from jaxcloseup.volume.encodings import positional_encoding
from jaxcloseup.volume.nerf import NerfConfig, nerf
from jaxcloseup.volume.networks import Raw, apply_network, dense, init_network
from jaxcloseup.volume.renderer import (
    Samples,
    VolumeAux,
    VolumeConfig,
    photometric_loss,
    volume_field,
)
from jaxcloseup.volume.samplers import importance, stratified


__all__ = [
    "Composite",
    "NerfConfig",
    "Raw",
    "Samples",
    "VolumeAux",
    "VolumeConfig",
    "apply_network",
    "composite",
    "dense",
    "importance",
    "init_network",
    "nerf",
    "photometric_loss",
    "positional_encoding",
    "stratified",
    "volume_field",
]
