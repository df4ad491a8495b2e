"""Convert splats to Gaussians for viewers, with one color each; discs become thin ellipsoids."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.fields.splats.spherical_harmonics import sh_to_rgb
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.geometry.numerics import safe_divide, safe_norm
from jaxcloseup.geometry.rotations import quaternion_to_matrix


_MIN_LOG_SCALE = -20.0  # the smallest that compressed PLY can hold
_colors = jax.jit(sh_to_rgb)


class Gaussians(NamedTuple):
    """`M` Gaussians in world units, as float32 NumPy arrays.

    Attributes:
      means: `[M, 3]` centers.
      covariances: `[M, 3, 3]` covariances R diag(scale^2) R^T.
      rgb: `[M, 3]` colors in [0, 1].
      opacities: `[M]` opacities in [0, 1].
    """

    means: np.ndarray
    covariances: np.ndarray
    rgb: np.ndarray
    opacities: np.ndarray


def thickened(log_scales: np.ndarray) -> np.ndarray:
    """Extend log scales `[N, 2]` to `[N, 3]` with a thickness of 1/1000 of the smaller radius.

    Those of volumetric Gaussians, `[N, 3]`, stay.
    """
    if log_scales.shape[1] == 3:
        return log_scales
    thin = log_scales.min(axis=1, keepdims=True) + np.float32(np.log(1e-3))
    return np.concatenate([log_scales, np.maximum(thin, _MIN_LOG_SCALE)], axis=1)


def as_gaussians(
    surfels: Surfels, alive: jax.Array, position: np.ndarray | None = None
) -> Gaussians:
    """Convert those of `N` surfels that are alive (`alive [N]`) and finite.

    Args:
      surfels: `N` surfels.
      alive: `[N]` bool.
      position: `[3]` where a camera is that sees their colors, by all spherical harmonics; None:
        the mean colors over all directions.
    """
    rotations = np.asarray(quaternion_to_matrix(surfels.quaternions))
    axes = rotations * np.exp(thickened(np.asarray(surfels.log_scales)))[:, None, :]
    sh, directions = surfels.sh[:, :1], jnp.zeros_like(surfels.means)
    if position is not None:
        ahead = surfels.means - jnp.asarray(position, surfels.means.dtype)[None]
        sh, directions = surfels.sh, safe_divide(ahead, safe_norm(ahead, keepdims=True))
    rgb = _colors(sh, directions)
    found = Gaussians(
        np.asarray(surfels.means),
        axes @ axes.swapaxes(1, 2),
        np.clip(rgb, 0, 1),
        np.asarray(jax.nn.sigmoid(surfels.opacity_logits)),
    )
    # Those that are left out must not depend on the position.
    checked = (*found, np.asarray(surfels.sh))
    finite = [np.isfinite(one).reshape(len(one), -1).all(axis=1) for one in checked]
    kept = np.asarray(alive) & np.all(finite, axis=0)
    return Gaussians(*(one[kept] for one in found))
