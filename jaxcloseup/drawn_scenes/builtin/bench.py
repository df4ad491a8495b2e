"""A park bench with belongings on it, in front of a brick wall and hedges, in the sun."""

import numpy as np

from jaxcloseup.drawn_scenes.builtin.furnishings import (
    BLACK,
    BRASS,
    CHINA,
    CLOTH,
    IRON,
    OAK,
    PAPER,
    PINE,
    PLASTER,
    WALNUT,
    peel,
    print_of,
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
    sheet,
    sphere,
    turn,
)


GRASS = Finish("grass", 0.55, "grit", 0.4)
GRAVEL = Finish("gravel", 0.5, "grit", 0.2)
HEDGE = Finish("leaves", 0.6, "grit", 0.5)
BRICK = Finish("brick", 0.9, "grit", 0.25)
BARK = Finish("bark", 0.5, "grit", 0.3)
STONE = tinted(PLASTER, 0.8, 0.8, 0.78)
SKY = Finish("sky", None, shines=True, region=(0.0, 0.0, 4.0, 1.0))
PLAQUE = Finish("plaque", None, "scratches", 0.1, gloss=0.2)
BALL = Finish("carpet", 0.4, "grit", 0.15, gloss=0.15)


def bench() -> Model:
    """Build the model of the scene and its camera rig."""
    solids = [
        *_garden(),
        *_bench(),
        *_left_behind(),
        *_litter_bin(-1.45, 0.35),
        *_lamp_post(1.55, 0.55),
        *_pigeon((-0.5, -0.72, 0.006), 35),
        *_pigeon((0.3, -0.68, 0.006), -60),
    ]
    sun = np.array([-20.0, -25.0, 35.0])
    power = np.array([1.35, 1.25, 1.05]) * (sun @ sun)
    interests = (
        (0.0, 0.35, 0.85, 0.10), (-0.42, -0.02, 0.45, 0.18), (-0.08, -0.1, 0.5, 0.09),
        (0.47, -0.03, 0.58, 0.16), (0.22, -0.05, 0.47, 0.08), (0.95, -0.45, 0.12, 0.12),
        (-0.72, -0.28, 0.55, 0.12), (0.6, 0.3, 0.75, 0.15), (-0.5, -0.72, 0.1, 0.12),
        (-1.45, 0.2, 0.5, 0.2), (0.3, -0.68, 0.1, 0.12), (0.72, -0.2, 0.5, 0.2),
    )  # fmt: skip
    rig = Rig((0.0, 0.05, 0.5), (1.9, 2.35), (-58, 58), (6, 38), interests)
    lamps = [Lamp(tuple(sun), 1.6, tuple(power))]
    return Model(solids, lamps, Ambience((0.58, 0.64, 0.74), 0.8), rig)


def _garden() -> list[Solid]:
    """Model lawn, path, wall, hedges, trees and an enclosing sky."""
    solids = [
        sheet((0, 0, 0), (17, 17), GRASS, texel=0.22),
        block((-8.0, -0.95, -0.02), (8.0, 0.75, 0.006), GRAVEL, texel=0.08),
        sphere((0, 0, 0), 17.4, SKY, texel=1.0),
        block((-2.4, 1.55, 0), (2.4, 1.8, 1.55), BRICK, texel=0.06),
        block((-2.45, 1.5, 1.55), (2.45, 1.85, 1.62), STONE, texel=0.08),
        block((-7.5, 1.5, 0), (-2.4, 2.3, 1.9), HEDGE, texel=0.2),
        block((2.4, 1.5, 0), (7.5, 2.3, 1.9), HEDGE, texel=0.2),
        cylinder((-2.1, 1.0, -0.05), 3.2, 0.36, 0.24, BARK, texel=0.06),
        sphere((-2.2, 1.1, 3.3), (2.4, 2.0, 1.6), HEDGE, texel=0.15),
        sphere((-1.5, 1.3, 2.9), (1.5, 1.3, 1.0), HEDGE, texel=0.15),
        sphere((2.9, 2.6, 2.4), (2.2, 1.8, 1.6), HEDGE, texel=0.15),
    ]
    rng = np.random.default_rng(3)
    for x in np.linspace(-2.3, 2.3, 22):
        solids.append(sphere((x, 1.5, 0.08), rng.uniform(0.25, 0.5, 3), HEDGE, texel=0.08))
    return solids


def _bench() -> list[Solid]:
    """Model slats on three cast-iron frames, with a plaque on the back."""
    solids = []
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
        center = (0, -0.235 + 0.083 * k, 0.425 - 0.004 * k)
        solids.append(box(center, (1.62, 0.068, 0.03), OAK, texel=0.025))
    lean = turn(x=-17)
    for along in 0.10 + 0.098 * np.arange(5):
        slat = np.array([0.0, 0.195 + 0.308 * along, 0.40 + 0.95 * along])
        solids.append(box(slat, (1.62, 0.028, 0.075), OAK, rotation=lean, texel=0.025))
    plaque = slat + lean @ [0, -0.016, 0]
    solids.append(box(plaque, (0.15, 0.004, 0.066), BRASS, rotation=lean, faces={2: PLAQUE}))
    return solids


def _left_behind() -> list[Solid]:
    """Model a newspaper, a cup of coffee, a bag, three apples and a ball."""
    seat = 0.438
    bag = turn(x=-8, z=-10)
    red, green = (0.75, 0.12, 0.1), (0.55, 0.7, 0.2)
    apples = ((0.18, -0.12, red), (0.2, 0.03, green), (0.28, -0.05, red))
    return [
        box(
            (-0.42, -0.02, 0.444), (0.3, 0.40, 0.008), PAPER,
            rotation=turn(z=24), faces={5: print_of("newspaper")}, texel=0.02,
        ),
        cylinder((-0.08, -0.10, seat), 0.12, 0.06, 0.085, PAPER, texel=0.015),
        cylinder((-0.08, -0.10, 0.475), 0.05, 0.0705, 0.081, tinted(WALNUT, 1.3, 1.1, 0.9)),
        cylinder((-0.08, -0.10, 0.558), 0.012, 0.09, 0.084, BLACK),
        box((0.47, 0.04, 0.56), (0.34, 0.17, 0.25), CLOTH, rotation=bag, texel=0.025),
        rod((0.36, 0.04, 0.68), (0.40, 0.02, 0.77), 0.018, WALNUT),
        rod((0.55, 0.01, 0.68), (0.51, 0.0, 0.77), 0.018, WALNUT),
        rod((0.40, 0.02, 0.77), (0.51, 0.0, 0.77), 0.018, WALNUT),
        *(sphere((x, y, 0.469), 0.068, peel(*tint), texel=0.012) for x, y, tint in apples),
        sphere((0.95, -0.42, 0.115), 0.22, BALL, texel=0.025),
    ]  # fmt: skip


def _litter_bin(x: float, y: float) -> list[Solid]:
    solids = [
        cylinder((x, y, 0.05), 0.6, 0.36, 0.36, IRON),
        cylinder((x, y, 0.67), 0.02, 0.43, 0.43, IRON),
    ]
    for angle in np.arange(0, 360, 22.5):
        turned = turn(z=angle)
        center = turned @ [0.2, 0, 0] + (x, y, 0.38)
        solids.append(box(center, (0.012, 0.055, 0.6), PINE, rotation=turned, texel=0.04))
    return solids


def _lamp_post(x: float, y: float) -> list[Solid]:
    return [
        cylinder((x, y, 0), 0.3, 0.16, 0.09, IRON),
        rod((x, y, 0.3), (x, y, 2.6), 0.06, IRON, texel=0.06),
        cylinder((x, y, 2.6), 0.3, 0.12, 0.26, tinted(CHINA, 1.0, 0.98, 0.9)),
        cylinder((x, y, 2.9), 0.12, 0.3, 0.04, IRON),
    ]


def _pigeon(base: tuple, facing: float) -> list[Solid]:
    """Model a pigeon that faces -y, rotated by `facing` degrees about z."""
    rotation = turn(z=facing)
    gray, dark = peel(0.50, 0.53, 0.60), peel(0.26, 0.28, 0.34)
    neck, pink = peel(0.28, 0.46, 0.42), peel(0.80, 0.42, 0.36)

    def at(*p: float) -> np.ndarray:
        return rotation @ np.array(p) + base

    solids = [
        sphere(at(0, 0, 0.12), (0.11, 0.21, 0.115), gray, rotation=rotation @ turn(x=-18)),
        box(at(0, 0.13, 0.085), (0.06, 0.11, 0.012), dark, rotation=rotation @ turn(x=-14)),
        rod(at(0, -0.07, 0.14), at(0, -0.1, 0.21), 0.055, neck),
        sphere(at(0, -0.105, 0.22), (0.055, 0.065, 0.055), gray, rotation=rotation),
        cylinder(at(0, -0.13, 0.22), 0.03, 0.016, 0.004, dark, rotation=rotation @ turn(x=105)),
    ]
    for side in (-1, 1):
        wing = rotation @ turn(x=-14)
        solids += [
            sphere(at(side * 0.045, 0.03, 0.125), (0.04, 0.19, 0.085), dark, rotation=wing),
            sphere(at(side * 0.025, -0.115, 0.228), 0.012, peel(0.9, 0.45, 0.1)),
            rod(at(side * 0.025, 0.0, 0.0), at(side * 0.02, 0.0, 0.08), 0.009, pink),
        ]
    return solids
