"""The five built-in scenes, in metres with z up, each photographed mainly from -y."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxcloseup.scenes.modelling import (
    Finish,
    Lamp,
    Model,
    Solid,
    block,
    box,
    cylinder,
    rod,
    sheet,
    sphere,
    turn,
)


class Rig(NamedTuple):
    """Where the far photographs are taken from, and what deserves a close look.

    Attributes:
      target: `[3]` what the far cameras look at.
      distance: (lo, hi) metres from it.
      azimuth: (lo, hi) degrees about z, 0 straight in front (from -y).
      elevation: (lo, hi) degrees above the horizon.
      interests: (x, y, z, radius) balls in which close-up views find their subjects.
    """

    target: tuple[float, float, float]
    distance: tuple[float, float]
    azimuth: tuple[float, float]
    elevation: tuple[float, float]
    interests: tuple[tuple[float, float, float, float], ...]


OAK = Finish("oak", 0.5, "grain", 0.22, gloss=0.06, grain=True)
WALNUT = Finish("walnut", 0.5, "grain", 0.2, gloss=0.08, grain=True)
PINE = Finish("pine", 0.45, "grain", 0.2, gloss=0.03, grain=True)
PLANKS = Finish("planks", 1.6, "grain", 0.3, gloss=0.05)
PLASTER = Finish("plaster", 0.8, "grit", 0.5)
WHITE = Finish("white", 0.6, "paper", 0.15, gloss=0.05)
CHINA = Finish("white", 0.5, gloss=0.25)
STEEL = Finish("steel", 0.2, "scratches", 0.15, gloss=0.35)
IRON = Finish("iron", 0.35, "grit", 0.12, gloss=0.08)
BLACK = Finish("white", 0.5, "scratches", 0.3, tint=(0.10, 0.10, 0.11), gloss=0.3)
BRASS = Finish("steel", 0.2, "scratches", 0.1, tint=(1.15, 0.92, 0.50), gloss=0.35)
CLOTH = Finish("fabric", 0.28, "weave", 0.055)
SOFA = Finish("upholstery", 0.35, "weave", 0.08)
PAPER = Finish("white", 0.3, "paper", 0.08)
BRICK = Finish("brick", 0.9, "grit", 0.25)


def _print(name: str, region=(0.0, 0.0, 1.0, 1.0), **options) -> Finish:
    return Finish(name, None, "paper", 0.1, region=region, **options)


def _peel(*tint: float) -> Finish:
    return Finish("peel", 0.12, "grit", 0.12, tint=tint, gloss=0.15)


def _tinted(finish: Finish, *tint: float) -> Finish:
    return finish._replace(tint=tint)


def _label(index: int) -> Finish:
    y, x = divmod(index, 2)
    return _print("labels", (x / 2, y / 2, x / 2 + 0.5, y / 2 + 0.5), gloss=0.08)


def _interior(low, high, floor: Finish, wall: Finish, back: Finish | None = None) -> list[Solid]:
    """Six sheets that face into a room."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    x, y, z = (x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2
    width, depth, height = x1 - x0, y1 - y0, z1 - z0
    return [
        sheet((x, y, z0), (width, depth), floor, texel=0.035),
        sheet((x, y, z1), (width, depth), WHITE, facing="-z", texel=0.15),
        sheet((x, y1, z), (width, height), back or wall, facing="-y", texel=0.035),
        sheet((x, y0, z), (width, height), wall, facing="+y", texel=0.12),
        sheet((x0, y, z), (depth, height), wall, facing="+x", texel=0.06),
        sheet((x1, y, z), (depth, height), wall, facing="-x", texel=0.06),
    ]


def _framed(centre, size, picture: Finish, *, facing="-y", frame: Finish = WALNUT) -> list[Solid]:
    """A picture in a frame of four bars, hung on the wall behind `centre`."""
    (x, y, z), (width, height) = centre, size
    out = {"-y": (0, -1, 0), "+x": (1, 0, 0), "-x": (-1, 0, 0)}[facing]
    out, across = np.array(out, float), np.array([abs(out[1]), abs(out[0]), 0.0])
    thick = 0.025
    solids = [sheet(np.array([x, y, z]) + 0.012 * out, size, picture, facing=facing, texel=0.02)]
    for sign in (-1, 1):
        middle = np.array([x, y, z]) + 0.013 * out
        post = middle + sign * (width / 2 + thick / 2) * across
        bar = middle + sign * np.array([0, 0, height / 2 + thick / 2])
        bulk = 0.026 * np.abs(out)
        solids.append(box(post, across * thick + bulk + (0, 0, height), frame))
        solids.append(box(bar, across * (width + 2 * thick) + bulk + (0, 0, thick), frame))
    return solids


def _jar(x: float, y: float, z: float, label: int, contents: tuple) -> list[Solid]:
    lid = Finish("steel", 0.2, "scratches", 0.1, tint=(0.9, 0.3, 0.25), gloss=0.3)
    return [
        cylinder((x, y, z), 0.085, 0.056, 0.056, _tinted(CHINA, *contents)),
        cylinder((x, y, z + 0.015), 0.05, 0.0575, 0.0575, _label(label)),
        cylinder((x, y, z + 0.085), 0.018, 0.05, 0.05, lid),
    ]


def _counter() -> tuple[Model, Rig]:
    tiles = Finish("tiles", 0.6, gloss=0.22)
    granite = Finish("granite", 0.35, "grit", 0.3, gloss=0.3)
    floor = Finish("floor_tiles", 1.2, "grit", 0.4, gloss=0.1)
    solids = _interior((-2.2, -3.6, 0), (2.2, 0.0, 2.6), floor, PLASTER, tiles)
    # Cupboards, worktop, and a shelf on the wall.
    solids += [
        block((-1.8, -0.58, 0.1), (1.8, -0.01, 0.86), _tinted(PINE, 0.6, 0.6, 0.6), texel=0.06),
        block((-1.8, -0.54, 0.0), (1.8, -0.01, 0.1), BLACK, texel=0.06),
        block((-1.85, -0.63, 0.86), (1.85, -0.005, 0.9), granite, texel=0.02),
        block((-1.35, -0.17, 1.36), (-0.1, -0.005, 1.385), PINE),
        block((0.75, -0.34, 1.5), (1.85, -0.005, 2.15), OAK, texel=0.04),
    ]
    for i in range(6):
        x = -1.5 + 0.6 * i
        solids.append(box((x, -0.59, 0.38), (0.585, 0.02, 0.54), OAK, texel=0.04))
        solids.append(box((x, -0.59, 0.755), (0.585, 0.02, 0.175), OAK, texel=0.04))
        solids.append(rod((x - 0.09, -0.625, 0.755), (x + 0.09, -0.625, 0.755), 0.012, STEEL))
        solids += [
            rod((x + s, -0.6, 0.755), (x + s, -0.625, 0.755), 0.01, STEEL) for s in (-0.08, 0.08)
        ]
    for i, x in enumerate((-1.25, -1.16, -1.07, -0.98)):
        solids += _jar(
            x,
            -0.09,
            1.385,
            (3, 0, 1, 3)[i],
            [(0.7, 0.5, 0.1), (0.5, 0.1, 0.1), (0.3, 0.4, 0.2), (0.4, 0.25, 0.1)][i],
        )
    for i in range(7):  # cookery books
        tall = 0.2 + 0.02 * ((i * 3) % 4)
        region = (i / 8, 0.0, (i + 1) / 8, 1.0)
        x = -0.82 + 0.034 * i
        solids.append(
            box((x, -0.09, 1.385 + tall / 2), (0.031, 0.15, tall), PAPER, texel=0.02,
                faces={2: _print("spines", region), 0: _tinted(PAPER, 0.4, 0.3, 0.3), 1: _tinted(PAPER, 0.4, 0.3, 0.3)})
        )  # fmt: skip
    # Rail with hanging tools.
    solids.append(rod((-0.05, -0.05, 1.42), (0.68, -0.05, 1.42), 0.014, STEEL))
    for i, x in enumerate((0.04, 0.18, 0.32, 0.46, 0.6)):
        solids.append(rod((x, -0.065, 1.43), (x, -0.065, 1.20), 0.009, (STEEL, PINE)[i % 2]))
    solids += [
        sphere((0.04, -0.075, 1.17), (0.085, 0.05, 0.075), STEEL),
        box((0.18, -0.065, 1.155), (0.06, 0.008, 0.1), PINE),
        box((0.46, -0.065, 1.155), (0.055, 0.008, 0.1), PINE),
        sphere((0.6, -0.07, 1.16), (0.06, 0.03, 0.09), STEEL),
    ]
    for k in range(5):
        x = 0.32 + 0.016 * (k - 2)
        solids.append(rod((0.32, -0.065, 1.2), (x, -0.065, 1.1), 0.004, STEEL))
    # Left: breakfast.
    cereal = _print("cereal", gloss=0.06)
    side = _tinted(PAPER, 0.95, 0.66, 0.18)
    solids.append(
        box((-0.92, -0.3, 1.045), (0.2, 0.07, 0.29), side, rotation=turn(z=18), texel=0.02,
            faces={2: cereal, 3: cereal})
    )  # fmt: skip
    for x, y, z, label in (
        (-0.66, -0.2, 0.9, 0),
        (-0.57, -0.2, 0.9, 1),
        (-0.615, -0.2, 1.01, 0),
        (-0.66, -0.33, 0.9, 1),
    ):
        solids.append(
            cylinder(
                (x, y, z),
                0.11,
                0.078,
                0.078,
                _label(label),
                faces={1: STEEL, 2: STEEL},
                rotation=turn(z=-80 + 30 * x),
            )
        )
    # Middle: board, bread, knife, open recipe.
    solids += [
        box((-0.18, -0.36, 0.911), (0.44, 0.28, 0.022), PINE, rotation=turn(z=-8), texel=0.015),
        sphere(
            (-0.24, -0.33, 0.972),
            (0.27, 0.13, 0.115),
            Finish("bread", 0.25, "grit", 0.15),
            rotation=turn(z=-14),
            texel=0.015,
        ),
        box((-0.08, -0.44, 0.9245), (0.2, 0.03, 0.003), STEEL, rotation=turn(z=22)),
        box((0.065, -0.38, 0.93), (0.12, 0.026, 0.018), WALNUT, rotation=turn(z=22)),
    ]
    lean = turn(x=-22, z=-6)
    solids += [
        box(
            (0.27, -0.16, 1.04), (0.25, 0.02, 0.30), _tinted(PAPER, 0.6, 0.15, 0.12), rotation=lean
        ),
        sheet(
            np.array([0.27, -0.16, 1.04]) + lean @ [0, -0.0115, 0.0],
            (0.235, 0.29),
            _print("recipe"),
            facing="-y",
            rotation=lean,
            texel=0.015,
        ),
        box((0.27, -0.25, 0.915), (0.27, 0.1, 0.03), PINE, rotation=turn(z=-6)),
    ]
    # Right: fruit, kettle, hob with a pot.
    solids.append(
        cylinder(
            (0.58, -0.4, 0.9),
            0.075,
            0.12,
            0.27,
            CHINA,
            texel=0.015,
            faces={2: _tinted(CHINA, 0.7, 0.72, 0.75)},
        )
    )
    fruit = (
        (0.53, -0.44, 1.0, 0.085, (0.98, 0.52, 0.10)), (0.62, -0.45, 0.998, 0.08, (0.98, 0.55, 0.12)),
        (0.60, -0.36, 1.0, 0.085, (0.72, 0.10, 0.10)), (0.51, -0.36, 0.995, 0.075, (0.50, 0.68, 0.16)),
        (0.57, -0.41, 1.055, 0.08, (0.98, 0.50, 0.08)),
    )  # fmt: skip
    solids += [sphere((x, y, z), size, _peel(*tint), texel=0.01) for x, y, z, size, tint in fruit]
    solids.append(
        sphere(
            (0.66, -0.39, 1.02),
            (0.09, 0.06, 0.06),
            _peel(0.98, 0.86, 0.22),
            rotation=turn(z=30, y=20),
            texel=0.01,
        )
    )
    solids += [
        block((0.86, -0.55, 0.9), (1.5, -0.08, 0.912), BLACK, texel=0.02),
        *(
            cylinder((x, y, 0.912), 0.004, 0.17, 0.17, _tinted(IRON, 1.6, 1.4, 1.4))
            for x in (1.02, 1.34)
            for y in (-0.2, -0.43)
        ),
        cylinder((1.02, -0.2, 0.916), 0.15, 0.21, 0.22, STEEL, texel=0.02),
        cylinder((1.02, -0.2, 1.066), 0.02, 0.225, 0.18, STEEL),
        sphere((1.02, -0.2, 1.1), 0.035, BLACK),
        rod((0.86, -0.2, 1.03), (0.92, -0.2, 1.03), 0.02, BLACK),
        rod((1.12, -0.2, 1.03), (1.18, -0.2, 1.03), 0.02, BLACK),
        cylinder(
            (1.34, -0.43, 0.916), 0.15, 0.19, 0.12, _tinted(STEEL, 1.1, 0.35, 0.3), texel=0.02
        ),
        sphere((1.34, -0.43, 1.075), 0.035, BLACK),
        rod((1.27, -0.45, 0.98), (1.2, -0.48, 1.06), 0.024, STEEL),
        rod((1.28, -0.43, 1.06), (1.28, -0.43, 1.16), 0.014, BLACK),
        rod((1.40, -0.43, 1.06), (1.40, -0.43, 1.16), 0.014, BLACK),
        rod((1.275, -0.43, 1.16), (1.405, -0.43, 1.16), 0.02, WALNUT),
    ]
    solids.append(
        cylinder(
            (0.36, -0.004, 1.75),
            0.04,
            0.3,
            0.3,
            WALNUT,
            rotation=turn(x=90),
            faces={2: _print("clock")},
            texel=0.02,
        )
    )
    solids.append(sheet((-0.3, -0.634, 0.62), (0.24, 0.34), CLOTH, facing="-y", texel=0.02))
    lamps = [
        Lamp((0.9, -1.9, 2.4), 0.22, (2.5, 2.35, 2.1)),
        Lamp((-1.6, -2.2, 2.2), 0.35, (1.1, 1.2, 1.35)),
    ]
    interests = (
        (-0.92, -0.33, 1.05, 0.16), (-0.62, -0.25, 0.98, 0.12), (-0.24, -0.36, 0.97, 0.14),
        (0.27, -0.17, 1.05, 0.15), (0.57, -0.41, 1.0, 0.12), (-0.75, -0.17, 1.48, 0.14),
        (0.36, -0.04, 1.75, 0.14), (0.2, -0.06, 1.2, 0.15), (1.02, -0.3, 1.0, 0.16),
        (-1.1, -0.12, 1.42, 0.12), (0.0, -0.01, 1.15, 0.3), (-0.3, -0.63, 0.7, 0.2),
    )  # fmt: skip
    rig = Rig((-0.05, -0.3, 1.08), (1.75, 2.15), (-42, 42), (2, 34), interests)
    return Model(solids, lamps, (0.62, 0.63, 0.66), 0.5), rig


def _chair(x: float, y: float, facing: float) -> list[Solid]:
    """A slatted chair at (x, y) whose back is behind it when looking along `facing` degrees."""
    rotation = turn(z=facing)

    def at(*p: float) -> np.ndarray:
        return rotation @ np.array(p) + (x, y, 0)

    solids = [box(at(0, 0, 0.45), (0.42, 0.42, 0.035), WALNUT, rotation=rotation)]
    for sx in (-0.18, 0.18):
        solids.append(rod(at(sx, 0.18, 0), at(sx, 0.18, 0.44), 0.035, WALNUT))
        solids.append(rod(at(sx, -0.19, 0), at(sx, -0.25, 0.98), 0.035, WALNUT))
    for k in range(3):
        z = 0.62 + 0.14 * k
        solids.append(
            box(at(0, -0.20 - 0.06 * (z - 0.44), z), (0.36, 0.018, 0.07), WALNUT, rotation=rotation)
        )
    return solids


def _setting(x: float, y: float, facing: float, z: float) -> list[Solid]:
    """Plate, cutlery, napkin and glass for a guest who looks along +y turned by `facing`."""
    rotation = turn(z=facing)

    def at(px: float, py: float, pz: float = 0.0) -> np.ndarray:
        return rotation @ np.array([px, py, 0]) + (x, y, z + pz)

    china = {2: _print("plate", gloss=0.2)}
    solids = [
        cylinder(at(0, 0), 0.016, 0.17, 0.265, CHINA, faces=china, rotation=rotation, texel=0.012),
        box(at(0.175, -0.02, 0.003), (0.02, 0.13, 0.004), STEEL, rotation=rotation),
        box(at(0.175, -0.105, 0.004), (0.014, 0.09, 0.008), STEEL, rotation=rotation),
        rod(at(0.21, -0.11, 0.005), at(0.21, 0.03, 0.006), 0.008, STEEL),
        sphere(at(0.21, 0.05, 0.008), (0.038, 0.055, 0.014), STEEL, rotation=rotation),
        box(at(-0.205, -0.02, 0.004), (0.12, 0.19, 0.008), CLOTH, rotation=rotation, texel=0.012),
        rod(at(-0.19, -0.11, 0.013), at(-0.19, 0.02, 0.013), 0.008, STEEL),
        box(at(-0.19, 0.025, 0.013), (0.026, 0.012, 0.005), STEEL, rotation=rotation),
    ]
    for k in range(4):
        px = -0.19 + 0.0075 * (k - 1.5)
        solids.append(rod(at(px, 0.025, 0.013), at(px, 0.075, 0.013), 0.0035, STEEL))
    glass = Finish("white", 0.4, tint=(0.50, 0.66, 0.72), gloss=0.4)
    wine = {2: _tinted(glass, 0.35, 0.07, 0.12)}
    solids.append(cylinder(at(0.16, 0.14), 0.105, 0.055, 0.075, glass, faces=wine, texel=0.012))
    return solids


def _table() -> tuple[Model, Rig]:
    wallpaper = Finish("wallpaper", 0.9, "paper", 0.2)
    solids = _interior((-2.4, -2.8, 0), (2.4, 2.2, 2.6), PLANKS, wallpaper)
    top = 0.76
    for k in range(5):
        y = -0.384 + 0.192 * k
        solids.append(box((0, y, top - 0.018), (1.7, 0.190, 0.036), OAK, texel=0.015))
    solids.append(block((-0.75, -0.4, 0.64), (0.75, 0.4, 0.72), OAK))
    for x in (-0.72, 0.72):
        for y in (-0.38, 0.38):
            solids.append(cylinder((x, y, 0), 0.7, 0.05, 0.08, OAK))
    solids.append(box((0, 0, top + 0.0015), (1.72, 0.30, 0.003), CLOTH, texel=0.02))
    for x in (-0.42, 0.42):
        solids += _setting(x, -0.29, 0, top) + _setting(x, 0.29, 180, top)
        solids += _chair(x, 0.72, 180)
    solids += _chair(1.15, 0, 90) + _chair(-1.15, 0, -90)
    # Along the middle: flowers, wine, bread, candles, salt and pepper, the menu.
    cloth = top + 0.003
    vase = Finish("white", 0.4, "scratches", 0.2, tint=(0.30, 0.44, 0.62), gloss=0.35)
    stem = Finish("leaves", 0.3, tint=(1.2, 1.3, 1.2))
    solids += [
        cylinder((0.03, 0.02, cloth), 0.09, 0.07, 0.12, vase, texel=0.012),
        cylinder((0.03, 0.02, cloth + 0.09), 0.08, 0.12, 0.06, vase, texel=0.012),
    ]
    rng = np.random.default_rng(4)
    petals = ((0.93, 0.78, 0.20), (0.86, 0.30, 0.36), (0.94, 0.90, 0.86), (0.70, 0.42, 0.70))
    for i in range(7):
        angle = 2 * np.pi * i / 7
        tip = np.array(
            [
                0.03 + 0.10 * np.cos(angle),
                0.02 + 0.10 * np.sin(angle),
                cloth + 0.27 + 0.05 * rng.uniform(),
            ]
        )
        solids.append(rod((0.03, 0.02, cloth + 0.15), tip, 0.006, stem))
        solids.append(
            sphere(
                tip,
                (0.075, 0.075, 0.045),
                _peel(*petals[i % 4]),
                rotation=turn(x=20 * np.sin(angle), y=20 * np.cos(angle)),
                texel=0.01,
            )
        )
        solids.append(sphere(tip + (0, 0, 0.016), 0.022, _peel(0.5, 0.32, 0.1), texel=0.01))
        solids.append(
            sphere(
                0.4 * np.array([0.03, 0.02, cloth + 0.15]) + 0.6 * tip + (0, 0, -0.02),
                (0.07, 0.03, 0.015),
                stem,
                rotation=turn(y=-30, z=np.rad2deg(angle)),
                texel=0.01,
            )
        )
    green = Finish("white", 0.4, tint=(0.10, 0.22, 0.14), gloss=0.45)
    solids += [
        cylinder((-0.24, 0.03, cloth), 0.2, 0.076, 0.076, green, texel=0.012),
        cylinder(
            (-0.24, 0.03, cloth + 0.05),
            0.10,
            0.0772,
            0.0772,
            _label(2),
            texel=0.012,
            rotation=turn(z=-90),
        ),
        cylinder((-0.24, 0.03, cloth + 0.2), 0.05, 0.076, 0.03, green),
        cylinder((-0.24, 0.03, cloth + 0.25), 0.07, 0.03, 0.028, _tinted(green, 0.35, 0.06, 0.10)),
    ]
    crust = Finish("bread", 0.22, "grit", 0.12)
    wicker = Finish("fabric", 0.2, "weave", 0.1, tint=(0.62, 0.46, 0.28))
    solids.append(cylinder((0.36, 0.0, cloth), 0.05, 0.18, 0.23, wicker, texel=0.012))
    for i, (x, y) in enumerate(((0.32, 0.03), (0.40, -0.03), (0.37, 0.05))):
        solids.append(
            sphere(
                (x, y, cloth + 0.07), (0.12, 0.08, 0.07), crust, rotation=turn(z=50 * i), texel=0.01
            )
        )
    for x in (-0.55, 0.62):
        solids += [
            cylinder((x, 0, cloth), 0.012, 0.09, 0.07, BRASS),
            cylinder((x, 0, cloth + 0.012), 0.06, 0.02, 0.03, BRASS),
            cylinder((x, 0, cloth + 0.072), 0.17, 0.022, 0.02, _tinted(CHINA, 1.0, 0.96, 0.86)),
        ]
    for x, tone in ((-0.09, 0.95), (-0.14, 0.3)):
        solids.append(
            cylinder((x, -0.09, cloth), 0.065, 0.04, 0.03, _tinted(CHINA, tone, tone, tone))
        )
        solids.append(sphere((x, -0.09, cloth + 0.066), (0.03, 0.03, 0.018), STEEL))
    for facing, angle, dy in (("-y", -18, -0.03), ("+y", 18, 0.03)):
        lean = turn(x=angle)
        solids.append(
            sheet(
                (0.17, -0.06 + dy, cloth + 0.088),
                (0.13, 0.18),
                _print("menu"),
                facing=facing,
                rotation=lean,
                texel=0.012,
            )
        )
    # Around the room.
    for x, name in ((-1.2, "dusk"), (0.0, "day"), (1.2, "grey")):
        solids += _framed((x, 2.2, 1.55), (0.6, 0.75), _print(name, gloss=0.05))
    solids += [block((-1.1, 1.75, 0.0), (1.1, 2.19, 0.85), WALNUT, texel=0.05)]
    solids.append(block((-2.4, 2.18, 0.0), (2.4, 2.2, 0.12), WHITE, texel=0.06))
    lamps = [
        Lamp((-0.7, -1.0, 2.35), 0.25, (2.6, 2.4, 2.1)),
        Lamp((1.7, -1.4, 2.1), 0.4, (1.0, 1.1, 1.25)),
    ]
    interests = (
        (-0.42, -0.29, 0.77, 0.14), (0.42, -0.29, 0.77, 0.14), (-0.24, 0.0, 0.87, 0.10),
        (0.03, 0.0, 1.03, 0.14), (0.36, 0.0, 0.82, 0.12), (0.17, -0.09, 0.85, 0.10),
        (-0.62, -0.3, 0.77, 0.12), (-0.05, -0.38, 0.76, 0.12), (0.2, -0.3, 0.77, 0.12),
        (0.42, 0.29, 0.77, 0.14), (-0.55, 0.0, 0.85, 0.12), (0.62, -0.25, 0.77, 0.12),
    )  # fmt: skip
    rig = Rig((0.0, 0.0, 0.82), (1.45, 1.8), (-75, 75), (16, 50), interests)
    return Model(solids, lamps, (0.60, 0.60, 0.62), 0.5), rig


def _room() -> tuple[Model, Rig]:
    solids = _interior((-2.4, -3.6, 0), (2.4, 1.0, 2.6), PLANKS, PLASTER)
    rug = Finish("carpet", None, "pile", 0.17)
    solids.append(
        block(
            (-1.35, -1.75, 0.0),
            (1.25, -0.05, 0.012),
            Finish("carpet", 1.0, "pile", 0.17),
            faces={5: rug},
            texel=0.025,
        )
    )
    solids.append(block((-2.4, 0.98, 0.0), (2.4, 1.0, 0.11), WHITE, texel=0.06))
    # Sofa with cushions.
    solids += [
        block((-1.25, 0.0, 0.12), (0.75, 0.9, 0.36), SOFA, texel=0.04),
        block((-1.25, 0.68, 0.3), (0.75, 0.92, 0.88), SOFA, texel=0.04),
        block((-1.45, 0.0, 0.12), (-1.25, 0.92, 0.62), SOFA, texel=0.04),
        block((0.75, 0.0, 0.12), (0.95, 0.92, 0.62), SOFA, texel=0.04),
    ]
    for x in (-0.92, -0.25, 0.42):
        solids.append(box((x, 0.33, 0.43), (0.64, 0.68, 0.15), SOFA, texel=0.03))
        solids.append(
            box((x, 0.62, 0.68), (0.63, 0.16, 0.40), SOFA, rotation=turn(x=-10), texel=0.03)
        )
    solids += [
        cylinder((x, y, 0), 0.12, 0.04, 0.06, WALNUT) for x in (-1.35, 0.85) for y in (0.08, 0.84)
    ]
    solids += [
        sphere(
            (-1.0, 0.40, 0.68), (0.46, 0.17, 0.42), CLOTH, rotation=turn(x=-18, z=14), texel=0.02
        ),
        sphere(
            (0.48, 0.40, 0.68),
            (0.44, 0.17, 0.40),
            Finish("carpet", 0.35, "weave", 0.06),
            rotation=turn(x=-18, z=-16),
            texel=0.02,
        ),
        box(
            (0.2, 0.26, 0.513),
            (0.5, 0.36, 0.02),
            Finish("fabric", 0.2, "weave", 0.05, tint=(1.0, 0.85, 0.6)),
            rotation=turn(z=12),
            texel=0.02,
        ),
    ]
    # Low table with a newspaper, a mug and books.
    solids.append(box((-0.1, -0.85, 0.40), (1.1, 0.55, 0.035), WALNUT, texel=0.018))
    solids.append(box((-0.1, -0.85, 0.16), (0.98, 0.44, 0.02), WALNUT, texel=0.03))
    solids += [
        rod((x, y, 0), (x, y, 0.39), 0.035, IRON) for x in (-0.58, 0.38) for y in (-1.07, -0.63)
    ]
    table = 0.4175
    news = _print("newspaper")
    solids.append(
        box(
            (-0.36, -0.88, table + 0.004),
            (0.3, 0.42, 0.008),
            PAPER,
            rotation=turn(z=16),
            faces={5: news},
            texel=0.015,
        )
    )
    mug = Finish("white", 0.3, tint=(0.86, 0.36, 0.24), gloss=0.3)
    solids += [
        cylinder(
            (0.06, -0.72, table),
            0.095,
            0.075,
            0.085,
            mug,
            faces={2: _tinted(mug, 0.16, 0.09, 0.05)},
            texel=0.012,
        ),
        rod((0.10, -0.72, table + 0.075), (0.13, -0.72, table + 0.07), 0.012, mug),
        rod((0.13, -0.72, table + 0.072), (0.13, -0.72, table + 0.025), 0.012, mug),
        rod((0.13, -0.72, table + 0.027), (0.095, -0.72, table + 0.02), 0.012, mug),
    ]
    for i, (size, angle) in enumerate(
        (((0.26, 0.19, 0.035), 8), ((0.24, 0.17, 0.03), -6), ((0.2, 0.14, 0.028), 20))
    ):
        z = table + 0.0175 + 0.033 * i
        cover = _tinted(PAPER, *((0.25, 0.32, 0.5), (0.6, 0.22, 0.18), (0.3, 0.42, 0.3))[i])
        spine = _print("spines", ((2 * i + 1) / 8, 0, (2 * i + 2) / 8, 1))
        solids.append(box((0.24, -0.92, z), size, PAPER, rotation=turn(z=angle), texel=0.015,
                          faces={5: cover, 4: cover, 2: _tinted(PAPER, 0.95, 0.92, 0.84)}))  # fmt: skip
        solids.append(box(np.array([0.24, -0.92, z]) + turn(z=angle) @ [-size[0] / 2 - 0.002, 0, 0], (size[2], 0.004, size[1]), cover,
                          rotation=turn(z=angle) @ turn(z=-90) @ turn(y=90), faces={2: spine}, texel=0.015))  # fmt: skip
    # Bookcase.
    x0, x1, deep = 1.2, 2.2, 0.66
    solids += [
        block((x0, deep, 0), (x0 + 0.025, 0.99, 1.9), OAK, texel=0.04),
        block((x1 - 0.025, deep, 0), (x1, 0.99, 1.9), OAK, texel=0.04),
        block((x0, 0.97, 0), (x1, 0.99, 1.9), OAK, texel=0.04),
    ]
    rng = np.random.default_rng(7)
    for shelf in range(6):
        z = 0.06 + 0.36 * shelf
        solids.append(block((x0, deep, z), (x1, 0.99, z + 0.025), OAK, texel=0.04))
        x = x0 + 0.05
        while shelf < 5 and x < x1 - 0.12 - 0.25 * (shelf % 2):
            wide, tall = rng.uniform(0.035, 0.055), rng.uniform(0.22, 0.31)
            k = int(rng.integers(8))
            solids.append(block((x, deep + 0.03, z + 0.025), (x + wide, deep + 0.2, z + 0.025 + tall), PAPER, texel=0.04,
                                faces={2: _print("spines", (k / 8, 0, (k + 1) / 8, 1)), 0: _tinted(PAPER, 0.4, 0.36, 0.34), 1: _tinted(PAPER, 0.4, 0.36, 0.34)}))  # fmt: skip
            x += wide + 0.003
    solids += [
        sphere((2.02, 0.8, 0.06 + 0.36 + 0.025 + 0.09), 0.18, _peel(0.35, 0.55, 0.75), texel=0.02),
        cylinder(
            (2.03, 0.8, 0.06 + 1.08 + 0.025),
            0.2,
            0.08,
            0.12,
            _tinted(CHINA, 0.8, 0.5, 0.35),
            texel=0.02,
        ),
    ]
    # Lamp, plant, pictures, window.
    shade = Finish("fabric", 0.6, "weave", 0.06, tint=(1.08, 1.0, 0.78), shines=True)
    solids += [
        cylinder((-1.8, 0.55, 0), 0.03, 0.3, 0.26, IRON),
        rod((-1.8, 0.55, 0.03), (-1.8, 0.55, 1.45), 0.022, BRASS),
        cylinder((-1.8, 0.55, 1.42), 0.28, 0.42, 0.26, shade),
    ]
    leaf = Finish("leaves", 0.5, "grain", 0.2, tint=(1.25, 1.25, 1.2))
    solids.append(
        cylinder((-1.85, -0.35, 0), 0.3, 0.24, 0.34, _tinted(BRICK, 1.0, 0.9, 0.85), texel=0.02)
    )
    for i in range(10):
        angle, rise = 2.4 * i, 0.55 + 0.05 * i
        tip = np.array([-1.85 + 0.26 * np.cos(angle), -0.35 + 0.26 * np.sin(angle), rise + 0.1])
        solids.append(rod((-1.85, -0.35, 0.28), tip, 0.01, leaf))
        solids.append(
            sphere(
                tip,
                (0.34, 0.15, 0.012),
                leaf,
                rotation=turn(y=25 - 5 * (i % 3), z=np.rad2deg(angle)),
                texel=0.02,
            )
        )
    solids += _framed((-0.75, 1.0, 1.55), (0.5, 0.625), _print("dusk", gloss=0.05))
    solids += _framed((-0.02, 1.0, 1.55), (0.46, 0.644), _print("chart"), frame=OAK)
    solids += _framed((0.68, 1.0, 1.52), (0.56, 0.42), _print("map"), frame=OAK)
    lamps = [
        Lamp((0.9, -1.6, 2.35), 0.25, (2.7, 2.55, 2.3)),
        Lamp((-1.8, 0.45, 1.30), 0.12, (0.35, 0.28, 0.18)),
        Lamp((-1.9, -2.4, 1.7), 0.5, (1.0, 1.1, 1.3)),
    ]
    interests = (
        (-0.36, -0.88, 0.42, 0.16), (0.06, -0.72, 0.46, 0.08), (0.24, -0.92, 0.46, 0.12),
        (-0.02, 0.98, 1.55, 0.25), (0.68, 0.98, 1.52, 0.2), (-0.75, 0.98, 1.55, 0.25),
        (-1.0, 0.35, 0.68, 0.2), (0.48, 0.35, 0.68, 0.2), (1.6, 0.7, 1.0, 0.3),
        (0.2, 0.26, 0.52, 0.15), (-0.6, -1.4, 0.01, 0.3), (1.6, 0.7, 0.6, 0.3),
    )  # fmt: skip
    rig = Rig((-0.05, 0.0, 0.72), (2.3, 2.75), (-38, 38), (8, 34), interests)
    return Model(solids, lamps, (0.62, 0.62, 0.64), 0.6), rig


def _bench() -> tuple[Model, Rig]:
    grass = Finish("grass", 0.55, "grit", 0.4)
    gravel = Finish("gravel", 0.5, "grit", 0.2)
    leaves = Finish("leaves", 0.6, "grit", 0.5)
    sky = Finish("sky", None, shines=True, region=(0.0, 0.0, 4.0, 1.0))
    solids = [
        sheet((0, 0, 0), (17, 17), grass, texel=0.14),
        block((-8.0, -0.95, -0.02), (8.0, 0.75, 0.006), gravel, texel=0.05),
        sphere((0, 0, 0), 17.4, sky, texel=1.0),
        # A brick wall with a stone coping, and a hedge on each side of it.
        block((-2.4, 1.55, 0), (2.4, 1.8, 1.55), BRICK, texel=0.05),
        block((-2.45, 1.5, 1.55), (2.45, 1.85, 1.62), _tinted(PLASTER, 0.8, 0.8, 0.78), texel=0.06),
        block((-7.5, 1.5, 0), (-2.4, 2.3, 1.9), leaves, texel=0.12),
        block((2.4, 1.5, 0), (7.5, 2.3, 1.9), leaves, texel=0.12),
    ]
    rng = np.random.default_rng(3)
    for i in range(22):
        x = -2.3 + 4.6 * i / 21
        size = rng.uniform(0.25, 0.5, 3)
        solids.append(sphere((x, 1.5, 0.08), size, leaves, texel=0.06))
    # The bench: cast iron ends, slats for the seat and the back.
    for x in (-0.72, 0.0, 0.72):
        solids += [
            rod((x, -0.26, 0.0), (x, -0.22, 0.42), 0.045, IRON),
            rod((x, 0.30, 0.0), (x, 0.20, 0.42), 0.045, IRON),
            rod((x, -0.26, 0.40), (x, 0.22, 0.385), 0.04, IRON),
            rod((x, 0.20, 0.38), (x, 0.36, 0.90), 0.04, IRON),
            rod((x, -0.23, 0.12), (x, 0.27, 0.12), 0.025, IRON),
        ]
    for x in (-0.72, 0.72):
        solids += [
            rod((x, -0.26, 0.40), (x, -0.27, 0.63), 0.035, IRON),
            rod((x, -0.29, 0.63), (x, 0.29, 0.65), 0.05, IRON),
            sphere((x, -0.30, 0.63), 0.065, IRON),
        ]
    for k in range(6):
        y = -0.235 + 0.083 * k
        solids.append(box((0, y, 0.425 - 0.004 * k), (1.62, 0.068, 0.03), OAK, texel=0.02))
    back = turn(x=-17)
    for k in range(5):
        along = 0.10 + 0.098 * k
        centre = np.array([0.0, 0.195 + 0.308 * along, 0.40 + 0.95 * along])
        solids.append(box(centre, (1.62, 0.028, 0.075), OAK, rotation=back, texel=0.02))
        if k == 4:
            plaque = centre + back @ [0, -0.016, 0]
            solids.append(
                box(
                    plaque,
                    (0.15, 0.004, 0.066),
                    BRASS,
                    rotation=back,
                    texel=0.012,
                    faces={2: Finish("plaque", None, "scratches", 0.1, gloss=0.2)},
                )
            )
    # Left behind: a newspaper, a coffee, a bag and a ball.
    solids += [
        box(
            (-0.42, -0.02, 0.444),
            (0.3, 0.40, 0.008),
            PAPER,
            rotation=turn(z=24),
            faces={5: _print("newspaper")},
            texel=0.015,
        ),
        cylinder((-0.08, -0.10, 0.438), 0.12, 0.06, 0.085, PAPER, texel=0.012),
        cylinder(
            (-0.08, -0.10, 0.475), 0.05, 0.0705, 0.081, _tinted(WALNUT, 1.3, 1.1, 0.9), texel=0.012
        ),
        cylinder((-0.08, -0.10, 0.558), 0.012, 0.09, 0.084, BLACK),
        box((0.47, 0.04, 0.56), (0.34, 0.17, 0.25), CLOTH, rotation=turn(x=-8, z=-10), texel=0.02),
        rod((0.36, 0.04, 0.68), (0.40, 0.02, 0.77), 0.018, WALNUT),
        rod((0.55, 0.01, 0.68), (0.51, 0.0, 0.77), 0.018, WALNUT),
        rod((0.40, 0.02, 0.77), (0.51, 0.0, 0.77), 0.018, WALNUT),
        sphere(
            (0.95, -0.42, 0.115), 0.22, Finish("carpet", 0.4, "grit", 0.15, gloss=0.15), texel=0.02
        ),
    ]
    for i, (x, y) in enumerate(((0.18, -0.12), (0.2, 0.03), (0.28, -0.05))):
        solids.append(
            sphere(
                (x, y, 0.469),
                0.068,
                _peel(*((0.75, 0.12, 0.1), (0.55, 0.7, 0.2), (0.8, 0.3, 0.12))[i]),
                texel=0.01,
            )
        )
    # A litter bin of slats, a lamp post, a tree.
    for i in range(16):
        a = 2 * np.pi * i / 16
        p = np.array([-1.45 + 0.2 * np.cos(a), 0.35 + 0.2 * np.sin(a)])
        solids.append(
            box((*p, 0.38), (0.012, 0.055, 0.6), PINE, rotation=turn(z=np.rad2deg(a)), texel=0.03)
        )
    solids += [
        cylinder((-1.45, 0.35, 0.05), 0.6, 0.36, 0.36, IRON),
        cylinder((-1.45, 0.35, 0.67), 0.02, 0.43, 0.43, IRON),
        cylinder((1.55, 0.55, 0), 0.3, 0.16, 0.09, IRON),
        rod((1.55, 0.55, 0.3), (1.55, 0.55, 2.6), 0.06, IRON),
        cylinder((1.55, 0.55, 2.6), 0.3, 0.12, 0.26, _tinted(CHINA, 1.0, 0.98, 0.9)),
        cylinder((1.55, 0.55, 2.9), 0.12, 0.3, 0.04, IRON),
        cylinder((-2.1, 1.0, -0.05), 3.2, 0.36, 0.24, Finish("bark", 0.5, "grit", 0.3), texel=0.04),
        sphere((-2.2, 1.1, 3.3), (2.4, 2.0, 1.6), leaves, texel=0.1),
        sphere((-1.5, 1.3, 2.9), (1.5, 1.3, 1.0), leaves, texel=0.1),
        sphere((2.9, 2.6, 2.4), (2.2, 1.8, 1.6), leaves, texel=0.1),
    ]
    sun = np.array([-4.0, -5.0, 7.0]) * 5
    lamps = [Lamp(tuple(sun), 1.6, tuple(np.array([1.45, 1.35, 1.15]) * (sun @ sun)))]
    interests = (
        (0.0, 0.35, 0.85, 0.10), (-0.42, -0.02, 0.45, 0.18), (-0.08, -0.1, 0.5, 0.09),
        (0.47, -0.03, 0.58, 0.16), (0.22, -0.05, 0.47, 0.08), (0.95, -0.45, 0.12, 0.12),
        (-0.72, -0.28, 0.55, 0.12), (0.6, 0.3, 0.75, 0.15), (-0.5, 0.3, 0.8, 0.15),
        (-1.45, 0.2, 0.5, 0.2), (0.3, 1.5, 1.1, 0.3), (0.72, -0.2, 0.5, 0.2),
    )  # fmt: skip
    rig = Rig((0.0, 0.05, 0.52), (1.9, 2.35), (-58, 58), (6, 38), interests)
    return Model(solids, lamps, (0.62, 0.68, 0.78), 0.8), rig


def _stairs() -> tuple[Model, Rig]:
    wallpaper = Finish("wallpaper", 0.8, "paper", 0.2)
    solids = _interior(
        (-2.3, -3.2, 0),
        (0.62, 2.9, 3.4),
        Finish("floor_tiles", 1.2, "grit", 0.4, gloss=0.1),
        PLASTER,
    )
    solids[5] = sheet((0.62, -0.15, 1.7), (6.1, 3.4), wallpaper, facing="-x", texel=0.05)
    runner = Finish("carpet", 0.42, "pile", 0.15)
    rise, run, steps = 0.185, 0.27, 10
    for i in range(steps):
        z, y = rise * (i + 1), run * i
        solids += [
            block((-0.48, y, 0), (0.60, y + run, z - 0.03), WHITE, texel=0.035),
            block((-0.52, y - 0.03, z - 0.03), (0.60, y + run, z), OAK, texel=0.02),
            block((-0.22, y - 0.032, z - 0.001), (0.36, y + run, z + 0.006), runner, texel=0.02),
            block((-0.22, y - 0.006, z - rise), (0.36, y, z - 0.03), runner, texel=0.02),
            rod(
                (-0.24, y - 0.012, z - rise + 0.012),
                (0.38, y - 0.012, z - rise + 0.012),
                0.012,
                BRASS,
            ),
        ]
        for k in (0.25, 0.75):
            at = (-0.46, y + run * k - 0.03)
            tall = 0.86 + rise * k
            solids.append(rod((*at, z), (*at, z + tall), 0.022, WHITE, texel=0.04))
            solids.append(cylinder((*at, z), 0.10, 0.042, 0.03, WHITE, texel=0.03))
    slope = np.array([0.0, run * (steps - 1), rise * (steps - 1)])
    foot = np.array([-0.46, -0.03, rise + 0.86])
    solids += [
        rod(foot + (0, -0.1, -0.07), foot + slope + (0, run, rise), 0.06, WALNUT),
        block((-0.52, -0.15, 0), (-0.40, -0.03, 1.12), WHITE, texel=0.03),
        block((-0.535, -0.165, 1.12), (-0.385, -0.015, 1.15), WALNUT),
        sphere((-0.46, -0.09, 1.21), 0.13, WALNUT, texel=0.015),
        block((0.602, -3.2, 0), (0.62, -0.0, 0.12), WHITE, texel=0.06),
        block((-2.3, 2.88, 0), (-0.5, 2.9, 0.12), WHITE, texel=0.06),
    ]
    for i, name in enumerate(("dusk", "map", "grey", "day")):
        size = (0.44, 0.55) if name != "map" else (0.6, 0.45)
        y, z = -0.45 + 0.75 * i, 1.45 + 0.42 * i
        solids += _framed((0.62, y, z), size, _print(name, gloss=0.05), facing="-x")
    # Things on the way: a doormat, shoes, books, a plant, an umbrella stand, a chest.
    solids += [
        block(
            (-0.25, -0.72, 0.0),
            (0.45, -0.3, 0.018),
            Finish("white", 0.3, "pile", 0.12, tint=(0.6, 0.45, 0.28)),
            faces={5: Finish("doormat", None, "pile", 0.13)},
            texel=0.02,
        ),
        sphere(
            (0.47, 0.13, rise + 0.035),
            (0.09, 0.25, 0.085),
            _tinted(BLACK, 0.45, 0.26, 0.16),
            texel=0.012,
        ),
        sphere(
            (0.47, 0.20, rise + 0.06),
            (0.085, 0.12, 0.12),
            _tinted(BLACK, 0.45, 0.26, 0.16),
            texel=0.012,
        ),
        cylinder(
            (-0.34, 0.13, rise), 0.14, 0.11, 0.16, _tinted(BRICK, 1.0, 0.9, 0.85), texel=0.012
        ),
    ]
    leaf = Finish("leaves", 0.3, "grain", 0.2, tint=(1.25, 1.3, 1.2))
    for i in range(9):
        angle = 2.4 * i
        tip = np.array(
            [-0.34 + 0.08 * np.cos(angle), 0.13 + 0.08 * np.sin(angle), rise + 0.2 + 0.018 * i]
        )
        solids.append(
            sphere(
                tip,
                (0.15, 0.06, 0.012),
                leaf,
                rotation=turn(y=20, z=np.rad2deg(angle)),
                texel=0.015,
            )
        )
    for i, (size, angle) in enumerate(
        (((0.22, 0.16, 0.036), 6), ((0.2, 0.15, 0.03), -8), ((0.18, 0.13, 0.032), 14))
    ):
        z = rise * 3 + 0.006 + 0.018 + 0.034 * i
        cover = _tinted(PAPER, *((0.25, 0.32, 0.5), (0.6, 0.22, 0.18), (0.3, 0.42, 0.3))[i])
        solids.append(box((0.44, 2 * run + 0.12, z), size, cover, rotation=turn(z=angle), texel=0.012,
                          faces={1: _tinted(PAPER, 0.95, 0.92, 0.84)}))  # fmt: skip
    lamps = [
        Lamp((-1.3, -1.6, 3.0), 0.25, (3.6, 3.4, 3.0)),
        Lamp((-1.6, 1.2, 3.1), 0.4, (1.3, 1.4, 1.6)),
    ]
    interests = (
        (0.1, -0.5, 0.02, 0.15), (0.62, -0.45, 1.45, 0.25), (0.62, 0.3, 1.87, 0.25),
        (0.47, 0.12, 0.24, 0.12), (-0.34, 0.10, 0.32, 0.14), (0.44, 0.66, 0.6, 0.12),
        (-0.46, -0.1, 1.2, 0.12), (0.05, 0.27, 0.3, 0.15), (-0.46, 0.25, 0.8, 0.2),
        (0.05, 0.8, 0.7, 0.2), (0.62, 0.2, 1.0, 0.3), (-0.1, 0.0, 0.15, 0.15),
    )  # fmt: skip
    rig = Rig((0.05, 0.45, 0.80), (2.2, 2.6), (-48, 6), (4, 32), interests)
    return Model(solids, lamps, (0.60, 0.60, 0.62), 0.6), rig


SCENES: dict[str, Callable[[], tuple[Model, Rig]]] = {
    "counter": _counter,
    "table": _table,
    "room": _room,
    "bench": _bench,
    "stairs": _stairs,
}
