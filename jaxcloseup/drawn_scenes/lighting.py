"""Bake light: soft shadows of lamps, ambient occlusion and one bounce, for every face's tile.

This is host code in NumPy around `cast_rays`. It computes light in blocks of neighboring entries,
each with only the solids that can affect it, and runs the blocks in threads.
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxcloseup.drawn_scenes.raycast import Hit, Solids, cast_rays
from jaxcloseup.drawn_scenes.shading import GAMMA, Faces, World, mean_colors, sample_light
from jaxcloseup.drawn_scenes.threaded_map import map_in_threads


_BLOCK, _SAMPLES = 256, 16
_ROUNDS = 2  # each casts _SAMPLES directions around an entry


class Lamp(NamedTuple):
    """A spherical lamp."""

    position: tuple[float, float, float]  # center of the lamp in meters
    radius: float  # radius of the lamp in meters
    power: tuple[float, float, float]  # RGB irradiance at one meter


class Ambience(NamedTuple):
    """Light from all directions."""

    irradiance: tuple[float, float, float]  # RGB irradiance of an unoccluded point
    reach: float  # distance in meters over which the occlusion by an obstacle fades


def bake_light(
    world: World, lamps: list[Lamp], ambience: Ambience, positions: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Bake light at surface points; neighbors in the list should be neighbors in space.

    Args:
      world: its `light` is not used.
      lamps: the first one makes highlights.
      positions: `[L, 3]` surface points, with outward unit `normals[L, 3]`.

    Returns:
      `[L, 4]` RGB light in the encoding of images, and the visible fraction of the first lamp.
    """
    starts = positions + 5e-4 * normals  # just above the surface
    turns = np.random.default_rng(0).uniform(size=(len(starts), 1, 2))
    shines = np.asarray(world.faces.emission) > 0
    albedo = np.asarray(world.faces.tint) * mean_colors(world.texels)[world.faces.texture]
    albedo **= 1 / GAMMA
    irradiance = np.array(ambience.irradiance)

    def from_lamps(part: slice) -> np.ndarray:
        start, normal, turn = starts[part], normals[part], turns[part]
        light = np.zeros((len(start), 4))
        for lamp in reversed(lamps):
            wanted = _within(world.solids, start, normal, np.array(lamp.position), lamp.radius)
            ends = lamp.position + lamp.radius * _on_sphere(_spread(_SAMPLES, turn))
            ways = ends - start[:, None]
            hits = cast_rays(world.solids, start[:, None], ways, wanted=wanted)
            visible = np.mean((hits.depth >= 1) | shines[hits.face], axis=1)
            away = np.array(lamp.position) - start
            squared = np.sum(away**2, axis=-1)
            cosine = np.maximum(np.sum(away * normal, axis=-1), 0) / np.sqrt(squared)
            light[:, :3] += (visible * cosine / squared)[:, None] * np.array(lamp.power)
            light[:, 3] = visible  # the first lamp comes last and overwrites the others
        return light

    def from_around(part: slice) -> np.ndarray:
        start, normal, turn = starts[part], normals[part], turns[part]
        wanted = _within(world.solids, start, normal, start.mean(0), 3 * ambience.reach)
        light = np.zeros((len(start), 4))
        for number in range(_ROUNDS):
            square = _spread(_SAMPLES, turn, number / _ROUNDS / _SAMPLES)
            ways = normal[:, None] + 0.999 * _on_sphere(square)
            ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
            hits = cast_rays(world.solids, start[:, None], ways, wanted=wanted)
            # Emitting faces contribute their own color, others the lamp light that they reflect.
            returned = np.asarray(_look_up(direct, world.faces, hits))[..., :3]
            returned = np.where(np.isfinite(hits.depth)[..., None], returned, 0) * albedo[hits.face]
            returned += irradiance * (1 - np.exp(-hits.depth / ambience.reach))[..., None]
            glow = albedo[hits.face] * irradiance
            light[:, :3] += np.where(shines[hits.face][..., None], glow, returned).mean(1) / _ROUNDS
        return light

    parts = [slice(first, first + _BLOCK) for first in range(0, len(starts), _BLOCK)]
    direct = np.concatenate(map_in_threads(from_lamps, parts)).astype(np.float32)
    around = np.concatenate(map_in_threads(from_around, parts)).astype(np.float32)
    light = _smooth(direct + around, world)
    light[:, :3] **= GAMMA
    return light


@jax.jit
def _look_up(light: jax.Array, faces: Faces, hits: Hit) -> jax.Array:
    return jax.vmap(jax.vmap(lambda hit: sample_light(light, faces, hit)))(hits)


def _within(
    solids: Solids, points: np.ndarray, normals: np.ndarray, end: np.ndarray, radius: float
) -> np.ndarray:
    """Find which solids `[N]` rise above a block's horizon and lie near its path to a ball."""
    start = points.mean(0)
    radius = max(radius, np.linalg.norm(points - start, axis=-1).max())
    half, center = np.asarray(solids.bound)[..., :3], np.asarray(solids.bound)[..., 3]
    way = end - start
    along = np.clip((center - start) @ way / max(way @ way, 1e-9), 0, 1)
    away = np.linalg.norm(center - start - along[:, None] * way, axis=-1)
    size = np.linalg.norm(half, axis=(1, 2))
    height = normals @ center.T - np.sum(normals * points, axis=-1, keepdims=True)
    return (away < radius + size) & (height.max(0) + size > 0)


def _smooth(light: np.ndarray, world: World) -> np.ndarray:
    """Smooth each tile with a binomial filter, to reduce the noise of few rays."""
    light = light.copy()
    tiles = np.column_stack([world.faces.tile, np.asarray(world.faces.wraps, np.int32)])
    for start, width, height, wraps in np.unique(tiles, axis=0):
        tile = light[start : start + width * height].reshape(height, width, 4)
        for axis in (1, 0):
            padding = [(1, 1) if i == axis else (0, 0) for i in range(3)]
            around = axis == 1 and wraps
            padded = np.pad(tile, padding, mode="wrap" if around else "edge")
            padded = np.moveaxis(padded, axis, 0)
            tile = np.moveaxis((padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4, 0, axis)
        light[start : start + width * height] = tile.reshape(-1, 4)
    return light


def _spread(count: int, turns: np.ndarray, offset: float = 0.0) -> np.ndarray:
    """Return points `[L, count, 2]` in the unit square, shifted by `turns[L, 1, 2]` mod 1."""
    i = np.arange(count)
    lattice = np.stack([(i + 0.5) / count + offset, i * 0.618034 + 7 * offset], -1)
    return (lattice + turns) % 1


def _on_sphere(square: np.ndarray) -> np.ndarray:
    z, angle = 2 * square[..., 0] - 1, 2 * np.pi * square[..., 1]
    r = np.sqrt(np.maximum(1 - z * z, 0))
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
