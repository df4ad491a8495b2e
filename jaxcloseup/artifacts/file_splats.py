"""Splats as files of other programs hold them: those that are alive, activated, and placed."""

from typing import NamedTuple

import jax
import numpy as np

from jaxcloseup.artifacts.viewer_gaussians import thickened
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.io.placement import UNMOVED, Placement


_C0 = 0.28209479  # the spherical harmonic of degree 0
# What each basis function of spherical harmonics above degree 0 becomes where y and z change sign.
_SIGNS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


class FileSplats(NamedTuple):
    """`M` Gaussians, in the coordinates of a file.

    Attributes:
      means: `[M, 3]` float64 centers.
      log_scales: `[M, 3]` natural logarithms of the standard deviations along their axes.
      quaternions: `[M, 4]` float64 unit quaternions (w, x, y, z).
      opacities: `[M]` in [0, 1].
      sh: `[M, K, 3]` coefficients of spherical harmonics.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray

    @property
    def base_colors(self) -> np.ndarray:
        """Return the colors `[M, 3]` of degree 0, which are the same from everywhere."""
        return _C0 * self.sh[:, 0] + 0.5


def file_splats(
    surfels: Surfels, alive: jax.Array | np.ndarray, *, placement: Placement = UNMOVED
) -> tuple[FileSplats, int]:
    """Return the splats that are alive and finite as files hold them.

    Args:
      surfels: `N` surfels, which get a thickness, or volumetric Gaussians.
      alive: `[N]` bool.
      placement: of the surfels in the coordinates to write. By default they stay.

    Returns:
      The splats in their order, and the number of those alive that were dropped because a value
      is not finite.
    """
    arrays = {name: np.asarray(array, np.float32) for name, array in vars(surfels).items()}
    living = np.asarray(alive)
    finite = [np.isfinite(array).reshape(len(living), -1).all(axis=1) for array in arrays.values()]
    kept = living & np.all(finite, axis=0)
    arrays = {name: array[kept] for name, array in arrays.items()}
    quaternions = arrays["quaternions"].astype(np.float64)
    splats = FileSplats(
        means=placement.to_file(arrays["means"]),
        log_scales=thickened(arrays["log_scales"]) - np.float32(np.log(placement.scale)),
        quaternions=quaternions / np.maximum(np.linalg.norm(quaternions, axis=1)[:, None], 1e-12),
        opacities=1 / (1 + np.exp(-np.clip(arrays["opacity_logits"], -80, 80))),
        sh=arrays["sh"],
    )
    return splats, int(np.sum(living & ~kept))


def with_y_up(splats: FileSplats) -> FileSplats:
    """Turn splats by 180 degrees around x: PLY files have y down, SPZ and glTF have it up."""
    return splats._replace(
        means=splats.means * [1, -1, -1],
        quaternions=splats.quaternions * [1, 1, -1, -1],
        sh=np.concatenate(
            [splats.sh[:, :1], splats.sh[:, 1:] * _SIGNS[: splats.sh.shape[1] - 1, None]], axis=1
        ),
    )


def smallest_three(quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index `[M]` of each quaternion's largest component, and the others `[M, 3]`.

    Quaternions `[M, 4]` of unit length take the sign that makes the largest component positive, so
    the others tell it.
    """
    largest = np.abs(quaternions).argmax(axis=1)
    chosen = np.take_along_axis(quaternions, largest[:, None], axis=1)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    return largest, np.take_along_axis(quaternions, others, axis=1) * np.where(chosen < 0, -1, 1)
