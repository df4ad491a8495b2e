"""Colour of ray-cast solids: filtered textures, baked soft light, supersampled pixels.

Light is baked once for each scene: every face carries a small tile of light values (soft shadows of
the lamps, ambient occlusion and one bounce), so that a diffuse point has one colour from everywhere
and a rendered sample costs one ray. Textures are pyramids read at the level that matches a
sample's footprint on the surface: far views resolve what they should, close-ups resolve more.
"""

from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_rays
from jaxcloseup.scenes.raycast import Hit, Solids, cast_ray, in_pyramid, keep_solids, map_rays
from jaxcloseup.scenes.scene import Surface


TEXTURE_SIZE = 1024  # texels a side, of every texture
LEVELS = TEXTURE_SIZE.bit_length()
GAMMA = 1 / 2.2
_SHININESS = 60.0
_TILE = 24  # pixels a side that share a list of solids


@struct.dataclass
class Faces:
    """How each face looks.

    Attributes:
      texture: `[F]` int32 colour texture.
      detail: `[F]` int32 fine texture; the colour is multiplied by twice its value.
      uv: `[F, 2, 3]` affine map from the chart to texture repeats.
      detail_uv: `[F, 2, 3]` the same for the fine texture.
      pitch: `[F, 2]` repeats per world unit, of texture and detail.
      tint: `[F, 3]` factor on the colour.
      gloss: `[F]` strength of the highlight.
      emission: `[F]` 1 where the face shines by itself, else 0.
      tile: `[F, 3]` int32 first entry, width and height of its tile of light.
      wraps: `[F]` 1 where the tile is periodic in its first coordinate, else 0.
    """

    texture: jax.Array
    detail: jax.Array
    uv: jax.Array
    detail_uv: jax.Array
    pitch: jax.Array
    tint: jax.Array
    gloss: jax.Array
    emission: jax.Array
    tile: jax.Array
    wraps: jax.Array


@struct.dataclass
class World:
    """Everything a ray can find.

    Attributes:
      solids: the shapes.
      faces: their finish.
      texels: `[K, M]` uint32 packed RGB, the pyramids of K periodic textures.
      light: `[L, 4]` baked light, encoded as images are: rgb, and how much of the lamp is visible.
      lamp: `[3]` position of the first lamp, whose highlight shows.
    """

    solids: Solids
    faces: Faces
    texels: jax.Array
    light: jax.Array
    lamp: jax.Array


@struct.dataclass
class Lamps:
    """What lights a scene: spherical lamps, and light from everywhere.

    Attributes:
      position: `[K, 3]` centres.
      radius: `[K]` radii: the softness of shadows.
      power: `[K, 3]` irradiance at one unit of distance.
      ambient: `[3]` irradiance of an unoccluded point.
      reach: `[]` distance over which an obstacle stops ambient light.
    """

    position: jax.Array
    radius: jax.Array
    power: jax.Array
    ambient: jax.Array
    reach: jax.Array


def pack_pyramid(image: np.ndarray) -> np.ndarray:
    """A square texture `[S, S, 3]` in [0, 1] and its halvings, `[M]` uint32."""
    levels = []
    for _ in range(LEVELS):
        byte = np.round(np.clip(image, 0, 1) * 255).astype(np.uint32)
        levels.append((byte[..., 0] | byte[..., 1] << 8 | byte[..., 2] << 16).ravel())
        if len(image) > 1:
            image = image.reshape(len(image) // 2, 2, -1, 2, 3).mean((1, 3))
    return np.concatenate(levels)


def sample_texture(
    texels: jax.Array, texture: jax.Array, uv: jax.Array, level: jax.Array
) -> jax.Array:
    """Colour `[3]` of periodic pyramid `texels[texture]` at `uv[2]` repeats, between levels."""
    level = jnp.clip(level, 0, LEVELS - 1)
    fine = jnp.minimum(jnp.floor(level), LEVELS - 2).astype(jnp.int32)
    uv = uv - jnp.floor(uv)
    blend = level - fine.astype(jnp.float32)
    sharp, soft = (_bilinear(texels, texture, uv, fine + i) for i in range(2))
    return (1 - blend) * sharp + blend * soft


def _bilinear(texels: jax.Array, texture: jax.Array, uv: jax.Array, level: jax.Array) -> jax.Array:
    size = TEXTURE_SIZE >> level
    first = (4 * (TEXTURE_SIZE**2 - size * size)) // 3  # entries in all finer levels
    xy = uv * size.astype(jnp.float32) - 0.5
    corner = jnp.floor(xy)
    weight = xy - corner
    corner = corner.astype(jnp.int32)

    def texel(dx: int, dy: int) -> jax.Array:
        x, y = (corner[0] + dx) & (size - 1), (corner[1] + dy) & (size - 1)
        packed = texels[texture, first + y * size + x]
        return _unpack(packed)

    top = (1 - weight[0]) * texel(0, 0) + weight[0] * texel(1, 0)
    bottom = (1 - weight[0]) * texel(0, 1) + weight[0] * texel(1, 1)
    return (1 - weight[1]) * top + weight[1] * bottom


def sample_light(light: jax.Array, faces: Faces, hit: Hit) -> jax.Array:
    """Baked light `[C]` at a hit, bilinear in the tile of its face."""
    first, width, height = faces.tile[hit.face]
    xy = hit.chart * jnp.stack([width, height]).astype(jnp.float32) - 0.5
    corner = jnp.floor(xy)
    weight = xy - corner
    corner = corner.astype(jnp.int32)

    def entry(dx: int, dy: int) -> jax.Array:
        x = jnp.where(
            faces.wraps[hit.face] > 0,
            (corner[0] + dx) % width,
            jnp.clip(corner[0] + dx, 0, width - 1),
        )
        return light[first + jnp.clip(corner[1] + dy, 0, height - 1) * width + x]

    top = (1 - weight[0]) * entry(0, 0) + weight[0] * entry(1, 0)
    bottom = (1 - weight[0]) * entry(0, 1) + weight[0] * entry(1, 1)
    return (1 - weight[1]) * top + weight[1] * bottom


def surface_colour(world: World, hit: Hit, footprint: jax.Array) -> jax.Array:
    """Unlit colour `[3]` of a patch as wide as `footprint`, in world units."""
    faces, face = world.faces, hit.face
    chart = jnp.append(hit.chart, 1.0)
    texels = jnp.maximum(footprint * faces.pitch[face] * TEXTURE_SIZE, 1e-6)

    def layer(texture: jax.Array, uv: jax.Array, width: jax.Array) -> jax.Array:
        repeats = jnp.sum(uv * chart[None], axis=-1)
        return sample_texture(world.texels, texture, repeats, jnp.log2(width))

    colour = faces.tint[face] * layer(faces.texture[face], faces.uv[face], texels[0])
    return colour * 2 * layer(faces.detail[face], faces.detail_uv[face], texels[1])


def radiance(world: World, origin: jax.Array, direction: jax.Array, spread: jax.Array) -> jax.Array:
    """Colour `[3]` along one ray; `spread` is its pixel's width at unit depth."""
    hit = cast_ray(world.solids, origin, direction)
    depth = jnp.where(jnp.isfinite(hit.depth), hit.depth, 0)
    facing = jnp.maximum(jnp.abs(jnp.sum(hit.normal * direction)), 0.02)
    # The pixel's area on the surface is (spread depth)^2 / facing, as directions have unit z.
    colour = surface_colour(world, hit, spread * depth / jnp.sqrt(facing))
    light = sample_light(world.light, world.faces, hit)
    to_lamp = _unit(world.lamp - (origin + depth * direction))
    half = _unit(to_lamp - _unit(direction))
    shine = jnp.maximum(jnp.sum(half * hit.normal), 0) ** _SHININESS
    lit = colour * light[:3] + world.faces.gloss[hit.face] * light[3] * shine
    lit = jnp.where(world.faces.emission[hit.face] > 0, colour, lit)
    return jnp.where(jnp.isfinite(hit.depth), jnp.clip(lit, 0, 1), 0)


def render_rgb(world: World, camera: Camera, *, samples: int = 8) -> jax.Array:
    """Image `[H, W, 3]`: means over pixels, by `samples` rays on a lattice."""
    offsets = lattice(samples)
    spread = 1 / jnp.sqrt(camera.intrinsics[0] * camera.intrinsics[1] * samples)

    def pixel_mean(solids: Solids, pixel: jax.Array) -> jax.Array:
        nearby = world.replace(solids=solids)

        def sample(offset: jax.Array) -> jax.Array:
            return radiance(nearby, *pixels_to_rays(camera, pixel + offset), spread)

        return jax.vmap(sample)(offsets).mean(0)

    return _map_pixels(pixel_mean, world.solids, camera)


def render_geometry(solids: Solids, camera: Camera) -> tuple[jax.Array, jax.Array]:
    """Exact z-depth `[H, W]` (0 where empty) and world normal `[H, W, 3]` at pixel centres."""

    def centre(solids: Solids, pixel: jax.Array) -> tuple[jax.Array, jax.Array]:
        hit = cast_ray(solids, *pixels_to_rays(camera, pixel))
        return jnp.where(jnp.isfinite(hit.depth), hit.depth, 0), hit.normal

    return _map_pixels(centre, solids, camera)


def _map_pixels(fn: Callable[..., Any], solids: Solids, camera: Camera) -> Any:
    """`fn(solids, pixel[2])` at every pixel, `[H, W]` on every leaf.

    One small tile of the image after another, each with just the solids that it may show.
    """
    rows, columns = -(-camera.height // _TILE), -(-camera.width // _TILE)
    corners = jnp.array([[0, 0], [_TILE, 0], [_TILE, _TILE], [0, _TILE]], jnp.float32)
    pixels = pixel_grid(_TILE, _TILE).reshape(-1, 2)

    def tile(corner: jax.Array) -> Any:
        apex, around = pixels_to_rays(camera, corner[None] + corners)
        nearby = keep_solids(solids, in_pyramid(solids, apex[0], around))
        return jax.vmap(lambda pixel: fn(nearby, pixel + corner))(pixels)

    starts = _TILE * (pixel_grid(rows, columns) - 0.5).reshape(-1, 2)

    def whole(leaf: jax.Array) -> jax.Array:
        leaf = leaf.reshape(rows, columns, _TILE, _TILE, *leaf.shape[2:]).swapaxes(1, 2)
        leaf = leaf.reshape(rows * _TILE, columns * _TILE, *leaf.shape[4:])
        return leaf[: camera.height, : camera.width]

    return jax.tree.map(whole, jax.lax.map(tile, starts))


def render_surface(world: World, camera: Camera, *, samples: int = 8) -> Surface:
    """What `camera` truly sees."""
    rgb = render_rgb(world, camera, samples=samples)
    return Surface(rgb, *render_geometry(world.solids, camera))


def lattice(count: int) -> jax.Array:
    """`[count, 2]` well-spread offsets in (-0.5, 0.5)^2, of mean 0."""
    i = np.arange(count)
    golden = (np.sqrt(5) - 1) / 2
    xy = np.stack([(i + 0.5) / count, (i * golden + 0.5) % 1], axis=-1)
    return jnp.asarray(xy - xy.mean(0), jnp.float32)


def bake_light(
    world: World, lamps: Lamps, positions: jax.Array, normals: jax.Array, *, samples: int = 48
) -> jax.Array:
    """Light `[L, 4]` arriving at `positions[L, 3]`, not yet encoded: lamps, ambient, one bounce.

    The last channel is the visible part of the first lamp. Rays leave from just above the surface.
    """
    chex.assert_equal_shape([positions, normals])
    starts = positions + 5e-4 * normals
    turns = jnp.asarray(np.random.default_rng(0).uniform(size=(len(positions), 2)), jnp.float32)

    def direct(start: jax.Array, normal: jax.Array, turn: jax.Array) -> jax.Array:
        def lamp(position: jax.Array, radius: jax.Array, power: jax.Array) -> jax.Array:
            def one(i: jax.Array, total: jax.Array) -> jax.Array:
                to_lamp = position + radius * _on_sphere(_point(i, samples // 2, turn)) - start
                hit = cast_ray(world.solids, start, to_lamp)
                blocked = (hit.depth < 1) & (world.faces.emission[hit.face] == 0)
                return total + jnp.where(blocked, 0.0, 1.0)

            visible = jax.lax.fori_loop(0, samples // 2, one, jnp.float32(0)) / (samples // 2)
            away = position - start
            squared = jnp.sum(away * away)
            cosine = jnp.maximum(jnp.sum(away * normal), 0) / jnp.sqrt(squared)
            return jnp.append(power * (visible * cosine / squared), visible)

        each = jax.vmap(lamp)(lamps.position, lamps.radius, lamps.power)
        return jnp.append(each[:, :3].sum(0), each[0, 3])

    first = map_rays(direct, starts, normals, turns)
    mean_colours = _unpack(world.texels[:, -1]).T
    albedo = (world.faces.tint * mean_colours[world.faces.texture]) ** (1 / GAMMA)

    def gather(start: jax.Array, normal: jax.Array, turn: jax.Array) -> jax.Array:
        def one(i: jax.Array, total: jax.Array) -> jax.Array:
            direction = _unit(normal + 0.999 * _on_sphere(_point(i, samples, turn)))
            hit = cast_ray(world.solids, start, direction)
            ambient = lamps.ambient * (1 - jnp.exp(-hit.depth / lamps.reach))
            bounce = albedo[hit.face] * sample_light(first, world.faces, hit)[:3]
            # What shines by itself is seen as it is drawn; the rest returns lamp light.
            glow = albedo[hit.face] * lamps.ambient
            return total + jnp.where(world.faces.emission[hit.face] > 0, glow, ambient + bounce)

        return jax.lax.fori_loop(0, samples, one, jnp.zeros(3)) / samples

    return first.at[:, :3].add(map_rays(gather, starts, normals, turns))


def _unpack(packed: jax.Array) -> jax.Array:
    """RGB `[3, ...]` in [0, 1] of packed bytes."""
    rgb = [(packed >> shift) & 255 for shift in (0, 8, 16)]
    return jnp.stack(rgb).astype(jnp.float32) / 255


def _point(i: jax.Array, count: int, turn: jax.Array) -> jax.Array:
    """The i-th of `count` well-spread points of the unit square, shifted round by `turn[2]`."""
    i = i.astype(jnp.float32)
    point = jnp.stack([(i + 0.5) / count, i * 0.618034]) + turn
    return point - jnp.floor(point)


def _on_sphere(square: jax.Array) -> jax.Array:
    z, angle = 2 * square[0] - 1, 2 * jnp.pi * square[1]
    r = jnp.sqrt(jnp.maximum(1 - z * z, 0))
    return jnp.stack([r * jnp.cos(angle), r * jnp.sin(angle), z])


def _unit(v: jax.Array) -> jax.Array:
    return v / jnp.sqrt(jnp.maximum(jnp.sum(v * v), 1e-12))
