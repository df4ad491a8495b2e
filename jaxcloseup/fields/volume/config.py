"""Configurations of volumetric fields; no JAX is imported."""

import dataclasses
import math

from jaxcloseup.setting import setting


@dataclasses.dataclass(frozen=True)
class _TrunkConfig:
    """The network that NeRF and mip-NeRF share."""

    depth: int = setting(8, "layers of the trunk", low=1, high=64)
    width: int = setting(256, "width of the trunk's layers", low=1)
    skip_after: int = setting(
        4, "index of the trunk's layer after which the encoded position enters again"
    )
    position_octaves: int = setting(10, "octaves of the positional encoding of positions", high=64)
    direction_octaves: int = setting(
        4, "octaves of the positional encoding of view directions", high=64
    )
    direction_width: int = setting(128, "width of the layer that sees the view direction", low=1)


@dataclasses.dataclass(frozen=True)
class NerfConfig(_TrunkConfig):
    """The network and its sampling; the defaults are the original's."""

    num_coarse: int = setting(64, "stratified samples per ray of the coarse network", low=2)
    num_fine: int = setting(
        64, "importance samples per ray; the fine network sees these and the coarse ones", low=1
    )
    density_noise: float = setting(1.0, "standard deviation of noise on raw densities in training")
    background: float | None = setting(
        None, "gray level behind the scene; none adds nothing, which is black", high=1
    )
    chunk: int | None = setting(
        None, "rays rendered at once; none chooses by `rays_in_cache`", low=1
    )
    compute_dtype: str = setting(
        "float32", "type of the operands of the network's products", choices=("float32", "bfloat16")
    )


@dataclasses.dataclass(frozen=True)
class MipNerfConfig(_TrunkConfig):
    """The network and its samples; the defaults are the paper's."""

    position_octaves: int = setting(16, "octaves of the integrated positional encoding", high=64)
    num_coarse: int = setting(128, "intervals per ray of the coarse pass", low=1)
    num_fine: int = setting(128, "intervals per ray of the fine pass", low=1)
    coarse_weight: float = setting(0.1, "weight of the coarse colors in the loss")
    spacing: float = setting(
        1.0, "exponent of the coarse pass's spacing, see `spaced`", low=-100, high=1
    )
    background: float | None = setting(
        None, "gray level behind the scene; none adds nothing, which is black", high=1
    )
    chunk: int | None = setting(
        None, "rays rendered at once; none chooses by `rays_in_cache`", low=1
    )


@dataclasses.dataclass(frozen=True)
class HashGridConfig:
    """Sizes of the encoding; the defaults are the paper's for radiance fields."""

    levels: int = setting(16, "number of grids", low=1, high=64)
    features: int = setting(2, "trained numbers at each vertex", low=1, high=64)
    log2_entries: int = setting(
        19, "base-2 logarithm of the largest number of entries of a level", low=1, high=28
    )
    coarsest: int = setting(16, "cells along each side of the first grid", low=1, high=2**20)
    finest: int = setting(2048, "cells along each side of the last grid", low=1, high=2**20)

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Return the cells along each side of every level, eq. 2 and 3."""
        steps = max(1, self.levels - 1)
        growth = math.log(self.finest / self.coarsest) / steps
        # Rounding must not take a cell from a level that is a whole number of them.
        return tuple(
            math.floor(self.coarsest * math.exp(level * growth) + 1e-6)
            for level in range(self.levels)
        )

    @property
    def entries(self) -> tuple[int, ...]:
        """Return the entries of every level: its vertices, if they fit."""
        return tuple(min((n + 1) ** 3, 2**self.log2_entries) for n in self.resolutions)

    @property
    def size(self) -> int:
        """Return the number of features of an encoded position."""
        return self.levels * self.features


@dataclasses.dataclass(frozen=True)
class NgpConfig:
    """The encodings, networks and samples."""

    grid: HashGridConfig = setting(HashGridConfig(), "hash grid of the rendered density and color")
    proposal: HashGridConfig = setting(
        HashGridConfig(levels=5, log2_entries=17, finest=256),
        "hash grid of the proposals' density, shared by all proposals",
    )
    width: int = setting(64, "width of hidden layers", low=1)
    proposal_width: int = setting(16, "width of the proposals' hidden layer", low=1)
    color_layers: int = setting(
        2, "hidden layers of the color network; the density network has one", high=64
    )
    direction_octaves: int = setting(
        4, "octaves of the positional encoding of view directions", high=64
    )
    num_coarse: int = setting(256, "intervals per ray of the first proposal", low=1)
    num_middle: int = setting(96, "intervals per ray of the second proposal; 0 leaves it out")
    num_fine: int = setting(48, "intervals per ray that are rendered", low=1)
    spacing: float = setting(
        1.0, "exponent of the first round's spacing, see `spaced`", low=-100, high=1
    )
    contracted: bool = setting(
        False,
        "contract space outside the unit ball into a ball of radius 2; otherwise positions are "
        "clamped to the unit cube",
    )
    distortion_weight: float = setting(0.0, "weight of mip-NeRF 360's distortion")
    background: float | None = setting(
        None, "gray level behind the scene; none adds nothing, which is black", high=1
    )
    chunk: int = setting(2**15, "rays rendered at once", low=1)


@dataclasses.dataclass(frozen=True)
class TensorfConfig:
    """The decomposition, its growth, and the samples; the defaults are near the paper's."""

    coarsest: int = setting(128, "vertices along each side of the first grid", low=1)
    finest: int = setting(300, "vertices along each side of the last grid", low=1)
    growths: int = setting(5, "number of times that the grid grows, by about the same factor each")
    grow_every: int = setting(1500, "steps from one growth to the next", low=1)
    density_components: int = setting(16, "products of each mode that sum to density", low=1)
    color_components: int = setting(48, "products of each mode that make appearance", low=1)
    appearance: int = setting(27, "appearance features, the color network's input", low=1)
    width: int = setting(128, "width of the color network's two hidden layers", low=1)
    octaves: int = setting(
        2, "octaves of the positional encodings of view directions and of appearance", high=64
    )
    density_shift: float = setting(
        -10.0, "added to the sum of products before softplus", low=-1e6, high=1e6
    )
    density_scale: float = setting(25.0, "density per field unit where softplus is 1")
    sparsity_weight: float = setting(8e-5, "weight of the mean absolute density factor")
    smoothness_weight: float = setting(
        0.1, "weight of the mean squared difference of neighboring factors"
    )
    num_coarse: int = setting(512, "intervals per ray of the first round", low=1)
    num_fine: int = setting(128, "intervals per ray that are rendered", low=1)
    spacing: float = setting(
        1.0, "exponent of the first round's spacing, see `spaced`", low=-100, high=1
    )
    background: float | None = setting(
        None, "gray level behind the scene; none adds nothing, which is black", high=1
    )
    chunk: int = setting(2**12, "rays rendered at once", low=1)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Return the vertices a side after 0, 1, ... growths: even steps of their logarithm."""
        first, last = math.log(self.coarsest), math.log(self.finest)
        steps = max(1, self.growths)
        logarithms = [first + i * (last - first) / steps for i in range(self.growths + 1)]
        return tuple(max(2, round(math.exp(size))) for size in logarithms)


@dataclasses.dataclass(frozen=True)
class ZipNerfConfig:
    """The encodings, networks and samples; the defaults are near the paper's."""

    grid: HashGridConfig = setting(
        HashGridConfig(levels=10, features=4, log2_entries=21, coarsest=16, finest=8192),
        "hash grid of the rendered density and color",
    )
    proposal: HashGridConfig = setting(
        HashGridConfig(levels=6, features=1, log2_entries=21, coarsest=16, finest=512),
        "hash grid of each proposal's density",
    )
    width: int = setting(64, "width of hidden layers", low=1)
    color_layers: int = setting(
        3, "hidden layers of the color network; density networks have one", high=64
    )
    direction_octaves: int = setting(
        4, "octaves of the positional encoding of view directions", high=64
    )
    num_coarse: int = setting(64, "intervals per ray of the first proposal", low=1)
    num_middle: int = setting(64, "intervals per ray of the second proposal; 0 leaves it out")
    num_fine: int = setting(32, "intervals per ray that are rendered", low=1)
    proposal_points: int = setting(
        6, "Gaussians of each interval of a proposal; the paper has 6", low=1
    )
    points: int = setting(6, "Gaussians of each interval that is rendered; the paper has 6", low=1)
    spacing: float = setting(
        -1.5, "exponent of the first round's spacing, see `spaced`", low=-100, high=1
    )
    contracted: bool = setting(
        True,
        "contract space outside the unit ball into a ball of radius 2; otherwise positions are "
        "clamped to the unit cube",
    )
    proposal_weight: float = setting(0.01, "weight of the anti-aliased interlevel loss")
    distortion_weight: float = setting(0.01, "weight of mip-NeRF 360's distortion")
    decay_weight: float = setting(0.1, "weight of the mean square of each level's features")
    background: float | None = setting(
        None, "gray level behind the scene; none adds nothing, which is black", high=1
    )
    chunk: int = setting(2**14, "rays rendered at once", low=1)
