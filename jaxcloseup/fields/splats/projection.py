"""Surfels to planar homographies and exact boxes, for one camera.

A pixel's ray r, with r_z = 1, meets a disc with center mu, unit tangents t_u, t_v, normal
n = t_u x t_v and radii s_u, s_v at depth z with local coordinates (u, v). The three quantities

    u / z = r.(t_v x mu) / (s_u n.mu),    v / z = r.(mu x t_u) / (s_v n.mu),    1 / z = r.n / n.mu

are affine in the pixel: they are the rows of `Footprints.homography`, taken about the projected
center, where they are (0, 0, 1 / mu_z) without rounding.

That is the intersection of 2D Gaussian splatting (Huang et al. 2024, equations 8 to 10) without its
cross product of two planes at each pixel, which in float32 loses the digits of small discs.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax

from jaxcloseup.fields.splats.disc_box import disc_box
from jaxcloseup.fields.splats.filters import LOW_PASS, Rows, pixel_spread, widen
from jaxcloseup.fields.splats.layout import Footprints
from jaxcloseup.fields.splats.splat_math import ALPHA_MIN
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.fields.splats.vectors import Vector, cross, dot, scaled
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.rotations import quaternion_rows


EDGE_ON = 1e-4  # |cos| between normal and line of sight below which a disc is not drawn
MAX_LOG_SCALE = 30.0  # beyond it, products of scales leave the range of float32


class Discs(NamedTuple):
    """`N` discs, or ellipsoids, in one camera's frame, in world units.

    Attributes:
      center: centers.
      tangent_u: first unit tangents.
      tangent_v: second unit tangents.
      normal: unit normals.
      scales: standard deviations `[N]` along the two tangents and, of ellipsoids, the normal.
    """

    center: Vector
    tangent_u: Vector
    tangent_v: Vector
    normal: Vector
    scales: tuple[jax.Array, ...]


class SurfelColumns(struct.PyTreeNode):
    """`Surfels` with tuples of columns `[N]` in place of arrays, see `Vector`; `sh` has triples."""

    means: Vector
    log_scales: tuple[jax.Array, ...]
    quaternions: tuple[jax.Array, jax.Array, jax.Array, jax.Array]
    opacity_logits: jax.Array
    sh: tuple[Vector, ...]


def surfel_columns(surfels: Surfels) -> SurfelColumns:
    """Return the columns of surfels."""

    def split(array: jax.Array) -> Any:
        # The derivative of a split is one concatenation, that of slices a sum of padded arrays.
        columns = array.reshape(array.shape[0], -1).T
        return tuple(row[0] for row in lax.split(columns, (1,) * columns.shape[0]))

    sh = split(surfels.sh)
    return SurfelColumns(
        means=split(surfels.means),
        log_scales=split(surfels.log_scales),
        quaternions=split(surfels.quaternions),
        opacity_logits=surfels.opacity_logits,
        sh=tuple(sh[start : start + 3] for start in range(0, len(sh), 3)),
    )


def to_camera(surfels: SurfelColumns, camera: Camera) -> tuple[Discs, Vector]:
    """Return discs in the camera's frame, and their normals, world frame, facing the camera.

    Args:
      surfels: from `surfel_columns`.
      camera: one camera.
    """
    tangent_u, tangent_v, normal = zip(*quaternion_rows(*surfels.quaternions), strict=True)
    offset = offsets(surfels, camera)
    # By the line of sight to the center: where a pixel sees the disc, its ray agrees.
    away = dot(offset, normal) > 0

    def turn(vector: Vector) -> Vector:
        x, y, z = (dot(axis, vector) for axis in camera.rotation.T)
        return x, y, z

    scales = tuple(
        jnp.exp(jnp.clip(scale, -MAX_LOG_SCALE, MAX_LOG_SCALE)) for scale in surfels.log_scales
    )
    discs = Discs(
        center=turn(offset),
        tangent_u=turn(tangent_u),
        tangent_v=turn(tangent_v),
        normal=turn(normal),
        scales=scales,
    )
    x, y, z = (jnp.where(away, -n, n) for n in normal)
    return discs, (x, y, z)


def offsets(surfels: SurfelColumns, camera: Camera) -> Vector:
    """Return vectors from the camera to the centers of surfels from `surfel_columns`."""
    x, y, z = (mean - at for mean, at in zip(surfels.means, camera.position, strict=True))
    return x, y, z


def project_discs(
    discs: Discs,
    opacity: jax.Array,
    payload: jax.Array,
    camera: Camera,
    *,
    near: float,
    antialias: bool = False,
) -> Footprints:
    """Return homographies and boxes of discs; invisible discs get opacity 0 and an empty box.

    Args:
      discs: `N` discs in the frame of `camera`.
      opacity: `[N]` in [0, 1].
      payload: `[F, N]` values to blend.
      camera: one camera; only its intrinsics and image size are used.
      near: positive z-depth; nothing nearer is drawn, and a disc may reach through it.
      antialias: convolve discs with the pixel, see `pixel_spread`; else draw small discs larger.

    Raises:
      ValueError: `near` is not positive.
    """
    if near <= 0:
        raise ValueError(f"near must be a positive depth, not {near}")
    focal, principal = camera.intrinsics[:2], camera.intrinsics[2:]
    mu, depth = discs.center, discs.center[2]
    ahead = depth > near
    inverse_depth = 1 / jnp.where(ahead, depth, 1)
    center = [mu[i] * inverse_depth * focal[i] + principal[i] for i in range(2)]
    anchor, centered = _anchors(center, ahead, camera)
    homography, edge_on = _homographies(discs, anchor, centered, inverse_depth, focal, principal)
    vectors = scaled(discs.scales[0], discs.tangent_u), scaled(discs.scales[1], discs.tangent_v)
    if antialias:
        # Filter first: the box must bound the filtered splat, which is larger and fainter.
        spread = pixel_spread(homography, depth, centered & ~edge_on)
        homography, vectors = widen(homography, vectors, spread)
        opacity = opacity / (spread[0] * spread[2])

    # Neither the box nor the disc's range of depth has a derivative.
    mu, vectors, opacity_now, center = lax.stop_gradient((mu, vectors, opacity, center))
    # Where alpha falls to ALPHA_MIN, in standard deviations: a fixed 3 would cut opaque discs off.
    cutoff = jnp.sqrt(2 * jnp.log(jnp.maximum(opacity_now / ALPHA_MIN, 1)))
    reach = cutoff * jnp.hypot(vectors[0][2], vectors[1][2])
    drawn = ~edge_on & (opacity_now >= ALPHA_MIN) & (mu[2] + reach >= near)
    nearest, farthest = (jnp.maximum(limit, near) for limit in (mu[2] - reach, mu[2] + reach))
    box = disc_box(mu, vectors, cutoff, camera, near)
    if not antialias:
        box = _with_low_pass(box, center, cutoff, ahead)
    return Footprints(
        anchor=jnp.stack(anchor),
        homography=jnp.stack([jnp.stack(row) for row in homography]),
        opacity=jnp.where(drawn, opacity, 0),
        low_pass=jnp.where(ahead & (not antialias), LOW_PASS, 1e9),
        inverse_depth=jnp.stack([1 / farthest, 1 / nearest]),
        payload=payload,
        # A disc that reaches through the near plane is sorted as if it lay there.
        order=jnp.maximum(mu[2], near),
        box=jnp.where(drawn[None], jnp.stack(box), -1),
    )


def _with_low_pass(
    box: list[jax.Array], center: list[jax.Array], cutoff: jax.Array, ahead: jax.Array
) -> list[jax.Array]:
    """Return boxes that also hold the low-pass: a circle about the center of discs ahead `[N]`."""
    half = 1.001 * cutoff / jnp.sqrt(LOW_PASS) + 0.01
    square = center[0] - half, center[1] - half, center[0] + half, center[1] + half
    sides = zip([jnp.minimum] * 2 + [jnp.maximum] * 2, box, square, strict=True)
    return [jnp.where(ahead, farther(a, b), a) for farther, a, b in sides]


def _anchors(
    center: list[jax.Array], ahead: jax.Array, camera: Camera
) -> tuple[list[jax.Array], jax.Array]:
    """Return anchors x, y `[N]` of discs, and where these are the projected centers `[N]`.

    A center far outside the image, or behind the camera, is a poor origin for numbers that are
    evaluated inside it. Any other pixel serves if the low-pass about it stays out of sight.
    """
    size = camera.width, camera.height
    margin = [max(side, 16) for side in size]
    around = list(zip(center, margin, size, strict=True))
    within = [(at > -more) & (at < side + more) for at, more, side in around]
    centered = ahead & within[0] & within[1]
    # Discs behind the camera are anchored at a corner of pixels, never at a pixel's center.
    elsewhere = [
        jnp.where(ahead, jnp.clip(at, -more, side + more), side // 2) for at, more, side in around
    ]
    anchor = [
        jnp.where(centered, at, lax.stop_gradient(other))
        for at, other in zip(center, elsewhere, strict=True)
    ]
    return anchor, centered


def _homographies(
    discs: Discs,
    anchor: list[jax.Array],
    centered: jax.Array,
    inverse_depth: jax.Array,
    focal: jax.Array,
    principal: jax.Array,
) -> tuple[Rows, jax.Array]:
    """Return the rows of homographies about anchors, and where discs are seen from the edge `[N]`.

    Args:
      discs: `N` discs.
      anchor: x and y `[N]`.
      centered: `[N]` bool, True where the anchor is the projected center.
      inverse_depth: `[N]` of the center.
      focal: `[2]` focal lengths.
      principal: `[2]` principal point.
    """
    mu, facing = discs.center, dot(discs.normal, discs.center)
    edge_on = jnp.abs(facing) <= EDGE_ON * jnp.sqrt(lax.stop_gradient(dot(mu, mu)))
    per_facing = 1 / jnp.where(edge_on, 1, facing)
    # A row is a covector: its product with the ray r is u / z, v / z or 1 / z.
    covectors = (
        scaled(per_facing / discs.scales[0], cross(discs.tangent_v, mu)),
        scaled(per_facing / discs.scales[1], cross(mu, discs.tangent_u)),
        scaled(per_facing, discs.normal),
    )
    ray = [(anchor[i] - principal[i]) / focal[i] for i in range(2)]
    at_centers: tuple[jax.Array | int, ...] = (0, 0, inverse_depth)  # exact, unlike the sum
    u, v, w = (
        (jnp.where(centered, at_center, x * ray[0] + y * ray[1] + z), x / focal[0], y / focal[1])
        for (x, y, z), at_center in zip(covectors, at_centers, strict=True)
    )
    return (u, v, w), edge_on
