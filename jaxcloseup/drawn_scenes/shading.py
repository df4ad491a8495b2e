"""Shade ray-cast solids: filtered textures, baked soft light, supersampled pixels.

Light is baked once per scene: every face carries a small tile of light values (soft shadows of the
lamps, ambient occlusion and one bounce). A diffuse point thus has the same color from everywhere,
and a sample costs one ray. Textures are pyramids, read at the level that matches the sample's
footprint on the surface, so that close-ups resolve more detail than far views.
"""

from collections.abc import Callable
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcloseup.drawn_scenes.raycast import Hit, Solids, cast_ray, in_pyramid, keep_solids
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_rays
from jaxcloseup.photos.scene import Surface


TEXTURE_SIZE = 1024  # side of every texture in texels
LEVELS = TEXTURE_SIZE.bit_length()
TEXELS = (4 * TEXTURE_SIZE**2 - 1) // 3  # texels of a whole pyramid
GAMMA = 1 / 2.2
_SHININESS = 60.0
_TILE = 24  # side in pixels of image tiles that share a list of solids


class Faces(struct.PyTreeNode):
    """The appearance of each face."""

    texture: jax.Array  # `[F]` int32 index of the color texture
    # `[F]` int32 index of the detail texture; twice its value multiplies the color
    detail: jax.Array
    uv: jax.Array  # `[F, 2, 3]` affine map from the chart to texture repeats
    detail_uv: jax.Array  # `[F, 2, 3]` the same map for the detail texture
    pitch: jax.Array  # `[F, 2]` repeats per world unit of texture and detail
    tint: jax.Array  # `[F, 3]` factor on the color
    gloss: jax.Array  # `[F]` strength of the highlight
    emission: jax.Array  # `[F]` 1 if the face shows its own color, unlit; else 0
    tile: jax.Array  # `[F, 3]` int32 first entry, width and height of the face's tile of light
    wraps: jax.Array  # `[F]` 1 if the tile is periodic in its first coordinate, else 0


class World(struct.PyTreeNode):
    """A scene ready for rendering."""

    solids: Solids  # shapes of the scene
    faces: Faces  # appearance of their faces
    texels: jax.Array  # `[K, M]` uint32 packed RGB, the pyramids of K periodic textures
    # `[L, 4]` baked RGB light in the encoding of images, and the visible fraction of the first lamp
    light: jax.Array
    lamp: jax.Array  # `[3]` position of the first lamp, which makes the highlights


def pack_pyramid(image: np.ndarray) -> np.ndarray:
    """Pack a square texture `[S, S, 3]` in [0, 1] and its pyramid as `[M]` uint32."""
    image = np.clip(image, 0, 1).astype(np.float32)
    levels = []
    for level in range(LEVELS):
        side = TEXTURE_SIZE >> level
        image = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA) if level else image
        bytes_ = np.full((side, side, 4), 0, np.uint8)
        bytes_[..., :3] = np.round(image * 255)
        levels.append(bytes_.view(np.dtype("<u4")).ravel())
    return np.concatenate(levels)


# Both samplers are written out by corner and channel: of small arrays, XLA would compute the index
# of a texel anew for each entry.
def sample_texture(
    texels: jax.Array, texture: jax.Array, uv: jax.Array, level: jax.Array
) -> jax.Array:
    """Sample `[3]` of the periodic pyramid `texels[texture]` at `uv[2]` repeats, trilinearly."""
    level = jnp.clip(level, 0, LEVELS - 1)
    fine = jnp.minimum(jnp.floor(level), LEVELS - 2).astype(jnp.int32)
    blend = level - fine.astype(jnp.float32)
    within = [repeat - jnp.floor(repeat) for repeat in uv]
    rgb = [jnp.zeros(())] * 3
    for pyramid_level, share in ((fine, 1 - blend), (fine + 1, blend)):
        size = TEXTURE_SIZE >> pyramid_level
        first = (4 * (TEXTURE_SIZE**2 - size * size)) // 3  # texels in all finer levels
        for x, y, weight in _corners(*(size.astype(jnp.float32) * part - 0.5 for part in within)):
            packed = texels[texture, first + (y & (size - 1)) * size + (x & (size - 1))]
            weight = share * weight
            rgb = [a + weight * b for a, b in zip(rgb, _unpack(packed), strict=True)]
    return jnp.stack(rgb)


def _corners(x: jax.Array, y: jax.Array) -> list[tuple[jax.Array, jax.Array, jax.Array]]:
    """Return the four integer neighbors (x, y) of a point, and their bilinear weights."""
    low_x, low_y = jnp.floor(x), jnp.floor(y)
    right, down = x - low_x, y - low_y
    i, j = low_x.astype(jnp.int32), low_y.astype(jnp.int32)
    columns, rows = ((i, 1 - right), (i + 1, right)), ((j, 1 - down), (j + 1, down))
    return [(column, row, a * b) for row, b in rows for column, a in columns]


def sample_light(light: jax.Array, faces: Faces, hit: Hit) -> jax.Array:
    """Sample the baked light `[C]` at a hit, bilinearly in the tile of its face."""
    first, width, height = faces.tile[hit.face]
    wraps, total = faces.wraps[hit.face] > 0, jnp.zeros(light.shape[1])
    place = (
        hit.chart[i] * size.astype(jnp.float32) - 0.5 for i, size in enumerate((width, height))
    )
    for x, y, weight in _corners(*place):
        # At most one past either end.
        around = jnp.where(x < 0, x + width, jnp.where(x < width, x, x - width))
        x = jnp.where(wraps, around, jnp.clip(x, 0, width - 1))
        total = total + weight * light[first + jnp.clip(y, 0, height - 1) * width + x]
    return total


def surface_color(world: World, hit: Hit, footprint: jax.Array) -> jax.Array:
    """Return the mean unlit color `[3]` of a surface patch `footprint` world units wide."""
    faces, face = world.faces, hit.face
    chart = jnp.append(hit.chart, 1.0)
    texels = jnp.maximum(footprint * faces.pitch[face] * TEXTURE_SIZE, 1e-6)

    def layer(texture: jax.Array, uv: jax.Array, width: jax.Array) -> jax.Array:
        repeats = jnp.sum(uv * chart[None], axis=-1)
        return sample_texture(world.texels, texture, repeats, jnp.log2(width))

    color = faces.tint[face] * layer(faces.texture[face], faces.uv[face], texels[0])
    return color * 2 * layer(faces.detail[face], faces.detail_uv[face], texels[1])


def radiance(world: World, origin: jax.Array, direction: jax.Array, spread: jax.Array) -> jax.Array:
    """Color `[3]` along one ray; `spread` is the width of its sample at unit depth."""
    hit = cast_ray(world.solids, origin, direction)
    depth = jnp.where(jnp.isfinite(hit.depth), hit.depth, 0)
    facing = jnp.maximum(jnp.abs(jnp.sum(hit.normal * direction)), 0.02)
    # The pixel's area on the surface is (spread depth)^2 / facing, as directions have unit z.
    color = surface_color(world, hit, spread * depth / jnp.sqrt(facing))
    light = sample_light(world.light, world.faces, hit)
    to_lamp = _unit(world.lamp - (origin + depth * direction))
    half = _unit(to_lamp - _unit(direction))
    shine = jnp.maximum(jnp.sum(half * hit.normal), 0) ** _SHININESS
    lit = color * light[:3] + world.faces.gloss[hit.face] * light[3] * shine
    lit = jnp.where(world.faces.emission[hit.face] > 0, color, lit)
    return jnp.where(jnp.isfinite(hit.depth), jnp.clip(lit, 0, 1), 0)


def render_rgb(world: World, camera: Camera, *, samples: int = 8) -> jax.Array:
    """Render an image `[H, W, 3]`; each pixel is the mean of `samples` rays on a lattice."""
    offsets = lattice(samples)
    spread = 1 / jnp.sqrt(camera.intrinsics[0] * camera.intrinsics[1] * samples)

    def pixel_mean(solids: Solids, pixel: jax.Array) -> jax.Array:
        nearby = world.replace(solids=solids)

        def sample(offset: jax.Array) -> jax.Array:
            return radiance(nearby, *pixels_to_rays(camera, pixel + offset), spread)

        return jax.vmap(sample)(offsets).mean(0)

    return _map_pixels(pixel_mean, world.solids, camera)


def render_geometry(solids: Solids, camera: Camera) -> tuple[jax.Array, jax.Array]:
    """Render exact z-depth `[H, W]` (0 if empty) and world normals `[H, W, 3]` at pixel centers."""

    def center(solids: Solids, pixel: jax.Array) -> tuple[jax.Array, jax.Array]:
        hit = cast_ray(solids, *pixels_to_rays(camera, pixel))
        return jnp.where(jnp.isfinite(hit.depth), hit.depth, 0), hit.normal

    return _map_pixels(center, solids, camera)


def _map_pixels(fn: Callable[..., Any], solids: Solids, camera: Camera) -> Any:
    """Evaluate `fn(solids, pixel[2])` at every pixel; every leaf becomes `[H, W, ...]`.

    The image is processed in small tiles, each with only the solids that it may show.
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
    """Render the exact image, depth and normals that `camera` sees."""
    rgb = render_rgb(world, camera, samples=samples)
    return Surface(rgb, *render_geometry(world.solids, camera))


def lattice(count: int) -> jax.Array:
    """Return well-spread offsets `[count, 2]` in (-0.5, 0.5)^2 with mean 0."""
    i = np.arange(count)
    golden = (np.sqrt(5) - 1) / 2
    xy = np.stack([(i + 0.5) / count, (i * golden + 0.5) % 1], axis=-1)
    return jnp.asarray(xy - xy.mean(0), jnp.float32)


def mean_colors(texels: jax.Array) -> np.ndarray:
    """Return the mean color `[K, 3]` of each pyramid."""
    return np.stack(_unpack(texels[:, -1]), axis=-1)


def _unpack(packed: jax.Array) -> list[jax.Array]:
    """Unpack red, green and blue in [0, 1] from bytes."""
    return [((packed >> shift) & 255).astype(jnp.float32) / 255 for shift in (0, 8, 16)]


def _unit(v: jax.Array) -> jax.Array:
    return v / jnp.sqrt(jnp.maximum(jnp.sum(v * v), 1e-12))
