"""A kitchen counter: breakfast, bread on a board, fruit, a hob, and a shelf on a tiled wall."""

import numpy as np

from jaxcloseup.drawn_scenes.builtin.furnishings import (
    BLACK,
    CHINA,
    CLOTH,
    CRUST,
    FLOOR_TILES,
    IRON,
    OAK,
    PAPER,
    PINE,
    PLASTER,
    STEEL,
    WALNUT,
    interior,
    label,
    peel,
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
    sheet,
    sphere,
    turn,
)


TILES = Finish("tiles", 0.6, gloss=0.2)
GRANITE = Finish("granite", 0.35, "grit", 0.3, gloss=0.3)
RED_ENAMEL = tinted(STEEL, 1.1, 0.35, 0.3)
TOP = 0.9  # height of the worktop in meters


def counter() -> Model:
    """Build the model of the scene and its camera rig."""
    solids = [
        *interior((-2.2, -3.6, 0), (2.2, 0.0, 2.6), FLOOR_TILES, PLASTER, back=TILES),
        *_cupboards(),
        *_shelf(),
        *_rail_of_tools(),
        *_breakfast(),
        *_baking(),
        *_fruit(),
        *_hob(),
        cylinder(
            (0.36, -0.002, 1.75), 0.04, 0.3, 0.3, WALNUT,
            rotation=turn(x=90), faces={2: print_of("clock")}, texel=0.02,
        ),
    ]  # fmt: skip
    lamps = [
        Lamp((0.9, -1.7, 2.4), 0.2, (2.3, 2.15, 1.9)),
        Lamp((-1.6, -2.2, 2.2), 0.35, (0.6, 0.68, 0.78)),
    ]
    interests = (
        (-0.92, -0.33, 1.05, 0.16), (-0.62, -0.25, 0.98, 0.12), (-0.24, -0.36, 0.97, 0.14),
        (0.27, -0.17, 1.05, 0.15), (0.57, -0.41, 1.0, 0.12), (-0.75, -0.17, 1.48, 0.14),
        (0.36, -0.04, 1.75, 0.14), (0.2, -0.06, 1.2, 0.15), (0.95, -0.3, 1.0, 0.16),
        (-1.1, -0.12, 1.42, 0.12), (0.0, -0.01, 1.15, 0.3), (-0.3, -0.63, 0.7, 0.2),
    )  # fmt: skip
    rig = Rig((-0.05, -0.3, 1.06), (1.75, 2.15), (-42, 42), (2, 34), interests)
    return Model(solids, lamps, Ambience((0.52, 0.53, 0.56), 0.5), rig)


def _cupboards() -> list[Solid]:
    solids = [
        block((-1.8, -0.58, 0.1), (1.8, -0.01, 0.86), tinted(PINE, 0.6, 0.6, 0.6), texel=0.1),
        block((-1.8, -0.54, 0.0), (1.8, -0.01, 0.1), BLACK, texel=0.1),
        block((-1.85, -0.63, 0.86), (1.85, -0.005, TOP), GRANITE, texel=0.03),
        block((0.75, -0.34, 1.5), (1.85, -0.005, 2.15), OAK, texel=0.06),
        sheet((-0.3, -0.634, 0.62), (0.24, 0.34), CLOTH, facing="-y"),
    ]
    for x in np.arange(-1.5, 1.6, 0.6):
        solids += [
            box((x, -0.59, 0.38), (0.585, 0.02, 0.54), OAK, texel=0.06),
            box((x, -0.59, 0.755), (0.585, 0.02, 0.175), OAK),
            rod((x - 0.09, -0.625, 0.755), (x + 0.09, -0.625, 0.755), 0.012, STEEL),
            rod((x - 0.08, -0.6, 0.755), (x - 0.08, -0.625, 0.755), 0.01, STEEL),
            rod((x + 0.08, -0.6, 0.755), (x + 0.08, -0.625, 0.755), 0.01, STEEL),
        ]
    return solids


def _shelf() -> list[Solid]:
    """Model jars and cookery books."""
    solids = [block((-1.35, -0.17, 1.36), (-0.1, -0.005, 1.385), PINE)]
    contents = ((0.7, 0.5, 0.1), (0.5, 0.1, 0.1), (0.3, 0.4, 0.2), (0.4, 0.25, 0.1))
    for i, (which, tint) in enumerate(zip((3, 0, 1, 3), contents, strict=True)):
        x, y, z = -1.25 + 0.09 * i, -0.09, 1.385
        solids += [
            cylinder((x, y, z), 0.085, 0.056, 0.056, tinted(CHINA, *tint)),
            cylinder((x, y, z + 0.015), 0.05, 0.0575, 0.0575, label(which)),
            cylinder((x, y, z + 0.085), 0.018, 0.05, 0.05, tinted(STEEL, 0.9, 0.3, 0.25)),
        ]
    for i in range(7):
        tall = 0.2 + 0.02 * (3 * i % 4)
        solids.append(standing_book((-0.84 + 0.034 * i, -0.165, 1.385), (0.031, 0.15, tall), i))
    return solids


def _rail_of_tools() -> list[Solid]:
    """Model ladle, turners, whisk and spoon, hanging from a rail."""
    solids = [rod((-0.05, -0.05, 1.42), (0.68, -0.05, 1.42), 0.014, STEEL)]
    for i, x in enumerate((0.04, 0.18, 0.32, 0.46, 0.6)):
        solids.append(rod((x, -0.065, 1.43), (x, -0.065, 1.2), 0.009, (STEEL, PINE)[i % 2]))
    for k in range(5):
        tip = (0.32 + 0.016 * (k - 2), -0.065, 1.1)
        solids.append(rod((0.32, -0.065, 1.2), tip, 0.004, STEEL))
    return [
        *solids,
        sphere((0.04, -0.075, 1.17), (0.085, 0.05, 0.075), STEEL),
        box((0.18, -0.065, 1.155), (0.06, 0.008, 0.1), PINE),
        box((0.46, -0.065, 1.155), (0.055, 0.008, 0.1), PINE),
        sphere((0.6, -0.07, 1.16), (0.06, 0.03, 0.09), STEEL),
    ]


def _breakfast() -> list[Solid]:
    """Model a box of cereal and four tins."""
    front = print_of("cereal", gloss=0.06)
    solids = [
        box(
            (-0.92, -0.3, TOP + 0.145), (0.2, 0.07, 0.29), tinted(PAPER, 0.95, 0.66, 0.18),
            rotation=turn(z=18), faces={2: front, 3: front},
        )
    ]  # fmt: skip
    for x, y, level, which in (
        (-0.66, -0.2, 0, 0), (-0.57, -0.2, 0, 1), (-0.615, -0.2, 1, 0), (-0.66, -0.33, 0, 1)
    ):  # fmt: skip
        solids.append(
            cylinder(
                (x, y, TOP + 0.11 * level), 0.11, 0.078, 0.078, label(which),
                rotation=turn(z=-80 + 30 * x), faces={1: STEEL, 2: STEEL}, texel=0.02,
            )
        )  # fmt: skip
    return solids


def _baking() -> list[Solid]:
    """Model a loaf and a knife on a board, and a cookery book on its stand."""
    lean, book = turn(x=-22, z=-6), np.array([0.27, -0.16, TOP + 0.14])
    return [
        box((-0.18, -0.36, 0.911), (0.44, 0.28, 0.022), PINE, rotation=turn(z=-8), texel=0.015),
        sphere(
            (-0.24, -0.33, 0.972), (0.27, 0.13, 0.115), CRUST, rotation=turn(z=-14), texel=0.015
        ),
        box((-0.08, -0.44, 0.9245), (0.2, 0.03, 0.003), STEEL, rotation=turn(z=22), texel=0.02),
        box((0.065, -0.38, 0.93), (0.12, 0.026, 0.018), WALNUT, rotation=turn(z=22)),
        box(book, (0.25, 0.02, 0.30), tinted(PAPER, 0.6, 0.15, 0.12), rotation=lean),
        sheet(
            book + lean @ [0, -0.0115, 0.0], (0.235, 0.29), print_of("recipe"),
            facing="-y", rotation=lean, texel=0.02,
        ),
        box((0.27, -0.25, 0.915), (0.27, 0.1, 0.03), PINE, rotation=turn(z=-6)),
    ]  # fmt: skip


def _fruit() -> list[Solid]:
    inside = {2: tinted(CHINA, 0.7, 0.72, 0.75)}
    fruit = (
        (0.53, -0.44, 1.0, 0.085, (0.98, 0.52, 0.10)), (0.62, -0.45, 1.0, 0.08, (0.98, 0.55, 0.12)),
        (0.60, -0.36, 1.0, 0.085, (0.72, 0.10, 0.10)), (0.51, -0.36, 1.0, 0.075, (0.5, 0.68, 0.16)),
        (0.57, -0.41, 1.055, 0.08, (0.98, 0.50, 0.08)),
    )  # fmt: skip
    return [
        cylinder((0.58, -0.4, TOP), 0.075, 0.12, 0.27, CHINA, texel=0.015, faces=inside),
        *(sphere((x, y, z), size, peel(*tint), texel=0.012) for x, y, z, size, tint in fruit),
        sphere(
            (0.66, -0.39, 1.02), (0.09, 0.06, 0.06), peel(0.98, 0.86, 0.22),
            rotation=turn(z=30, y=20), texel=0.012,
        ),
    ]  # fmt: skip


def _hob() -> list[Solid]:
    """Model a pot and a kettle on a glass hob."""
    near, far = np.array([1.28, -0.43, 0.916]), np.array([0.96, -0.2, 0.916])

    def kettle(x: float, y: float, z: float) -> np.ndarray:
        return near + np.array([x, y, z])

    def pot(x: float, y: float, z: float) -> np.ndarray:
        return far + np.array([x, y, z])

    plates = [(x, y, TOP + 0.012) for x in (far[0], near[0]) for y in (far[1], near[1])]
    return [
        block((0.8, -0.55, TOP), (1.44, -0.08, TOP + 0.012), BLACK),
        *(cylinder(plate, 0.004, 0.17, 0.17, tinted(IRON, 1.6, 1.4, 1.4)) for plate in plates),
        cylinder(far, 0.15, 0.21, 0.22, STEEL, texel=0.02),
        cylinder(pot(0, 0, 0.15), 0.02, 0.225, 0.18, STEEL, texel=0.02),
        sphere(pot(0, 0, 0.185), 0.035, BLACK),
        rod(pot(-0.16, 0, 0.115), pot(-0.1, 0, 0.115), 0.02, BLACK),
        rod(pot(0.1, 0, 0.115), pot(0.16, 0, 0.115), 0.02, BLACK),
        cylinder(near, 0.15, 0.19, 0.12, RED_ENAMEL, texel=0.02),
        sphere(kettle(0, 0, 0.16), 0.035, BLACK),
        rod(kettle(-0.07, -0.02, 0.06), kettle(-0.14, -0.05, 0.14), 0.024, RED_ENAMEL),
        rod(kettle(-0.06, 0, 0.14), kettle(-0.06, 0, 0.24), 0.014, BLACK),
        rod(kettle(0.06, 0, 0.14), kettle(0.06, 0, 0.24), 0.014, BLACK),
        rod(kettle(-0.065, 0, 0.24), kettle(0.065, 0, 0.24), 0.02, WALNUT),
    ]
