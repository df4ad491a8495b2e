"""Exact ray casting of solids: planes, boxes, spheres and cylinders.

Every solid is an affine image of a unit solid: the square |x|, |y| <= 1 at z = 0, the cube
[-1, 1]^3, the unit sphere, or the cylinder |z| <= 1 with radius 1 + taper z. Rays are transformed
into that frame, so slats, ellipsoids and flower pots need no code of their own.

A point on a solid has a *face* (an integer, numbered through all solids) and a *chart* coordinate
(two numbers in [0, 1]^2 on that face), at which textures and baked light are looked up.

`cast_ray` casts one ray and is batched with `jax.vmap`; `cast_rays` serves host code.
"""

from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct


PLANE, BOX, SPHERE, CYLINDER = range(4)
FACES_OF = (1, 6, 1, 3)  # box: -x +x -y +y -z +z; cylinder: side, bottom, top


class Solids(struct.PyTreeNode):
    """Solids sorted by kind, followed by padding."""

    to_local: jax.Array  # `[N, 3, 4]` affine map from the world to the unit solid
    bound: jax.Array  # `[N, 3, 4]` half axes (columns) and center of a bounding box, in the world
    taper: jax.Array  # `[N]` growth of a cylinder's radius with local z, in (-1, 1)
    kind: jax.Array  # `[N]` int32 kind: PLANE, BOX, SPHERE or CYLINDER
    first_face: jax.Array  # `[N]` int32 number of the solid's first face
    bounds: jax.Array  # `[5]` int32; solids i of kind k satisfy bounds[k] <= i < bounds[k + 1]


class Hit(NamedTuple):
    """The first crossing of a ray with a solid."""

    depth: jax.Array  # ray parameter (z-depth for camera rays); inf if the ray hits nothing
    normal: jax.Array  # `[3]` unit world normal on the ray's side; 0 if the ray hits nothing
    face: jax.Array  # int32 face number; 0 if the ray hits nothing
    chart: jax.Array  # `[2]` position on the face, in [0, 1]


def make_solids(
    kind: np.ndarray, to_world: np.ndarray, taper: np.ndarray, *, pad_to: int = 1
) -> Solids:
    """Build solids from affine maps of unit solids.

    Args:
      kind: `[N]` kinds, in ascending order.
      to_world: `[N, 3, 4]` affine maps from the unit solids to the world.
      taper: `[N]` growth of a cylinder's radius with local z, in (-1, 1).
      pad_to: the number of solids is padded to a multiple of this, so that scenes of similar size
        share one compilation. Rays never hit padding, and it costs no time.

    Raises:
      ValueError: the solids are not sorted by kind.
    """
    kind = np.asarray(kind, np.int32)
    if np.any(np.diff(kind) < 0):
        raise ValueError("solids must be sorted by kind: planes, boxes, spheres, cylinders")
    padding = -len(kind) % pad_to
    linear = np.linalg.inv(np.asarray(to_world, np.float64)[:, :, :3])
    offset = -linear @ np.asarray(to_world, np.float64)[:, :, 3:]
    to_local = np.concatenate([linear, offset], axis=-1).astype(np.float32)
    faces = np.take(FACES_OF, kind)
    bound = np.array(to_world, np.float32)
    bound[:, :, :2] *= 1 + np.abs(np.asarray(taper, np.float32))[:, None, None]
    bound[:, :, 2] *= (kind != PLANE)[:, None]
    return Solids(
        to_local=jnp.asarray(np.pad(to_local, [(0, padding), (0, 0), (0, 0)])),
        bound=jnp.asarray(np.pad(bound, [(0, padding), (0, 0), (0, 0)])),
        taper=jnp.asarray(np.pad(np.asarray(taper, np.float32), (0, padding))),
        kind=jnp.asarray(np.pad(kind, (0, padding))),
        first_face=jnp.asarray(np.pad(np.cumsum(faces) - faces, (0, padding)), jnp.int32),
        bounds=jnp.asarray(np.searchsorted(kind, np.arange(5)), jnp.int32),
    )


def cast_ray(
    solids: Solids, origin: jax.Array, direction: jax.Array, *, nearest: float = 1e-4
) -> Hit:
    """Find a ray's first crossing `origin[3] + depth * direction[3]` with depth > `nearest`."""
    chex.assert_shape([origin, direction], (3,))
    ray = (*origin, *direction)

    def closer(crossings: Callable, index: jax.Array, best: tuple) -> tuple:
        depth = _first_crossing(
            crossings, solids.to_local[index], solids.taper[index], ray, nearest
        )
        is_closer = depth < best[0]
        return jnp.where(is_closer, depth, best[0]), jnp.where(is_closer, index, best[1])

    best = (jnp.float32(jnp.inf), jnp.int32(-1))
    for kind, crossings in enumerate((_plane, _box, _sphere, _cylinder)):

        def body(index: jax.Array, best: tuple, crossings: Callable = crossings) -> tuple:
            return closer(crossings, index, best)

        best = jax.lax.fori_loop(solids.bounds[kind], solids.bounds[kind + 1], body, best)
    return _describe(solids, origin, direction, *best)


def keep_solids(solids: Solids, wanted: jax.Array) -> Solids:
    """Keep only the solids with `wanted[N]`, so that rays skip the others."""
    index = jnp.arange(wanted.shape[0])
    kind = jnp.where(wanted & (index < solids.bounds[-1]), solids.kind, 4)
    order = jnp.argsort(kind, stable=True)
    kept = jax.tree.map(lambda leaf: leaf[order], solids.replace(bounds=index))
    return kept.replace(bounds=jnp.searchsorted(kind[order], jnp.arange(5)).astype(jnp.int32))


def in_pyramid(solids: Solids, apex: jax.Array, corners: jax.Array) -> jax.Array:
    """Find solids `[N]` that rays from `apex[3]` between directions `corners[4, 3]` may hit.

    The corners are in cyclic order. The test is conservative: it excludes a solid only if its
    bounding box lies beyond one side of the pyramid.
    """
    sides = jnp.cross(corners, jnp.roll(corners, -1, axis=0))
    sides = sides * jnp.sign(jnp.sum(sides * corners.sum(0)[None], axis=-1, keepdims=True))
    towards = jnp.sum(sides[:, None] * (solids.bound[:, :, 3] - apex[None])[None], axis=-1)
    reach = jnp.abs(jnp.sum(sides[:, None, :, None] * solids.bound[None, :, :, :3], axis=2)).sum(-1)
    return jnp.all(towards + reach > -1e-5 * jnp.abs(towards), axis=0)


def cast_rays(
    solids: Solids, origins: np.ndarray, directions: np.ndarray, *, wanted: np.ndarray | None = None
) -> Hit:
    """Find the first hits `[...]` of many rays `[..., 3]`, as NumPy arrays.

    Rays are cast in chunks of 4096, or of 256 where there are few, so that two compilations serve
    any number of rays.

    Args:
      solids: `N` solids.
      origins: `[..., 3]` origins, broadcast against `directions`.
      directions: `[..., 3]` directions.
      wanted: `[N]` bool, the solids to test; None tests all.
    """
    shape = np.broadcast_shapes(origins.shape, directions.shape)[:-1]
    count = int(np.prod(shape))
    chunk = 4096 if count > 2048 else 256
    rays = [np.broadcast_to(r, (*shape, 3)).reshape(-1, 3) for r in (origins, directions)]
    rays = [np.pad(r, [(0, -count % chunk), (0, 0)], mode="edge").astype(np.float32) for r in rays]
    wanted = np.ones(solids.kind.shape, bool) if wanted is None else wanted
    parts = [
        jax.device_get(_cast(solids, wanted, *(r[i : i + chunk] for r in rays)))
        for i in range(0, len(rays[0]), chunk)
    ]
    return jax.tree.map(
        lambda *leaf: np.concatenate(leaf)[:count].reshape(shape + leaf[0].shape[1:]), *parts
    )


@jax.jit
def _cast(solids: Solids, wanted: jax.Array, origins: jax.Array, directions: jax.Array) -> Hit:
    kept = keep_solids(solids, wanted)
    return jax.vmap(lambda origin, direction: cast_ray(kept, origin, direction))(
        origins, directions
    )


def _apply(affine: jax.Array, vector: tuple[jax.Array, ...], w: float) -> list[jax.Array]:
    """Apply an affine map, written out, since accelerators round small matrix products coarsely."""
    x, y, z = vector
    return [row[0] * x + row[1] * y + row[2] * z + row[3] * w for row in affine]


def _first_crossing(
    crossings: Callable, to_local: jax.Array, taper: jax.Array, ray: tuple, nearest: float
) -> jax.Array:
    """Return the smallest ray parameter above `nearest` where the ray crosses one solid, or inf."""
    o, d = _apply(to_local, ray[:3], 1.0), _apply(to_local, ray[3:], 0.0)
    # Start at the ray's closest approach to the center: for a distant thin rail, b^2 - 4ac would
    # otherwise lose all precision.
    start = -_dot(o, d) / _dot(d, d)
    p = [a + start * b for a, b in zip(o, d, strict=True)]
    best = jnp.float32(jnp.inf)
    for t, valid in crossings(p, d, taper):
        depth = start + t
        best = jnp.where(valid & (depth > nearest) & (depth < best), depth, best)
    return best


def _dot(a: list, b: list) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _nonzero(x: jax.Array) -> jax.Array:
    return jnp.where(jnp.abs(x) < 1e-12, 1e-12, x)


def _plane(p: list, d: list, taper: jax.Array) -> list:
    t = -p[2] / _nonzero(d[2])
    x, y = p[0] + t * d[0], p[1] + t * d[1]
    return [(t, (jnp.abs(x) <= 1) & (jnp.abs(y) <= 1))]


def _box(p: list, d: list, taper: jax.Array) -> list:
    inverse = [1 / _nonzero(b) for b in d]
    sides = [((-1 - a) * b, (1 - a) * b) for a, b in zip(p, inverse, strict=True)]
    enter = [jnp.minimum(*side) for side in sides]
    leave = [jnp.maximum(*side) for side in sides]
    first = jnp.maximum(jnp.maximum(enter[0], enter[1]), enter[2])
    last = jnp.minimum(jnp.minimum(leave[0], leave[1]), leave[2])
    return [(first, first <= last), (last, first <= last)]


def _sphere(p: list, d: list, taper: jax.Array) -> list:
    inside = 1 - _dot(p, p)
    half = jnp.sqrt(jnp.maximum(inside, 0) / _dot(d, d))
    return [(-half, inside >= 0), (half, inside >= 0)]


def _cylinder(p: list, d: list, taper: jax.Array) -> list:
    radius, slope = 1 + taper * p[2], taper * d[2]
    a = d[0] * d[0] + d[1] * d[1] - slope * slope
    b = p[0] * d[0] + p[1] * d[1] - radius * slope
    c = p[0] * p[0] + p[1] * p[1] - radius * radius
    root = b * b - a * c
    q = -(b + jnp.where(b < 0, -1, 1) * jnp.sqrt(jnp.maximum(root, 0)))
    found = []
    for t in (q / _nonzero(a), c / _nonzero(q)):
        found.append((t, (root > 0) & (jnp.abs(p[2] + t * d[2]) <= 1)))
    for end in (-1, 1):
        t = (end - p[2]) / _nonzero(d[2])
        x, y = p[0] + t * d[0], p[1] + t * d[1]
        found.append((t, x * x + y * y <= (1 + end * taper) ** 2))
    return found


def _describe(
    solids: Solids, origin: jax.Array, direction: jax.Array, depth: jax.Array, index: jax.Array
) -> Hit:
    """Compute the normal, face and chart of a crossing."""
    # Written out by component: of small arrays, XLA would compute what they share anew for each.
    is_hit = index >= 0
    index = jnp.maximum(index, 0)
    along = jnp.where(is_hit, depth, 0)
    point = tuple(a + along * b for a, b in zip(origin, direction, strict=True))
    to_local, taper, kind = solids.to_local[index], solids.taper[index], solids.kind[index]
    x, y, z = _apply(to_local, point, 1.0)
    is_plane, is_box = kind == PLANE, kind == BOX
    on_cap = jnp.abs(z) > jnp.hypot(x, y) / (1 + taper * z)
    is_cap, is_side = (kind == CYLINDER) & on_cap, (kind == CYLINDER) & ~on_cap

    # A box shows the side to which the point is nearest.
    across_x = (jnp.abs(x) >= jnp.abs(y)) & (jnp.abs(x) >= jnp.abs(z))
    across_y = ~across_x & (jnp.abs(y) >= jnp.abs(z))
    across_z = ~across_x & ~across_y
    nearest = jnp.where(across_x, x, jnp.where(across_y, y, z))
    sign, end = (jnp.where(side < 0, -1.0, 1.0) for side in (nearest, z))
    axis = jnp.where(across_x, 0, jnp.where(across_y, 1, 2))
    box_face = 2 * axis + jnp.where(sign > 0, 1, 0)
    face = jnp.where(is_box, box_face, jnp.where(is_cap, jnp.where(z > 0, 2, 1), 0))

    def normal_along(across: jax.Array, flat: jax.Array | float, round_: jax.Array) -> jax.Array:
        of_box = jnp.where(across, sign, 0)
        return jnp.where(is_plane | is_cap, flat, jnp.where(is_box, of_box, round_))

    flank = jnp.where(is_side, -taper * (1 + taper * z), z)
    local = [
        normal_along(across_x, 0.0, x),
        normal_along(across_y, 0.0, y),
        normal_along(across_z, jnp.where(is_plane, 1, end), flank),
    ]
    # Normals transform by the transpose of the map to the unit solid.
    normal = [_dot([*to_local[:, i]], local) for i in range(3)]
    facing = jnp.where(_dot(normal, [*direction]) > 0, -1, 1) / jnp.sqrt(_dot(normal, normal))

    radius = 1 + end * taper  # of a cap, whose chart is in units of it
    around = jnp.arctan2(y, x) / jnp.pi
    chart = (
        jnp.select([is_plane, is_box, is_cap], [x, jnp.where(across_x, y, x), x / radius], around),
        jnp.select([is_plane, is_box, is_cap], [y, jnp.where(across_z, y, z), y / radius], z),
    )
    return Hit(
        depth=jnp.where(is_hit, depth, jnp.inf),
        normal=jnp.where(is_hit, jnp.stack([facing * a for a in normal]), 0),
        face=jnp.where(is_hit, solids.first_face[index] + face, 0),
        chart=jnp.clip((jnp.stack(chart) + 1) / 2, 0, 1),
    )
