"""Draw materials such as wood, brick, glaze, cloth and leaves, and the fine detail of surfaces.

Each function draws a periodic texture: those in `COLORS` return colors `[1024, 1024, 3]` in about
[0, 1]; those in `DETAILS` return deviations `[1024, 1024]` from uniform gray.
"""

import cv2
import numpy as np

from jaxcloseup.drawn_scenes.textures.patterns import (
    SIZE,
    axes,
    edge_distance,
    grid,
    noise,
    ramp,
    rgb,
    scatter,
    step,
)


def _wood(rng: np.random.Generator, dark: tuple, mid: tuple, light: tuple) -> np.ndarray:
    _, y = axes()
    bend = noise(rng, octave=2, stretch=5, slope=2.5)
    rings = y * 9 + 0.55 * bend + 0.05 * noise(rng, octave=12, stretch=8)
    ring = rings % 1
    value = 0.65 * ring**1.6 + 0.25 * (0.5 + 0.2 * noise(rng, octave=40, stretch=25))
    color = ramp(np.clip(value, 0, 1), light, mid, dark)
    pores = noise(rng, octave=160, stretch=28, slope=2) + 0.8 * (ring - 0.5)
    return color * (1 - 0.35 * step(pores, 1.1, 2.2))


def _oak(rng: np.random.Generator) -> np.ndarray:
    return _wood(rng, (0.42, 0.25, 0.12), (0.66, 0.44, 0.24), (0.78, 0.58, 0.35))


def _walnut(rng: np.random.Generator) -> np.ndarray:
    return _wood(rng, (0.20, 0.11, 0.06), (0.38, 0.22, 0.12), (0.50, 0.32, 0.19))


def _pine(rng: np.random.Generator) -> np.ndarray:
    return _wood(rng, (0.66, 0.43, 0.20), (0.85, 0.66, 0.40), (0.93, 0.79, 0.56))


def _planks(rng: np.random.Generator) -> np.ndarray:
    u, v, column, row = grid(2, 12, bond=0.37)
    base = _wood(rng, (0.36, 0.21, 0.11), (0.60, 0.40, 0.23), (0.74, 0.55, 0.35))
    shift = rng.integers(0, SIZE, (12, 2))[row, column]
    y, x = np.mgrid[:SIZE, :SIZE]
    base = base[(y + 3 * shift) % SIZE, (x + shift) % SIZE]
    tone = rng.uniform(0.78, 1.12, (12, 2, 1))[row, column]
    gap = 1 - 0.75 * (1 - step(edge_distance(u, v, 2, 12), 0.0006, 0.0022))
    return base * tone * gap


def _brick(rng: np.random.Generator) -> np.ndarray:
    columns, rows = 4, 12
    u, v, column, row = grid(columns, rows, bond=0.5)
    rough = noise(rng, octave=60, slope=1.0)
    distance = edge_distance(u, v, columns, rows) + 0.0007 * noise(rng, octave=30)
    tone = rng.uniform(0, 1, (rows, columns))[row, column]
    face = ramp(tone, (0.48, 0.20, 0.14), (0.63, 0.29, 0.20), (0.72, 0.40, 0.28))
    face = face * (1 + 0.10 * rough + 0.07 * noise(rng, octave=8))[..., None]
    pits = step(noise(rng, octave=90, slope=2), 1.7, 2.4)
    face = face * (1 - 0.45 * pits)
    # Painted relief: the upper edges of bricks are lit and the lower ones shaded.
    height = step(distance, 0.003, 0.0075)[..., 0]
    relief = (np.roll(height, -2, 0) - np.roll(height, 2, 0))[..., None]
    mortar = rgb(0.70, 0.66, 0.60) * (1 + 0.11 * noise(rng, octave=90, slope=0.6))[..., None]
    blend = step(distance, 0.003, 0.006)
    return (mortar * (1 - blend) + face * blend) * (1 + 0.25 * relief)


def _tiles(rng: np.random.Generator) -> np.ndarray:
    """Draw glazed 4 x 4 wall tiles; every second one has a painted flower."""
    u, v, column, row = grid(4, 4)
    base = rgb(0.88, 0.90, 0.88) * rng.uniform(0.95, 1.03, (4, 4, 1))[row, column]
    base = base * (1 + 0.012 * noise(rng, octave=10))[..., None]
    x, y = 2 * u - 1, 2 * v - 1
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    ink = noise(rng, octave=30) * 0.03
    petals = 0.62 * np.abs(np.cos(2 * angle)) ** 0.6 + 0.06
    flower = 1 - step(radius - petals + ink, -0.02, 0.02)
    core = 1 - step(radius + ink, 0.13, 0.17)
    veins = step(np.abs(np.sin(14 * angle)), 0.25, 0.6)
    corner = 1 - step(np.hypot(1 - abs(x), 1 - abs(y)) + ink, 0.24, 0.28)
    rim = 1 - step(np.abs(np.maximum(abs(x), abs(y)) - 0.86) + 0.3 * ink, 0.008, 0.02)
    painted = ((column + row) % 2 == 0)[..., None]
    blue = rgb(0.16, 0.30, 0.58)
    base = base + painted * flower * (0.45 + 0.45 * veins) * (blue - base)
    base = base + painted * core * (rgb(0.86, 0.62, 0.18) - base)
    base = base + painted * corner * 0.8 * (blue - base)
    base = base + painted * rim * 0.7 * (blue - base)
    grout = 1 - step(edge_distance(u, v, 4, 4), 0.0018, 0.0034)
    return base + grout * (rgb(0.62, 0.60, 0.56) - base)


def _floor_tiles(rng: np.random.Generator) -> np.ndarray:
    u, v, column, row = grid(4, 4)
    dark = ((column + row) % 2)[..., None]
    vein = 1 - step(np.abs(noise(rng, octave=5, slope=1.8)), 0.0, 0.10)
    base = dark * rgb(0.30, 0.33, 0.36) + (1 - dark) * rgb(0.80, 0.77, 0.71)
    base = base * (1 + 0.05 * noise(rng, octave=20))[..., None] + 0.10 * vein * (2 * dark - 1)
    grout = 1 - step(edge_distance(u, v, 4, 4), 0.0018, 0.003)
    return base + grout * (rgb(0.48, 0.45, 0.42) - base)


def _granite(rng: np.random.Generator) -> np.ndarray:
    base = ramp(0.5 + 0.2 * noise(rng, octave=10), (0.16, 0.17, 0.18), (0.32, 0.31, 0.30))
    for color, octave, low in (
        ((0.62, 0.54, 0.46), 70, 0.9),
        ((0.07, 0.07, 0.08), 90, 1.0),
        ((0.80, 0.77, 0.74), 120, 1.5),
    ):
        grain = step(noise(rng, octave=octave, slope=2.5), low, low + 0.25)
        base = base + grain * (rgb(*color) - base)
    return base


def _plaster(rng: np.random.Generator) -> np.ndarray:
    value = 1 + 0.022 * noise(rng, octave=120, slope=1) + 0.02 * noise(rng, octave=3)
    return rgb(0.84, 0.81, 0.75) * value[..., None]


def _white(rng: np.random.Generator) -> np.ndarray:
    return np.full((SIZE, SIZE, 3), 0.88, np.float32) * (1 + 0.008 * noise(rng))[..., None]


def _steel(rng: np.random.Generator) -> np.ndarray:
    brush = noise(rng, octave=200, stretch=120, slope=1)
    return rgb(0.62, 0.63, 0.65) * (1 + 0.045 * brush)[..., None]


def _iron(rng: np.random.Generator) -> np.ndarray:
    rust = step(noise(rng, octave=14), 1.0, 1.8)
    base = rgb(0.13, 0.15, 0.15) * (1 + 0.14 * noise(rng, octave=80, slope=1))[..., None]
    return base + 0.5 * rust * (rgb(0.40, 0.22, 0.12) - base)


def _carpet(rng: np.random.Generator) -> np.ndarray:
    """Draw a rug: border, medallions and small diamonds, slightly worn."""
    x, y = axes()
    a, b = abs(2 * x - 1) + 0 * y, abs(2 * y - 1) + 0 * x
    wobble = 0.004 * noise(rng, octave=90)
    edge = np.maximum(a, b) + wobble
    red, navy = rgb(0.55, 0.14, 0.13), rgb(0.13, 0.16, 0.32)
    cream, gold = rgb(0.86, 0.79, 0.64), rgb(0.76, 0.55, 0.22)
    small = np.abs((24 * x) % 2 - 1) + np.abs((24 * y) % 2 - 1) + 3 * wobble
    field = red + (1 - step(np.abs(small - 0.55), 0.10, 0.2)) * (gold - red)
    big = np.abs((4 * x) % 2 - 1) + np.abs((4 * y) % 2 - 1) + wobble
    field = field + step(-big, -0.62, -0.58) * (navy - field)
    field = field + (1 - step(np.abs(big - 0.50), 0.03, 0.05)) * (cream - field)
    field = field + (1 - step(np.abs(big - 0.25), 0.05, 0.07)) * (gold - field)
    zigzag = np.abs((32 * np.where(a > b, y, x)) % 2 - 1)
    border = navy + step(np.abs(edge - 0.89) * 12 + zigzag - 0.8, -0.1, 0.1) * (cream - navy)
    inside = step(edge, 0.795, 0.805)
    out = field + inside * (border - field)
    for at in (0.80, 0.975):
        out = out + (1 - step(np.abs(edge - at), 0.008, 0.014)) * (gold - out)
    return out * (1 + 0.06 * noise(rng, octave=6))[..., None]


def _fabric(rng: np.random.Generator) -> np.ndarray:
    _, _, column, row = grid(8, 8)
    stripe = np.isin(column % 8, (1, 2)) * 0.5 + np.isin(row % 8, (1, 2)) * 0.5
    thin = ((column == 5) * 0.35 + (row == 5) * 0.35) * 1.0
    base = ramp(stripe, (0.90, 0.87, 0.80), (0.62, 0.68, 0.74), (0.28, 0.40, 0.55))
    base = base + thin[..., None] * (rgb(0.70, 0.25, 0.20) - base)
    return base * (1 + 0.03 * noise(rng, octave=40))[..., None]


def _upholstery(rng: np.random.Generator) -> np.ndarray:
    u, v, column, row = grid(64, 64)
    weave = np.where((column + row) % 2, u, v)
    base = ramp(0.5 + 0.2 * noise(rng, octave=30), (0.20, 0.36, 0.37), (0.32, 0.50, 0.49))
    return base * (0.85 + 0.3 * np.sin(np.pi * weave))[..., None]


def _wallpaper(rng: np.random.Generator) -> np.ndarray:
    x, y = axes()
    u, v, *_ = grid(5, 5, bond=0.5)
    p, q = 2 * u - 1, 2 * v - 1
    radius, angle = np.hypot(p, 0.75 * q), np.arctan2(p, -q)
    ink = 0.02 * noise(rng, octave=50)
    leaf = 0.42 + 0.22 * np.cos(6 * angle) + 0.10 * np.cos(angle)
    shape = 1 - step(radius - leaf + ink, -0.02, 0.02)
    veins = step(np.abs(np.sin(9 * angle + 6 * radius)), 0.1, 0.35)
    stripe = step(np.sin(2 * np.pi * 20 * x) + 0 * y, -0.15, 0.15)
    base = rgb(0.80, 0.76, 0.62) * (0.985 + 0.03 * stripe)
    base = base + shape * (0.4 + 0.5 * veins) * (rgb(0.46, 0.56, 0.44) - base)
    dot = 1 - step(np.hypot(p, 0.75 * (q - 0.85)), 0.05, 0.08)
    return base + dot * (rgb(0.72, 0.42, 0.30) - base)


def _leaves(rng: np.random.Generator) -> np.ndarray:
    def leaf(image: np.ndarray, rng: np.random.Generator, at: np.ndarray) -> None:
        angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(14, 34)
        along = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-along[1], along[0]])
        s = np.linspace(0, 1, 9)
        width = 0.42 * length * np.sin(np.pi * s**0.8) * rng.uniform(0.7, 1.1)
        side = [at + np.outer(s * length, along) + np.outer(k * width, across) for k in (0.5, -0.5)]
        shape = np.round(16 * np.concatenate([side[0], side[1][::-1]])).astype(np.int32)
        tone = rgb(0.22, 0.42, 0.14) * rng.uniform(0.45, 1.45)
        tone = tone + rgb(rng.uniform(0, 0.12), rng.uniform(0, 0.06), 0)
        cv2.fillPoly(image, [shape], tone.tolist(), cv2.LINE_AA, 4)
        ends = np.round(16 * np.stack([at, at + length * along])).astype(np.int32)
        cv2.line(image, ends[0], ends[1], (tone * 1.4).tolist(), 1, cv2.LINE_AA, 4)

    return scatter(rng, np.full((SIZE, SIZE, 3), (0.05, 0.09, 0.03)), 5200, leaf)


def _gravel(rng: np.random.Generator) -> np.ndarray:
    def stone(image: np.ndarray, rng: np.random.Generator, at: np.ndarray) -> None:
        radii = rng.uniform(4, 14) * np.array([1, rng.uniform(0.6, 1)])
        angle = np.deg2rad(np.arange(0, 360, 40)) + rng.uniform(0, 0.5, 9)
        turn = rng.uniform(0, np.pi)
        x, y = radii[0] * np.cos(angle), radii[1] * np.sin(angle)
        shape = np.stack(
            [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)], 1
        )
        tone = rgb(0.56, 0.51, 0.45) * rng.uniform(0.55, 1.35)
        for scale, shift, factor in ((1.12, 1.5, 0.45), (1.0, 0.0, 1.0), (0.55, -1.5, 1.12)):
            polygon = np.round(16 * (at + shift + scale * shape)).astype(np.int32)
            cv2.fillPoly(image, [polygon], (tone * factor).tolist(), cv2.LINE_AA, 4)

    image = scatter(rng, np.full((SIZE, SIZE, 3), (0.25, 0.22, 0.19)), 6500, stone)
    return image * (1 + 0.06 * noise(rng, octave=150, slope=0.5))[..., None]


def _grass(rng: np.random.Generator) -> np.ndarray:
    def blade(image: np.ndarray, rng: np.random.Generator, at: np.ndarray) -> None:
        length, lean = rng.uniform(18, 46), rng.uniform(-0.9, 0.9)
        bend = at + length * np.array([[0, 0], [0.3 * lean, -0.6], [lean, -1]])
        tone = rgb(0.30, 0.47, 0.17) * rng.uniform(0.5, 1.4)
        points = np.round(16 * bend).astype(np.int32)
        cv2.polylines(
            image, [points], False, tone.tolist(), int(rng.integers(1, 4)), cv2.LINE_AA, 4
        )

    return scatter(rng, np.full((SIZE, SIZE, 3), (0.10, 0.15, 0.05)), 9000, blade)


def _bark(rng: np.random.Generator) -> np.ndarray:
    ridges = np.abs(noise(rng, octave=14, stretch=0.22, slope=1.2))
    value = np.clip(ridges * 0.55 + 0.10 * noise(rng, octave=80, slope=0.8), 0, 1)
    return ramp(value, (0.12, 0.09, 0.07), (0.33, 0.26, 0.20), (0.50, 0.43, 0.36))


def _bread(rng: np.random.Generator) -> np.ndarray:
    value = 0.5 + 0.22 * noise(rng, octave=6) + 0.08 * noise(rng, octave=70, slope=1)
    crust = ramp(np.clip(value, 0, 1), (0.50, 0.26, 0.10), (0.74, 0.46, 0.20), (0.86, 0.66, 0.38))
    flour = step(noise(rng, octave=25, slope=1), 1.0, 2.0)
    return crust + 0.6 * flour * (rgb(0.93, 0.88, 0.80) - crust)


def _peel(rng: np.random.Generator) -> np.ndarray:
    """Draw fruit peel, nearly white so that finishes can tint it."""
    pores = step(noise(rng, octave=60, slope=3), 1.2, 1.9)
    base = np.full((SIZE, SIZE, 3), 0.92, np.float32) * (1 + 0.05 * noise(rng, octave=4))[..., None]
    return base * (1 - 0.22 * pores)


def _sky(rng: np.random.Generator) -> np.ndarray:
    _, y = axes()
    clouds = step(0.6 * noise(rng, octave=5, slope=1.6, stretch=0.6), 0.2, 1.6)
    base = ramp(y[:, 0], (0.40, 0.60, 0.86), (0.62, 0.77, 0.92), (0.88, 0.91, 0.93))[:, None]
    base = np.broadcast_to(base, (SIZE, SIZE, 3))
    return base + 0.8 * clouds * (rgb(0.96, 0.96, 0.97) - base)


COLORS = {
    "oak": _oak, "walnut": _walnut, "pine": _pine, "planks": _planks, "brick": _brick,
    "tiles": _tiles, "floor_tiles": _floor_tiles, "granite": _granite, "plaster": _plaster,
    "white": _white, "steel": _steel, "iron": _iron, "carpet": _carpet, "fabric": _fabric,
    "upholstery": _upholstery, "wallpaper": _wallpaper, "leaves": _leaves, "gravel": _gravel,
    "grass": _grass, "bark": _bark, "bread": _bread, "peel": _peel, "sky": _sky,
}  # fmt: skip
