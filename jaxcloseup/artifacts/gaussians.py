"""Surfels as the 3-D Gaussians that viewers know: discs with a thickness, of one color each."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.rotations import quaternion_to_matrix
from jaxcloseup.splats.spherical_harmonics import sh_to_rgb
from jaxcloseup.splats.surfels import Surfels


_MIN_LOG_SCALE = -20.0  # what compressed PLY can hold


class Gaussians(NamedTuple):
    """`M` Gaussians in world units, NumPy, float32.

    Attributes:
      means: `[M, 3]`.
      covariances: `[M, 3, 3]` R diag(scale^2) R^T.
      rgb: `[M, 3]` in [0, 1], the mean over all directions.
      opacities: `[M]` in [0, 1].
    """

    means: np.ndarray
    covariances: np.ndarray
    rgb: np.ndarray
    opacities: np.ndarray


def thickened(log_scales: np.ndarray) -> np.ndarray:
    """Log scales `[N, 3]` of discs' `[N, 2]`: as thick as a thousandth of the smaller radius."""
    thin = log_scales.min(axis=1, keepdims=True) + np.float32(np.log(1e-3))
    return np.concatenate([log_scales, np.maximum(thin, _MIN_LOG_SCALE)], axis=1)


def as_gaussians(surfels: Surfels, alive: jax.Array) -> Gaussians:
    """The living ones of `N` surfels, `alive [N]`, that are finite."""
    rotations = np.asarray(quaternion_to_matrix(surfels.quaternions))
    axes = rotations * np.exp(thickened(np.asarray(surfels.log_scales)))[:, None, :]
    rgb = sh_to_rgb(surfels.sh[:, :1], jnp.zeros_like(surfels.means))
    found = Gaussians(
        np.asarray(surfels.means),
        axes @ axes.swapaxes(1, 2),
        np.clip(rgb, 0, 1),
        np.asarray(jax.nn.sigmoid(surfels.opacity_logits)),
    )
    finite = [np.isfinite(one).reshape(len(one), -1).all(axis=1) for one in found]
    kept = np.asarray(alive) & np.all(finite, axis=0)
    return Gaussians(*(one[kept] for one in found))
