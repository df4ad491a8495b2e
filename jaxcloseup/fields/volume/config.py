"""Configurations of volumetric fields; no JAX is imported."""

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class NerfConfig:
    """The network and its sampling; the defaults are the original's.

    Attributes:
      depth: number of layers of the trunk.
      width: width of the trunk's layers.
      skip_after: index of the trunk's layer after which the encoded position enters again.
      position_octaves: octaves of the positional encoding of positions.
      direction_octaves: octaves of the positional encoding of view directions.
      direction_width: width of the layer that sees the view direction.
      num_coarse: stratified samples per ray of the coarse network.
      num_fine: importance samples per ray; the fine network sees these and the coarse ones.
      density_noise: standard deviation of noise on raw densities, if the rendering has a key.
      background: gray level in [0, 1] behind the scene; None adds nothing, which is black.
      chunk: rays rendered at once; None leaves the choice to `rays_in_cache`.
      compute_dtype: "float32" or "bfloat16" for the operands of the network's products.
    """

    depth: int = 8
    width: int = 256
    skip_after: int = 4
    position_octaves: int = 10
    direction_octaves: int = 4
    direction_width: int = 128
    num_coarse: int = 64
    num_fine: int = 64
    density_noise: float = 1.0
    background: float | None = None
    chunk: int | None = None
    compute_dtype: str = "float32"


@dataclasses.dataclass(frozen=True)
class MipNerfConfig:
    """The network and its samples; the defaults are the paper's.

    Attributes:
      depth: number of layers of the trunk.
      width: width of the trunk's layers.
      skip_after: index of the trunk's layer after which the encoded position enters again.
      position_octaves: octaves of the integrated positional encoding.
      direction_octaves: octaves of the positional encoding of view directions.
      direction_width: width of the layer that sees the view direction.
      num_coarse: intervals per ray of the coarse pass.
      num_fine: intervals per ray of the fine pass.
      coarse_weight: weight of the coarse colors in the loss.
      spacing: exponent of the coarse pass's spacing, see `spaced`.
      background: gray level in [0, 1] behind the scene; None adds nothing, which is black.
      chunk: rays rendered at once; None leaves the choice to `rays_in_cache`.
    """

    depth: int = 8
    width: int = 256
    skip_after: int = 4
    position_octaves: int = 16
    direction_octaves: int = 4
    direction_width: int = 128
    num_coarse: int = 128
    num_fine: int = 128
    coarse_weight: float = 0.1
    spacing: float = 1.0
    background: float | None = None
    chunk: int | None = None


@dataclasses.dataclass(frozen=True)
class HashGridConfig:
    """Sizes of the encoding; the defaults are the paper's for radiance fields.

    Attributes:
      levels: number of grids.
      features: trained numbers at each vertex.
      log2_entries: base-2 logarithm of the most entries that one level has.
      coarsest: cells along each side of the first grid.
      finest: cells along each side of the last grid.
    """

    levels: int = 16
    features: int = 2
    log2_entries: int = 19
    coarsest: int = 16
    finest: int = 2048

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells along each side of every level, eq. 2 and 3."""
        steps = max(1, self.levels - 1)
        growth = math.log(self.finest / self.coarsest) / steps
        # Rounding must not take a cell from a level that is a whole number of them.
        return tuple(
            math.floor(self.coarsest * math.exp(level * growth) + 1e-6)
            for level in range(self.levels)
        )

    @property
    def entries(self) -> tuple[int, ...]:
        """Entries of every level: its vertices, if they fit."""
        return tuple(min((n + 1) ** 3, 2**self.log2_entries) for n in self.resolutions)

    @property
    def size(self) -> int:
        """Number of features of an encoded position."""
        return self.levels * self.features


@dataclasses.dataclass(frozen=True)
class NgpConfig:
    """The encodings, networks and samples.

    Attributes:
      grid: the encoding of what is rendered.
      proposal: the encoding of the proposals' densities, which all proposals share.
      width: width of hidden layers.
      proposal_width: width of the proposals' hidden layer.
      color_layers: hidden layers of the color network; that of density has one.
      direction_octaves: octaves of the positional encoding of view directions.
      num_coarse: intervals per ray of the first proposal.
      num_middle: intervals per ray of the second proposal; 0: there is none.
      num_fine: intervals per ray that are rendered.
      spacing: exponent of the first round's spacing, see `spaced`.
      contracted: draw what lies outside the unit ball into a ball of radius 2; else positions
        outside the unit cube are those of its surface.
      distortion_weight: weight of mip-NeRF 360's distortion.
      background: gray level in [0, 1] behind the scene; None adds nothing, which is black.
      chunk: rays rendered at once.
    """

    grid: HashGridConfig = HashGridConfig()
    proposal: HashGridConfig = HashGridConfig(levels=5, log2_entries=17, finest=256)
    width: int = 64
    proposal_width: int = 16
    color_layers: int = 2
    direction_octaves: int = 4
    num_coarse: int = 256
    num_middle: int = 96
    num_fine: int = 48
    spacing: float = 1.0
    contracted: bool = False
    distortion_weight: float = 0.0
    background: float | None = None
    chunk: int = 2**15


@dataclasses.dataclass(frozen=True)
class TensorfConfig:
    """The decomposition, its growth, and the samples; the defaults are near the paper's.

    Attributes:
      coarsest: vertices along each side of the first grid.
      finest: vertices along each side of the last grid.
      growths: how often the grid grows, by about one factor.
      grow_every: steps from one growth to the next.
      density_components: products whose sum makes density, of each mode.
      color_components: products that make appearance, of each mode.
      appearance: features that the color network gets.
      width: width of its two hidden layers.
      octaves: octaves of the positional encodings of view directions and of appearance.
      density_shift: added to the sum of products before softplus.
      density_scale: density per field unit where softplus is 1.
      sparsity_weight: weight of the mean absolute density factor.
      smoothness_weight: weight of the mean squared difference of neighboring factors.
      num_coarse: intervals per ray of the first round.
      num_fine: intervals per ray that are rendered.
      spacing: exponent of the first round's spacing, see `spaced`.
      background: gray level in [0, 1] behind the scene; None adds nothing, which is black.
      chunk: rays rendered at once.
    """

    coarsest: int = 128
    finest: int = 300
    growths: int = 5
    grow_every: int = 1500
    density_components: int = 16
    color_components: int = 48
    appearance: int = 27
    width: int = 128
    octaves: int = 2
    density_shift: float = -10.0
    density_scale: float = 25.0
    sparsity_weight: float = 8e-5
    smoothness_weight: float = 0.1
    num_coarse: int = 512
    num_fine: int = 128
    spacing: float = 1.0
    background: float | None = None
    chunk: int = 2**12

    @property
    def sizes(self) -> tuple[int, ...]:
        """Vertices along each side after 0, 1, ... growths: even steps of their logarithm."""
        first, last = math.log(self.coarsest), math.log(self.finest)
        steps = max(1, self.growths)
        logarithms = [first + i * (last - first) / steps for i in range(self.growths + 1)]
        return tuple(max(2, round(math.exp(size))) for size in logarithms)


@dataclasses.dataclass(frozen=True)
class ZipNerfConfig:
    """The encodings, networks and samples; the defaults are near the paper's.

    Attributes:
      grid: the encoding of what is rendered.
      proposal: the encoding of each proposal's densities.
      width: width of hidden layers.
      color_layers: hidden layers of the color network; those of density have one.
      direction_octaves: octaves of the positional encoding of view directions.
      num_coarse: intervals per ray of the first proposal.
      num_middle: intervals per ray of the second proposal; 0: there is none.
      num_fine: intervals per ray that are rendered.
      proposal_points: Gaussians of each interval of a proposal; the paper has 6.
      points: Gaussians of each interval that is rendered; the paper has 6.
      spacing: exponent of the first round's spacing, see `spaced`.
      contracted: draw what lies outside the unit ball into a ball of radius 2; else positions
        outside the unit cube are those of its surface.
      proposal_weight: weight of the anti-aliased interlevel loss.
      distortion_weight: weight of mip-NeRF 360's distortion.
      decay_weight: weight of the mean square of each level's features.
      background: gray level in [0, 1] behind the scene; None adds nothing, which is black.
      chunk: rays rendered at once.
    """

    grid: HashGridConfig = HashGridConfig(
        levels=10, features=4, log2_entries=21, coarsest=16, finest=8192
    )
    proposal: HashGridConfig = HashGridConfig(
        levels=6, features=1, log2_entries=21, coarsest=16, finest=512
    )
    width: int = 64
    color_layers: int = 3
    direction_octaves: int = 4
    num_coarse: int = 64
    num_middle: int = 64
    num_fine: int = 32
    proposal_points: int = 6
    points: int = 6
    spacing: float = -1.5
    contracted: bool = True
    proposal_weight: float = 0.01
    distortion_weight: float = 0.01
    decay_weight: float = 0.1
    background: float | None = None
    chunk: int = 2**14
