"""Filters that suit splats to what is sampled: in images the pixel, in space the finest photograph.

A renderer samples at the centers of pixels, so a splat smaller than a pixel would show by chance.
Each kind of splat has two filters in the image: the published one, which draws it larger than it is
and as bright, and a convolution with the pixel, which keeps its light. The filter in space, the 3-D
smoothing filter of Mip-Splatting (Yu et al. 2024), bounds how small a splat is: no photograph shows
more than its pixels, and a close-up would show what was left to chance.
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.fields.splats.vectors import Vector, cross, dot, scaled
from jaxcloseup.geometry.cameras import Camera, mean_focal, points_to_pixels
from jaxcloseup.geometry.masks import in_bounds


LOW_PASS = 2.0  # 1/px^2: no disc is drawn smaller than a Gaussian of sigma = sqrt(1/2) pixel
PIXEL_VARIANCE = 1 / 12  # px^2, along each side of a square pixel
DILATION = 0.3  # px^2, by which published 3-D Gaussians grow in the image
MIP_VARIANCE = 0.1  # px^2, of Mip-Splatting's 2-D filter
SMOOTHING_VARIANCE = 0.2  # squared sampling intervals, of its 3-D filter
_SEEN_BEYOND = 0.15  # of an image's size, by which a center outside of it still counts as seen


Rows = tuple[Vector, Vector, Vector]  # of homographies
Factor = tuple[jax.Array, jax.Array, jax.Array]  # l11, l21, l22 `[N]` of Cholesky factors


def pixel_spread(homography: Rows, depth: jax.Array, known: jax.Array) -> Factor:
    """Return the Cholesky factor of I + s^2 J J^T of each disc; the identity if not known.

    J is the derivative of (u, v) by the pixel at the disc's center, and s^2 a pixel's variance. A
    disc with that covariance, whose opacity falls as its area grows, is convolved with the pixel:
    an image of fewer pixels is the mean of one of more (the elliptical weighted average of Zwicker
    et al. 2001, as the 2-D filter of Mip-Splatting).

    Args:
      homography: about the center.
      depth: `[N]` of the center.
      known: `[N]` bool.
    """
    (ux, uy), (vx, vy) = (
        [jnp.where(known, depth * slope, 0) for slope in row[1:]] for row in homography[:2]
    )
    uu, uv, vv = (
        PIXEL_VARIANCE * sums for sums in (ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy)
    )
    first = jnp.sqrt(1 + uu)
    below = uv / first
    # 1 + vv - below^2, without taking large numbers from each other.
    cross = PIXEL_VARIANCE * (ux * vy - vx * uy)
    second = jnp.sqrt((1 + uu + vv + cross * cross) / (1 + uu))
    return first, below, second


def widen(
    homography: Rows, vectors: tuple[Vector, Vector], spread: Factor
) -> tuple[Rows, tuple[Vector, Vector]]:
    """Return homographies and semi-axes of discs whose covariance of (u, v) is L L^T."""
    first, below, second = spread
    u = scaled(1 / first, homography[0])
    # L^-1 (u, v) by substitution, and L^T times the semi-axes.
    vx, vy, vz = ((b - below * a) / second for a, b in zip(u, homography[1], strict=True))
    x, y, z = (first * a + below * b for a, b in zip(*vectors, strict=True))
    return (u, (vx, vy, vz), homography[2]), ((x, y, z), scaled(second, vectors[1]))


def widen_ellipse(x: Vector, y: Vector, *, antialias: bool) -> tuple[Factor, jax.Array | float]:
    """Return ellipses in the image, with a filter.

    Args:
      x: the displacement in x, in pixels, by each of an ellipsoid's semi-axes: three of `[N]`.
      y: the displacement in y. Without a filter, x.x, x.y and y.y are the covariance.
      antialias: convolve with Mip-Splatting's 2-D filter (Yu et al. 2024, equation 10), which keeps
        the light; without it, dilate as published for 3-D Gaussian splatting.

    Returns:
      Cholesky factor of the covariance, and the factor on the opacity.
    """
    variance = MIP_VARIANCE if antialias else DILATION
    first = jnp.sqrt(dot(x, x) + variance)
    # Divided by l11 already, so that no product of four large numbers is taken.
    x, per_first = scaled(1 / first, x), variance / (first * first)
    below = dot(x, y)
    across = cross(x, y)
    area = dot(across, across)  # squared, of the ellipse without filter, by l11
    # y.y + variance - below^2, without taking large numbers from each other.
    second = jnp.sqrt(variance + area + per_first * dot(y, y))
    if not antialias:
        return (first, below, second), 1.0
    # The inner `where` keeps the gradient of a flat ellipse's root finite.
    flat = area == 0
    return (first, below, second), jnp.where(flat, 0, jnp.sqrt(jnp.where(flat, 1, area))) / second


def sampling_intervals(means: jax.Array, cameras: Camera, *, near: float) -> jax.Array:
    """Return the distance `[N]` between pixels of the photograph that shows each point finest.

    That is the least z / f (Mip-Splatting, equation 6), whether or not something hides the point.
    A point that no photograph shows gets the largest distance of the others.

    Args:
      means: `[N, 3]` world points.
      cameras: stacked `[V]`, of photographs.
      near: z-depth before which a photograph shows nothing.
    """

    def least(finest: jax.Array, camera: Camera) -> tuple[jax.Array, None]:
        pixels, depth = points_to_pixels(camera, means)
        margin = jnp.array([[camera.width, camera.height]], pixels.dtype) * _SEEN_BEYOND
        wide = jnp.array([1 + 2 * _SEEN_BEYOND], pixels.dtype)[None]
        inside = in_bounds((pixels + margin) / wide, camera.height, camera.width)
        interval = depth / mean_focal(camera.intrinsics)
        return jnp.where(inside & (depth > near), jnp.minimum(finest, interval), finest), None

    nowhere = jnp.full(means.shape[0], jnp.inf, means.dtype)
    finest, _ = lax.scan(least, nowhere, cameras)
    seen = jnp.isfinite(finest)
    return jnp.where(seen, finest, jnp.max(jnp.where(seen, finest, 0)))


def smoothed(surfels: Surfels, interval: jax.Array | None) -> Surfels:
    """Return splats convolved in space with a Gaussian of `SMOOTHING_VARIANCE` squared intervals.

    Each keeps its integral, over the plane of a disc or over space: scales grow and the opacity
    falls (Mip-Splatting, equation 9).

    Args:
      surfels: `N` splats.
      interval: `[N]` from `sampling_intervals`, which gets no gradient; None changes nothing.
    """
    if interval is None:
        return surfels
    log_scales, kept = _smooth_scales(surfels, interval)
    opacity = jnp.clip(jax.nn.sigmoid(surfels.opacity_logits) * kept, 1e-10, 1 - 1e-6)
    return surfels.replace(
        log_scales=log_scales, opacity_logits=jnp.log(opacity) - jnp.log1p(-opacity)
    )


def kept_opacity(surfels: Surfels, interval: jax.Array) -> jax.Array:
    """Return the share `[N]` of their opacities that splats keep when they are `smoothed`."""
    return _smooth_scales(surfels, interval)[1]


def _smooth_scales(surfels: Surfels, interval: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return logarithms of scales, and the share of the opacity that is kept."""
    # Scales add as variances, in logarithms, whose range no scale leaves.
    variance = lax.stop_gradient(jnp.maximum(SMOOTHING_VARIANCE * interval**2, 1e-30))
    log_scales = 0.5 * jnp.logaddexp(2 * surfels.log_scales, jnp.log(variance)[:, None])
    return log_scales, jnp.exp(jnp.sum(surfels.log_scales - log_scales, axis=-1))
