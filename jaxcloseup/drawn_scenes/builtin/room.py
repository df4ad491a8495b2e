"""A living room: sofa, rug, low table with a newspaper, bookcase, lamp, plant and pictures."""

import itertools

import numpy as np

from jaxcloseup.drawn_scenes.builtin.furnishings import (
    BRASS,
    CHINA,
    CLOTH,
    IRON,
    OAK,
    PAPER,
    PLANKS,
    PLASTER,
    WALNUT,
    WHITE,
    book,
    framed,
    interior,
    peel,
    pot_plant,
    print_of,
    standing_book,
    tinted,
)
from jaxcloseup.drawn_scenes.lighting import Ambience, Lamp
from jaxcloseup.drawn_scenes.modeling import (
    Finish,
    Model,
    Rig,
    Solid,
    block,
    box,
    cylinder,
    rod,
    sphere,
    turn,
)


SOFA = Finish("upholstery", 0.35, "weave", 0.08)
RUG = Finish("carpet", None, "pile", 0.17)
KILIM = Finish("carpet", 0.35, "weave", 0.06)
THROW = Finish("fabric", 0.2, "weave", 0.05, tint=(1.0, 0.85, 0.6))
SHADE = Finish("fabric", 0.6, "weave", 0.06, tint=(1.08, 1.0, 0.78), shines=True)
MUG = Finish("white", 0.3, tint=(0.86, 0.36, 0.24), gloss=0.3)
COFFEE = tinted(MUG, 0.16, 0.09, 0.05)


def room() -> Model:
    """Build the model of the scene and its camera rig."""
    solids = [
        *interior((-2.4, -3.6, 0), (2.4, 1.0, 2.6), PLANKS, PLASTER),
        block((-2.4, 0.98, 0.0), (2.4, 1.0, 0.11), WHITE, texel=0.1),
        block((-1.45, -1.75, 0.0), (1.25, -0.15, 0.012), CLOTH, faces={5: RUG}, texel=0.04),
        *_sofa(),
        *_low_table(-0.15, -0.95, 0.4),
        *_bookcase(1.2, 2.2),
        *_lamp(-1.8, 0.55),
        *pot_plant((-1.85, -0.35, 0.0), 0.34, 10),
        *framed((-0.75, 1.0, 1.55), (0.5, 0.625), "dusk"),
        *framed((-0.02, 1.0, 1.55), (0.46, 0.644), "chart", frame=OAK),
        *framed((0.68, 1.0, 1.52), (0.56, 0.42), "map", frame=OAK),
    ]
    lamps = [
        Lamp((0.9, -1.6, 2.35), 0.22, (2.6, 2.4, 2.15)),
        Lamp((-1.8, 0.45, 1.30), 0.12, (0.35, 0.28, 0.18)),
        Lamp((-1.9, -2.4, 1.7), 0.5, (0.7, 0.78, 0.9)),
    ]
    interests = (
        (-0.41, -0.98, 0.42, 0.16), (0.01, -0.82, 0.46, 0.08), (0.19, -1.02, 0.46, 0.12),
        (-0.02, 0.98, 1.55, 0.25), (0.68, 0.98, 1.52, 0.2), (-0.75, 0.98, 1.55, 0.25),
        (-1.0, 0.35, 0.68, 0.2), (0.48, 0.35, 0.68, 0.2), (1.6, 0.7, 1.0, 0.3),
        (0.2, 0.26, 0.52, 0.15), (-0.9, -1.0, 0.01, 0.3), (1.6, 0.7, 0.6, 0.3),
    )  # fmt: skip
    rig = Rig((-0.1, -0.25, 0.62), (2.3, 2.75), (-38, 38), (10, 36), interests)
    return Model(solids, lamps, Ambience((0.54, 0.54, 0.56), 0.6), rig)


def _sofa() -> list[Solid]:
    solids = [
        block((-1.25, 0.0, 0.12), (0.75, 0.9, 0.36), SOFA, texel=0.06),
        block((-1.25, 0.68, 0.3), (0.75, 0.92, 0.88), SOFA, texel=0.06),
        block((-1.45, 0.0, 0.12), (-1.25, 0.92, 0.62), SOFA, texel=0.05),
        block((0.75, 0.0, 0.12), (0.95, 0.92, 0.62), SOFA, texel=0.05),
        *(cylinder((x, 0.08, 0), 0.12, 0.04, 0.06, WALNUT) for x in (-1.35, 0.85)),
    ]
    for x in (-0.92, -0.25, 0.42):
        back = turn(x=-10)
        solids.append(box((x, 0.33, 0.43), (0.64, 0.68, 0.15), SOFA, texel=0.04))
        solids.append(box((x, 0.62, 0.68), (0.63, 0.16, 0.40), SOFA, rotation=back, texel=0.04))
    for center, finish, lean in (
        ((-1.0, 0.45, 0.68), CLOTH, turn(x=-20, y=8, z=14)),
        ((0.48, 0.45, 0.68), KILIM, turn(x=-20, y=-6, z=-16)),
    ):
        # A pillow: a padded middle on a flat square.
        solids.append(sphere(center, (0.46, 0.19, 0.46), finish, rotation=lean))
        solids.append(box(center, (0.42, 0.05, 0.42), finish, rotation=lean))
    solids.append(
        box((0.2, 0.22, 0.513), (0.5, 0.36, 0.02), THROW, rotation=turn(z=12), texel=0.025)
    )
    return solids


def _low_table(x: float, y: float, top: float) -> list[Solid]:
    """Model a newspaper, a mug and some books on a low table."""
    above = top + 0.0175
    solids = [
        box((x, y, top), (1.1, 0.55, 0.035), WALNUT, texel=0.025),
        box((x, y, 0.16), (0.98, 0.44, 0.02), WALNUT, texel=0.05),
        box(
            (x - 0.26, y - 0.03, above + 0.004), (0.3, 0.42, 0.008), PAPER,
            rotation=turn(z=16), faces={5: print_of("newspaper")}, texel=0.02,
        ),
        cylinder(
            (x + 0.16, y + 0.13, above), 0.095, 0.075, 0.085, MUG, faces={2: COFFEE}, texel=0.015
        ),
    ]  # fmt: skip
    for dx in (-0.48, 0.48):
        for dy in (-0.22, 0.22):
            solids.append(rod((x + dx, y + dy, 0), (x + dx, y + dy, top), 0.035, IRON))
    handle = [(0.2, 0.075), (0.23, 0.07), (0.23, 0.025), (0.195, 0.02)]
    for (ax, az), (bx, bz) in itertools.pairwise(handle):
        a, b = (x + ax, y + 0.13, above + az), (x + bx, y + 0.13, above + bz)
        solids.append(rod(a, b, 0.012, MUG))
    sizes, angles = ((0.26, 0.19, 0.035), (0.24, 0.17, 0.03), (0.2, 0.14, 0.028)), (8, -6, 20)
    for i, (size, angle) in enumerate(zip(sizes, angles, strict=True)):
        solids += book((x + 0.34, y - 0.07, above + 0.0175 + 0.033 * i), size, i, angle)
    return solids


def _bookcase(left: float, right: float) -> list[Solid]:
    front, back, rng = 0.66, 0.99, np.random.default_rng(7)
    solids = [
        block((left, front, 0), (left + 0.025, back, 1.9), OAK, texel=0.06),
        block((right - 0.025, front, 0), (right, back, 1.9), OAK, texel=0.06),
        block((left, 0.97, 0), (right, back, 1.9), OAK, texel=0.06),
        sphere((2.02, 0.8, 0.535), 0.18, peel(0.35, 0.55, 0.75)),
        cylinder((2.03, 0.8, 1.165), 0.2, 0.08, 0.12, tinted(CHINA, 0.8, 0.5, 0.35)),
    ]
    for shelf in range(6):
        z = 0.06 + 0.36 * shelf
        solids.append(block((left, front, z), (right, back, z + 0.025), OAK, texel=0.05))
        x = left + 0.05
        while shelf < 5 and x < right - 0.12 - 0.25 * (shelf % 2):
            wide, tall = rng.uniform(0.035, 0.055), rng.uniform(0.22, 0.31)
            corner = (x, front + 0.03, z + 0.025)
            solids.append(standing_book(corner, (wide, 0.17, tall), int(rng.integers(8))))
            x += wide + 0.003
    return solids


def _lamp(x: float, y: float) -> list[Solid]:
    return [
        cylinder((x, y, 0), 0.03, 0.3, 0.26, IRON),
        rod((x, y, 0.03), (x, y, 1.45), 0.022, BRASS),
        cylinder((x, y, 1.42), 0.28, 0.42, 0.26, SHADE),
    ]
