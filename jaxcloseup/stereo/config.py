"""How depth is estimated from photographs, in plain numbers; no JAX is imported."""

import dataclasses

from jaxcloseup.setting import setting


MOST_SAMPLES = 13  # of a patch, along each side: the native library has room for as many


@dataclasses.dataclass(frozen=True)
class StereoConfig:
    """Settings of multi-view stereo."""

    neighbors: int = setting(8, "photographs that each photograph is matched with", low=1, high=32)
    best: int = setting(3, "neighbors that match best, whose mean cost counts", low=1, high=32)
    radius: int = setting(4, "pixels from a patch's center to its edge", low=1, high=12)
    stride: int = setting(2, "pixels between the samples of a patch", low=1)
    gray_sigma: float = setting(
        20.0, "difference of gray levels at which a patch's pixel has 1 / e of its weight", low=0.1
    )
    noise: float = setting(
        2.0, "variance of gray levels that counts as noise, not as contrast", low=1e-3
    )
    levels: int = setting(3, "sizes from coarse to fine, each half of the next", low=1, high=8)
    sweep: int = setting(96, "depths tried at every pixel of the coarsest size", low=1)
    iterations: tuple[int, ...] = setting(
        (2, 2, 4), "rounds of propagation and refinement at each size, from fine to coarse", low=0
    )
    min_angle: float = setting(0.05, "smallest useful angle between two rays in radians")
    max_angle: float = setting(0.45, "largest useful angle between two rays in radians")
    pixel_tolerance: float = setting(
        0.5, "pixels by which a confirmed point may miss its pixel, there and back"
    )
    depth_tolerance: float = setting(0.01, "relative difference of depths that agree")
    confirmations: int = setting(2, "photographs that must confirm a depth", low=1)
    max_cost: float = setting(0.7, "1 - NCC above which nothing is matched", high=1)

    def __post_init__(self) -> None:
        """Raise a ValueError for samples that do not lie about the center, or are too many."""
        if 2 * self.radius % self.stride or 2 * self.radius // self.stride >= MOST_SAMPLES:
            raise ValueError(
                f"stride {self.stride} must divide twice the radius {self.radius} into fewer than "
                f"{MOST_SAMPLES} parts"
            )
