"""Surfels to planar homographies and exact boxes, for one camera.

A pixel's ray r, with r_z = 1, meets a disc with center mu, unit tangents t_u, t_v, normal
n = t_u x t_v and radii s_u, s_v at depth z with local coordinates (u, v). The three quantities

    u / z = r.(t_v x mu) / (s_u n.mu),    v / z = r.(mu x t_u) / (s_v n.mu),    1 / z = r.n / n.mu

are affine in the pixel: they are the rows of `Footprints.homography`, taken about the projected
center, where they are (0, 0, 1 / mu_z) without rounding.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.rotations import quaternion_to_matrix
from jaxcloseup.numerics import matmul, safe_norm
from jaxcloseup.splats.kernel import ALPHA_MIN
from jaxcloseup.splats.rasterize import Footprints
from jaxcloseup.splats.surfels import Surfels


LOW_PASS = 2.0  # 1/px^2: no splat is drawn smaller than a Gaussian of sigma = sqrt(1/2) pixel
PIXEL_VARIANCE = 1 / 12  # px^2, along each side of a square pixel
EDGE_ON = 1e-4  # |cos| between normal and line of sight below which a disc is not drawn
MAX_LOG_SCALE = 30.0  # beyond it, products of scales leave the range of float32


class Discs(NamedTuple):
    """`N` discs in one camera's frame, in world units.

    Attributes:
      center: `[N, 3]` centers.
      axes: `[N, 3, 3]` rotations; columns are the unit tangents t_u, t_v and the normal.
      scales: `[N, 2]` standard deviations along the tangents.
    """

    center: jax.Array
    axes: jax.Array
    scales: jax.Array


def to_camera(surfels: Surfels, camera: Camera) -> tuple[Discs, jax.Array]:
    """Discs in the camera's frame, and their normals `[N, 3]`, world frame, facing the camera."""
    axes = quaternion_to_matrix(surfels.quaternions)
    offset = surfels.means - camera.position[None]
    normal = axes[..., 2]
    away = jnp.sum(offset * normal, axis=-1, keepdims=True) > 0
    discs = Discs(
        center=matmul(offset, camera.rotation),
        axes=matmul(camera.rotation.T[None], axes),
        scales=jnp.exp(jnp.clip(surfels.log_scales, -MAX_LOG_SCALE, MAX_LOG_SCALE)),
    )
    return discs, jnp.where(away, -normal, normal)


def project_discs(
    discs: Discs,
    opacity: jax.Array,
    payload: jax.Array,
    camera: Camera,
    *,
    near: float,
    antialias: bool = False,
) -> Footprints:
    """Homographies and boxes of discs; invisible discs get opacity 0 and an empty box.

    With `antialias`, each disc is convolved with the pixel, so that an image of fewer pixels is the
    mean of one of more (the elliptical weighted average of Zwicker et al. 2001, as the 2-D filter
    of Mip-Splatting): where J is the derivative of (u, v) by the pixel at the center, and s^2 a
    pixel's variance, rho becomes (u, v) (I + s^2 J J^T)^-1 (u, v)^T, and the opacity falls as the
    disc's area grows. Without it, small discs are drawn larger than they are, as published.

    Args:
      discs: `N` discs in the frame of `camera`.
      opacity: `[N]` in [0, 1].
      payload: `[N, F]` values to blend.
      camera: one camera; only its intrinsics and image size are used.
      near: positive z-depth; nothing nearer is drawn, and a disc may reach through it.
      antialias: see above.

    Raises:
      ValueError: `near` is not positive.
    """
    if near <= 0:
        raise ValueError(f"near must be a positive depth, not {near}")
    focal, principal = camera.intrinsics[None, :2], camera.intrinsics[None, 2:]
    size = jnp.array([[camera.width, camera.height]], focal.dtype)
    mu, depth = discs.center, discs.center[:, 2]
    ahead = depth > near
    inverse_depth = 1 / jnp.where(ahead, depth, 1)
    center = mu[:, :2] * inverse_depth[:, None] * focal + principal

    # A center far outside the image, or behind the camera, is a poor origin for numbers that are
    # evaluated inside it. Any other pixel serves if the low-pass about it stays out of sight.
    margin = jnp.maximum(size, 16)
    within = jnp.all((center > -margin) & (center < size + margin), axis=-1, keepdims=True)
    centered = ahead[:, None] & within
    # Discs behind the camera are anchored at a corner of pixels, never at a pixel's center.
    corner = jnp.floor(size / 2)
    elsewhere = jnp.where(ahead[:, None], jnp.clip(center, -margin, size + margin), corner)
    anchor = jnp.where(centered, center, lax.stop_gradient(elsewhere))

    tangent_u, tangent_v, normal = (discs.axes[..., i] for i in range(3))
    facing = jnp.sum(normal * mu, axis=-1)
    edge_on = jnp.abs(facing) <= EDGE_ON * safe_norm(mu)
    covectors = [
        jnp.cross(tangent_v, mu) / discs.scales[:, :1],
        jnp.cross(mu, tangent_u) / discs.scales[:, 1:],
        normal,
    ]
    covectors = jnp.stack(covectors, axis=1) / jnp.where(edge_on, 1, facing)[:, None, None]
    ray = jnp.concatenate([(anchor - principal) / focal, jnp.ones_like(anchor[:, :1])], axis=-1)
    at_anchor = jnp.sum(covectors * ray[:, None], axis=-1)
    at_center = jnp.stack([jnp.zeros_like(depth), jnp.zeros_like(depth), inverse_depth], axis=-1)
    constants = jnp.where(centered, at_center, at_anchor)
    homography = jnp.concatenate(
        [constants[..., None], covectors[..., :2] / focal[:, None]], axis=-1
    )
    vectors = discs.axes[..., :2] * discs.scales[:, None]
    if antialias:
        spread = _pixel_spread(homography, depth, centered[:, 0] & ~edge_on)
        homography, vectors = _widen(homography, vectors, spread)
        opacity = opacity / (spread[0] * spread[2])

    # Neither the box nor the disc's range of depth has a derivative.
    vectors, opacity_now, center = lax.stop_gradient((vectors, opacity, center))
    cutoff = jnp.sqrt(2 * jnp.log(jnp.maximum(opacity_now / ALPHA_MIN, 1)))
    reach = cutoff * safe_norm(vectors[:, 2])
    drawn = ~edge_on & (opacity_now >= ALPHA_MIN) & (depth + reach >= near)
    nearest, farthest = (jnp.maximum(limit, near) for limit in (depth - reach, depth + reach))
    box = _disc_box(lax.stop_gradient(mu), vectors, cutoff, camera, near)
    if not antialias:
        box = jnp.where(ahead[:, None], _unite(box, _low_pass_box(center, cutoff)), box)
    return Footprints(
        anchor=anchor,
        homography=homography,
        opacity=jnp.where(drawn, opacity, 0),
        low_pass=jnp.where(ahead & (not antialias), LOW_PASS, 1e9),
        inverse_depth=jnp.stack([1 / farthest, 1 / nearest], axis=-1),
        payload=payload,
        order=lax.stop_gradient(jnp.maximum(depth, near)),
        box=lax.stop_gradient(jnp.where(drawn[:, None], box, -1)),
    )


def _pixel_spread(homography, depth, known):
    """Cholesky factor (l11, l21, l22) of I + s^2 J J^T of each disc; the identity if not known."""
    across, down = (
        jnp.where(known[:, None], depth[:, None] * homography[:, :2, i], 0) for i in (1, 2)
    )
    uu, uv, vv = (
        PIXEL_VARIANCE * (across[:, i] * across[:, j] + down[:, i] * down[:, j])
        for i, j in ((0, 0), (0, 1), (1, 1))
    )
    first = jnp.sqrt(1 + uu)
    below = uv / first
    # 1 + vv - below^2, without taking large numbers from each other.
    cross = PIXEL_VARIANCE * (across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0])
    second = jnp.sqrt((1 + uu + vv + cross * cross) / (1 + uu))
    return first, below, second


def _widen(homography, vectors, spread):
    """Homography and vectors of discs `[N, 3, 2]` whose covariance (u, v) is L L^T."""
    first, below, second = (factor[:, None] for factor in spread)
    u = homography[:, 0] / first
    v = (homography[:, 1] - below * u) / second
    homography = jnp.stack([u, v, homography[:, 2]], axis=1)
    one, other = vectors[..., 0], vectors[..., 1]
    return homography, jnp.stack([first * one + below * other, second * other], axis=-1)


def _disc_box(
    center: jax.Array, vectors: jax.Array, cutoff: jax.Array, camera: Camera, near: float
) -> jax.Array:
    """Exact bounds `[N, 4]` in pixels of discs of radius `cutoff[N]`, cut off at z = near.

    The rim is center + cutoff (cos t, sin t) . vectors, for `[N, 3]` centers and `[N, 3, 2]`
    vectors.

    The visible part is convex, so points of its rim bound its image: those where a coordinate is
    stationary along the circle, and the ends of the chord at z = near.
    """
    # The margin keeps pixels that only just reach the cutoff in spite of rounding.
    radii = (1.001 * cutoff)[:, None, None] * vectors
    # Each coordinate x, y, z of the rim is a cos + b sin + c, a triple of [N].
    circle = [(radii[:, i, 0], radii[:, i, 1], center[:, i]) for i in range(3)]
    depth = circle[2]
    chord, has_chord = _meet_circle(depth[0], depth[1], depth[2] - near)
    low, high = [], []
    for axis in range(2):
        a, b = circle[axis], depth
        rim, has_rim = _meet_circle(
            a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[1] * b[0] - a[0] * b[1]
        )
        candidates = [(point, near, has_chord) for point in chord]
        for point in rim:
            at_depth = _on_circle(b, point)
            exists = has_rim & (at_depth >= near)
            candidates.append((point, jnp.where(exists, at_depth, 1), exists))
        least, most = jnp.inf, -jnp.inf
        for point, at_depth, exists in candidates:
            at = _on_circle(a, point) / at_depth
            at = at * camera.intrinsics[axis] + camera.intrinsics[2 + axis]
            least = jnp.minimum(least, jnp.where(exists, at, jnp.inf))
            most = jnp.maximum(most, jnp.where(exists, at, -jnp.inf))
        low.append(least - 0.01)
        high.append(most + 0.01)
    return jnp.stack([*low, *high], axis=-1)


def _on_circle(coordinate, point):
    """The value `[N]` of a coordinate (a, b, c) of the rim at a point (cos, sin)."""
    return coordinate[0] * point[0] + coordinate[1] * point[1] + coordinate[2]


def _meet_circle(a, b, c):
    """Both points (cos, sin) `[N]` with a cos + b sin + c = 0, and whether they exist `[N]`."""
    largest = jnp.maximum(jnp.maximum(jnp.abs(a), jnp.abs(b)), jnp.maximum(jnp.abs(c), 1e-30))
    a, b, c = a / largest, b / largest, c / largest
    squared = a * a + b * b
    discriminant = squared - c * c
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    # For a disc without extent the equation vanishes, and any point of its rim serves.
    divisor = jnp.where(squared == 0, 1, squared)
    points = [
        ((-c * a - s * b * root) / divisor, (-c * b + s * a * root) / divisor) for s in (-1, 1)
    ]
    return points, discriminant >= 0


def _low_pass_box(center: jax.Array, cutoff: jax.Array) -> jax.Array:
    half = (1.001 * cutoff / jnp.sqrt(LOW_PASS) + 0.01)[:, None]
    return jnp.concatenate([center - half, center + half], axis=-1)


def _unite(a: jax.Array, b: jax.Array) -> jax.Array:
    low, high = jnp.minimum(a[:, :2], b[:, :2]), jnp.maximum(a[:, 2:], b[:, 2:])
    return jnp.concatenate([low, high], axis=-1)
