"""Assemble a model of solids and finishes into a `World` that can be rendered."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.drawn_scenes import shading
from jaxcloseup.drawn_scenes.lighting import bake_light
from jaxcloseup.drawn_scenes.modeling import Finish, Model, Solid
from jaxcloseup.drawn_scenes.raycast import BOX, CYLINDER, PLANE, SPHERE, make_solids
from jaxcloseup.drawn_scenes.textures import draw_texture
from jaxcloseup.drawn_scenes.threaded_map import map_in_threads


# Scenes padded to the same sizes share compilations.
_PAD_SOLIDS, _PAD_FACES, _PAD_LIGHT, _PAD_TEXTURES = 192, 1024, 3 << 15, 24


def build_world(model: Model, bake: Callable[..., np.ndarray] = bake_light) -> shading.World:
    """Assemble a model for rendering; `bake` computes its light or loads it from a cache."""
    solids = sorted(model.solids, key=lambda solid: solid.kind)
    to_world = np.stack([np.column_stack([s.rotation * (s.size / 2), s.center]) for s in solids])
    names: list[str] = []
    rows, positions, normals, start = [], [], [], 0
    for index, solid in enumerate(solids):
        for side, finish in enumerate(solid.finishes):
            for name in (finish.texture, finish.detail):
                if name not in names:
                    names.append(name)
            extent = _extent(solid, side)
            width, height = np.clip(np.ceil(extent / solid.texel), 3, 128).astype(int)
            x, y = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
            chart = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
            point, normal = _surface(solid, side, chart)
            positions.append(point)
            normals.append(normal)
            uv, fine = _layout(solid, side, finish, extent, index)
            scale = np.sqrt(np.prod(extent))
            rows.append({
                "texture": names.index(finish.texture), "detail": names.index(finish.detail),
                "uv": uv, "detail_uv": fine,
                "pitch": [np.sqrt(abs(np.linalg.det(m[:, :2]))) / scale for m in (uv, fine)],
                "tint": finish.tint, "gloss": finish.gloss, "emission": float(finish.shines),
                "tile": (start, width, height), "wraps": float(_is_round(solid, side)),
            })  # fmt: skip
            start += width * height

    def column(key: str) -> jax.Array:
        values = np.array([row[key] for row in rows])
        kind = np.int32 if values.dtype.kind == "i" else np.float32
        padding = [(0, -len(rows) % _PAD_FACES)] + [(0, 0)] * (values.ndim - 1)
        return jnp.asarray(np.pad(values, padding, mode="edge").astype(kind))

    # The padding is never written, so it takes no memory.
    texels = np.zeros((-(-len(names) // _PAD_TEXTURES) * _PAD_TEXTURES, shading.TEXELS), np.uint32)

    def fill(row: int) -> None:
        texels[row] = shading.pack_pyramid(draw_texture(names[row]))

    map_in_threads(fill, range(len(names)))
    world = shading.World(
        solids=make_solids(
            np.array([s.kind for s in solids]), to_world, np.array([s.taper for s in solids]),
            pad_to=_PAD_SOLIDS,
        ),
        faces=shading.Faces(**{key: column(key) for key in rows[0]}),
        texels=jnp.asarray(texels),
        light=jnp.zeros((0, 4)),
        lamp=jnp.asarray(model.lamps[0].position, jnp.float32),
    )  # fmt: skip
    places = np.concatenate(positions), np.concatenate(normals)
    light = bake(world, model.lamps, model.ambience, *places)
    light = np.pad(light, [(0, -start % _PAD_LIGHT), (0, 0)])
    return world.replace(light=jnp.asarray(light))


def _is_round(solid: Solid, side: int) -> bool:
    return solid.kind == SPHERE or (solid.kind == CYLINDER and side == 0)


def _extent(solid: Solid, side: int) -> np.ndarray:
    """Return width and height of a face in meters, along its chart."""
    x, y, z = solid.size
    if _is_round(solid, side):
        return np.array([np.pi * (x + y) / 2, z])
    if solid.kind == BOX:
        return np.array([(y, z), (x, z), (x, y)][side // 2])
    return np.array([x, y])


def _layout(
    solid: Solid, side: int, finish: Finish, extent: np.ndarray, index: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return affine maps `[2, 3]` from chart to texture and detail; texture rows run down."""
    flip = solid.kind == BOX and side in (0, 3, 4)
    upright = np.array([[-1.0 if flip else 1.0, 0, float(flip)], [0, -1, 1]])
    meters = np.diag(extent) @ upright
    if finish.grain and extent[1] > extent[0]:
        meters = meters[::-1]
    shift = np.array([index * 0.618034 + side * 0.37, index * 0.414214 + side * 0.61]) % 1

    def repeat(size: float) -> np.ndarray:
        return meters / size + np.column_stack([np.zeros((2, 2)), shift])

    left, top, right, bottom = finish.region
    fit = np.diag([right - left, bottom - top]) @ upright
    fit[:, 2] += left, top
    return fit if finish.size is None else repeat(finish.size), repeat(finish.detail_size)


def _surface(solid: Solid, side: int, chart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return world points and outward unit normals `[M, 3]` at chart coordinates `[M, 2]`."""
    a, b = 2 * chart.T - 1
    one = np.ones_like(a)
    if _is_round(solid, side):
        angle = 2 * np.pi * (chart[:, 0] - 0.5)
        if solid.kind == SPHERE:
            radius = np.sqrt(np.maximum(1 - b * b, 0))
            local = normal = np.stack([radius * np.cos(angle), radius * np.sin(angle), b], -1)
        else:
            radius = 1 + solid.taper * b
            local = np.stack([radius * np.cos(angle), radius * np.sin(angle), b], -1)
            normal = np.stack([np.cos(angle), np.sin(angle), -solid.taper * one], -1)
    elif solid.kind == BOX:
        axis, sign = side // 2, 2 * (side % 2) - 1
        local = np.insert(np.stack([a, b], -1), axis, sign, axis=-1)
        normal = np.broadcast_to(sign * np.eye(3)[axis], local.shape)
    else:
        end = 0 if solid.kind == PLANE else 2 * side - 3
        reach = 1 + end * solid.taper
        local = np.stack([reach * a, reach * b, end * one], -1)
        normal = np.broadcast_to([0.0, 0.0, 1.0 if end >= 0 else -1.0], local.shape)
    half = solid.size / 2
    normal = (normal / half) @ solid.rotation.T
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return (local * half) @ solid.rotation.T + solid.center, normal
