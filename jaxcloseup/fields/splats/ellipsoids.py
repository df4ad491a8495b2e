"""Volumetric Gaussians to ellipses and their boxes, for one camera: EWA splatting (Zwicker 2001).

A Gaussian of covariance S, in the camera's frame, has in the image about the covariance J S J^T,
with the derivative J of the projection at its center (Kerbl et al. 2023). Its depth is that of its
center. So it is a footprint of constant inverse depth: with the Cholesky factor L of the ellipse,
(u, v) = L^-1 (q - center).
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxcloseup.fields.splats.filters import widen_ellipse
from jaxcloseup.fields.splats.layout import Footprints
from jaxcloseup.fields.splats.projection import Discs
from jaxcloseup.fields.splats.splat_math import ALPHA_MIN
from jaxcloseup.fields.splats.vectors import Vector
from jaxcloseup.geometry.cameras import Camera


_BEYOND = 0.15  # of an image's size, outside of which J no longer follows a center


def project_ellipsoids(
    ellipsoids: Discs,
    opacity: jax.Array,
    payload: jax.Array,
    camera: Camera,
    *,
    near: float,
    antialias: bool = False,
) -> Footprints:
    """Return ellipses of volumetric Gaussians; invisible ones get opacity 0 and an empty box.

    Args:
      ellipsoids: `N` of them in the frame of `camera`, with three scales.
      opacity: `[N]` in [0, 1].
      payload: `[F, N]` values to blend.
      camera: one camera; only its intrinsics and image size are used.
      near: positive z-depth; a Gaussian whose center is nearer is not drawn.
      antialias: filter of the ellipses, see `widen_ellipse`.

    Raises:
      ValueError: `near` is not positive.
    """
    if near <= 0:
        raise ValueError(f"near must be a positive depth, not {near}")
    focal, principal = camera.intrinsics[:2], camera.intrinsics[2:]
    depth = ellipsoids.center[2]
    ahead = depth > near
    inverse_depth = 1 / jnp.where(ahead, depth, 1)
    slopes = [ellipsoids.center[i] * inverse_depth for i in range(2)]
    center = [slopes[i] * focal[i] + principal[i] for i in range(2)]
    (first, below, second), kept = widen_ellipse(
        *_image_axes(ellipsoids, slopes, inverse_depth, focal, camera), antialias=antialias
    )
    opacity = opacity * kept
    none = jnp.zeros_like(depth)
    homography = [
        [none, inverse_depth / first, none],
        [none, -inverse_depth * below / (first * second), inverse_depth / second],
        [inverse_depth, none, none],
    ]

    # The box has no derivative. Its half sizes are the roots of the covariance's diagonal.
    opacity_now, middle, first, below, second = lax.stop_gradient(
        (opacity, center, first, below, second)
    )
    box = _box(opacity_now, middle, [first, jnp.hypot(below, second)])
    drawn = ahead & (opacity_now >= ALPHA_MIN)
    return Footprints(
        anchor=jnp.stack(center),
        homography=jnp.stack([jnp.stack(row) for row in homography]),
        opacity=jnp.where(drawn, opacity, 0),
        low_pass=jnp.full_like(depth, 1e9),  # no effect: the ellipse is filtered already
        inverse_depth=jnp.stack([inverse_depth, inverse_depth]),
        payload=payload,
        order=jnp.maximum(lax.stop_gradient(depth), near),
        box=jnp.where(drawn[None], jnp.stack(box), -1),
    )


def _box(
    opacity: jax.Array, center: list[jax.Array], deviations: list[jax.Array]
) -> list[jax.Array]:
    """Return bounds x0, y0, x1, y1 `[N]` of ellipses by their standard deviations in x and y."""
    cutoff = jnp.sqrt(2 * jnp.log(jnp.maximum(opacity / ALPHA_MIN, 1)))
    # The margin keeps pixels that only just reach the cutoff in spite of rounding.
    half = [1.001 * cutoff * deviation + 0.01 for deviation in deviations]
    box = [at - to for at, to in zip(center, half, strict=True)]
    return box + [at + to for at, to in zip(center, half, strict=True)]


def _image_axes(
    ellipsoids: Discs,
    slopes: list[jax.Array],
    inverse_depth: jax.Array,
    focal: jax.Array,
    camera: Camera,
) -> tuple[Vector, Vector]:
    """Return the displacements in x and y, in pixels, by each of the ellipsoids' semi-axes.

    They are the rows of J (Kerbl et al. 2023, equation 5) times the semi-axes, so that products
    with themselves and each other are the covariance J S J^T.
    """
    frame = ellipsoids.tangent_u, ellipsoids.tangent_v, ellipsoids.normal
    axes = [
        tuple(scale * component for component in axis)
        for scale, axis in zip(ellipsoids.scales, frame, strict=True)
    ]

    def displacement(i: int, slope: jax.Array) -> Vector:
        u, v, n = (focal[i] * inverse_depth * (axis[i] - slope * axis[2]) for axis in axes)
        return u, v, n

    x, y = bounded_slopes(slopes, camera)
    return displacement(0, x), displacement(1, y)


def bounded_slopes(slopes: list[jax.Array], camera: Camera) -> list[jax.Array]:
    """Return x / z and y / z at which J is taken: at most those a little outside of the image.

    As published, for a principal point anywhere: beside the camera, J grows without bound.
    """
    bounded = []
    for i, (slope, size) in enumerate(zip(slopes, (camera.width, camera.height), strict=True)):
        focal, principal = camera.intrinsics[i], camera.intrinsics[2 + i]
        low, high = -_BEYOND * size - principal, (1 + _BEYOND) * size - principal
        bounded.append(jnp.clip(slope, low / focal, high / focal))
    return bounded
