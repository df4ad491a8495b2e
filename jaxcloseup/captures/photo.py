"""`Photo`: a decoded photograph with its mask and camera, and how it is read."""

from typing import NamedTuple

import numpy as np

from jaxcloseup.captures.mask_values import MaskValues
from jaxcloseup.captures.photo_files import size_of_image
from jaxcloseup.captures.scale import check_lens
from jaxcloseup.captures.world_frames import Frame, frame_intrinsics


TRANSPARENT, CONSTANT = "fully transparent", "constant"  # flaws of photographs


class Reading(NamedTuple):
    """How to read photographs; `load_scene` documents the options.

    Attributes:
      downscale: positive integer factor by which to shrink photographs, by averaging areas.
      zoom: further such factor; if not 1, the `test` frames become crops of training photographs
        that skip this factor.
      background: gray level in [0, 1] behind transparent pixels.
      half_pixel: whether the files put pixel centers at integers.
      alpha_mode: one of `ALPHA_MODES`; transparent pixels show the background, weigh less, or are
        like others.
      invert_masks: whether masks mark ignored pixels in white.
      masks: what the values of masks mean.
    """

    downscale: int = 1
    zoom: int = 1
    background: float = 1.0
    half_pixel: bool = False
    alpha_mode: str = "blend"
    invert_masks: bool = False
    masks: MaskValues = MaskValues()


class Photo(NamedTuple):
    """A photograph after downscaling, or a crop of it."""

    frame: Frame  # frame that was read
    rgb: np.ndarray  # `[H, W, 3]` uint8 colors
    mask: np.ndarray  # `[H, W]` uint8 weights, 255 where the pixel counts fully
    stored_size: tuple[int, int]  # (width, height) of the file's image
    # (width, height) of the whole photograph at this scale, before trimming; may be fractional
    scaled: tuple[float, float]
    # (x, y) of the crop's first pixel in the whole photograph at this scale
    corner: tuple[int, int] = (0, 0)
    flaw: str = ""  # TRANSPARENT or CONSTANT, or nothing

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height in pixels."""
        return self.rgb.shape[1], self.rgb.shape[0]

    @property
    def own_size(self) -> tuple[int, int]:
        """Return width and height of the photograph before it was reduced."""
        return (whole_size(self.frame) if self.frame.reduced else None) or self.stored_size

    def intrinsics(self, half_pixel: bool) -> np.ndarray:
        """Compute fx, fy, cx, cy `[4]` in pixels; `half_pixel` as in `Reading`."""
        whole = resized_intrinsics(self.frame, self.stored_size, self.scaled, half_pixel)
        return whole - np.array([0, 0, *self.corner])


def whole_size(frame: Frame) -> tuple[int, int] | None:
    """Return width and height of a frame's file, which may have a reduced copy; None if unknown."""
    size = size_of_image(frame.file) or frame.size
    return size[::-1] if size and frame.turns % 2 else size


def resized_intrinsics(
    frame: Frame, stored: tuple[int, int], new: tuple[float, float], half_pixel: bool
) -> np.ndarray:
    """Compute fx, fy, cx, cy for the photograph of size `stored` resized to `new`.

    Raises:
      SceneError: no lens of such a photograph has these intrinsics.
    """
    size = frame.size or stored
    intrinsics = frame_intrinsics(frame, *size, half_pixel=half_pixel)
    check_lens(frame.label, intrinsics, *size)
    return intrinsics * np.tile(np.divide(new, size), 2)
