"""A table set for four, with flowers, wine, bread and a menu."""

import numpy as np

from jaxcloseup.drawn_scenes.builtin.furnishings import (
    BRASS,
    CHINA,
    CLOTH,
    CRUST,
    LEAF,
    OAK,
    PLANKS,
    STEEL,
    WALLPAPER,
    WALNUT,
    WHITE,
    framed,
    interior,
    label,
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


GLASS = Finish("white", 0.4, tint=(0.50, 0.66, 0.72), gloss=0.4)
BOTTLE = Finish("white", 0.4, tint=(0.10, 0.22, 0.14), gloss=0.45)
VASE = Finish("white", 0.4, "scratches", 0.2, tint=(0.30, 0.44, 0.62), gloss=0.35)
WICKER = Finish("fabric", 0.2, "weave", 0.1, tint=(0.62, 0.46, 0.28))
TOP = 0.76  # height of the table top in meters
RUNNER = TOP + 0.003


def table() -> Model:
    """Build the model of the scene and its camera rig."""
    solids = [
        *interior((-2.4, -2.8, 0), (2.4, 2.2, 2.6), PLANKS, WALLPAPER),
        *_table(),
        *_flowers(0.03, 0.02),
        *_wine(-0.24, 0.03),
        *_bread(0.36, 0.0),
        *_candle(-0.55),
        *_candle(0.62),
        *_salt_and_pepper(-0.09, -0.09),
        *_menu(0.17, -0.06),
        block((-1.1, 1.75, 0.0), (1.1, 2.19, 0.85), WALNUT, texel=0.08),
        block((-2.4, 2.18, 0.0), (2.4, 2.2, 0.12), WHITE, texel=0.1),
    ]
    for x in (-0.42, 0.42):
        solids += _setting(x, -0.29, 0) + _setting(x, 0.29, 180) + _chair(x, 0.72, 180)
    solids += _chair(1.15, 0, 90) + _chair(-1.15, 0, -90)
    for x, name in ((-1.2, "dusk"), (0.0, "day"), (1.2, "grey")):
        solids += framed((x, 2.2, 1.55), (0.6, 0.75), name)
    lamps = [
        Lamp((-0.7, -1.0, 2.35), 0.22, (2.5, 2.3, 2.0)),
        Lamp((1.7, -1.4, 2.1), 0.4, (0.6, 0.68, 0.78)),
    ]
    interests = (
        (-0.42, -0.29, 0.77, 0.14), (0.42, -0.29, 0.77, 0.14), (-0.24, 0.0, 0.87, 0.10),
        (0.03, 0.0, 1.03, 0.14), (0.36, 0.0, 0.82, 0.12), (0.17, -0.09, 0.85, 0.10),
        (-0.62, -0.3, 0.77, 0.12), (-0.1, -0.1, 0.8, 0.08), (0.2, -0.3, 0.77, 0.12),
        (0.42, 0.29, 0.77, 0.14), (-0.55, 0.0, 0.85, 0.12), (0.62, -0.25, 0.77, 0.12),
    )  # fmt: skip
    rig = Rig((0.0, 0.0, 0.82), (1.45, 1.8), (-75, 75), (16, 50), interests)
    return Model(solids, lamps, Ambience((0.52, 0.52, 0.54), 0.5), rig)


def _table() -> list[Solid]:
    boards = -0.384 + 0.192 * np.arange(5)
    return [
        *(box((0, y, TOP - 0.018), (1.7, 0.190, 0.036), OAK, texel=0.025) for y in boards),
        block((-0.75, -0.4, 0.64), (0.75, 0.4, 0.72), OAK, texel=0.08),
        *(
            cylinder((x, y, 0), 0.7, 0.05, 0.08, OAK, texel=0.05)
            for x in (-0.72, 0.72)
            for y in (-0.38, 0.38)
        ),
        box((0, 0, TOP + 0.0015), (1.72, 0.30, 0.003), CLOTH, texel=0.02),
    ]


def _chair(x: float, y: float, facing: float) -> list[Solid]:
    """Model a slatted chair at (x, y) that faces +y, rotated by `facing` degrees about z."""
    rotation = turn(z=facing)

    def at(*p: float) -> np.ndarray:
        return rotation @ np.array(p) + (x, y, 0)

    solids = [box(at(0, 0, 0.45), (0.42, 0.42, 0.035), WALNUT, rotation=rotation)]
    for side in (-0.18, 0.18):
        solids.append(rod(at(side, 0.18, 0), at(side, 0.18, 0.44), 0.035, WALNUT, texel=0.05))
        solids.append(rod(at(side, -0.19, 0), at(side, -0.25, 0.98), 0.035, WALNUT, texel=0.05))
    for z in (0.62, 0.76, 0.90):
        slat = at(0, -0.20 - 0.06 * (z - 0.44), z)
        solids.append(box(slat, (0.36, 0.018, 0.07), WALNUT, rotation=rotation))
    return solids


def _setting(x: float, y: float, facing: float) -> list[Solid]:
    """Model plate, cutlery on a napkin and glass, for a guest who faces +y before rotation."""
    rotation = turn(z=facing)

    def at(px: float, py: float, pz: float = 0.0) -> np.ndarray:
        return rotation @ np.array([px, py, 0]) + (x, y, TOP + pz)

    tines = -0.19 + 0.0075 * (np.arange(4) - 1.5)
    wine = {2: tinted(GLASS, 0.35, 0.07, 0.12)}
    return [
        cylinder(
            at(0, 0), 0.016, 0.17, 0.265, CHINA,
            rotation=rotation, faces={2: print_of("plate", gloss=0.2)}, texel=0.015,
        ),
        box(at(0.175, -0.02, 0.003), (0.02, 0.13, 0.004), STEEL, rotation=rotation),
        box(at(0.175, -0.105, 0.004), (0.014, 0.09, 0.008), STEEL, rotation=rotation),
        rod(at(0.21, -0.11, 0.005), at(0.21, 0.03, 0.006), 0.008, STEEL),
        sphere(at(0.21, 0.05, 0.008), (0.038, 0.055, 0.014), STEEL, rotation=rotation),
        box(at(-0.205, -0.02, 0.004), (0.12, 0.19, 0.008), CLOTH, rotation=rotation, texel=0.015),
        rod(at(-0.19, -0.11, 0.013), at(-0.19, 0.02, 0.013), 0.008, STEEL),
        box(at(-0.19, 0.025, 0.013), (0.026, 0.012, 0.005), STEEL, rotation=rotation),
        *(rod(at(px, 0.025, 0.013), at(px, 0.075, 0.013), 0.0035, STEEL) for px in tines),
        cylinder(at(0.16, 0.14), 0.105, 0.055, 0.075, GLASS, faces=wine, texel=0.015),
    ]  # fmt: skip


def _flowers(x: float, y: float) -> list[Solid]:
    neck, up = np.array([x, y, RUNNER + 0.15]), np.array([0, 0, 1])
    solids = [
        cylinder((x, y, RUNNER), 0.09, 0.07, 0.12, VASE, texel=0.015),
        cylinder((x, y, RUNNER + 0.09), 0.08, 0.12, 0.06, VASE, texel=0.015),
    ]
    petals = ((0.93, 0.78, 0.20), (0.86, 0.30, 0.36), (0.94, 0.90, 0.86), (0.70, 0.42, 0.70))
    for i in range(7):
        angle = 2 * np.pi * i / 7
        out = np.array([np.cos(angle), np.sin(angle), 0])
        tip = neck + 0.1 * out + (0.12 + 0.05 * (0.4 * i % 1)) * up
        lean = turn(x=20 * out[1], y=20 * out[0])
        solids += [
            rod(neck, tip, 0.006, LEAF),
            sphere(tip, (0.075, 0.075, 0.045), peel(*petals[i % 4]), rotation=lean, texel=0.012),
            sphere(tip + 0.016 * up, 0.022, peel(0.5, 0.32, 0.1)),
            sphere(
                0.4 * neck + 0.6 * tip - 0.02 * up, (0.07, 0.03, 0.015), LEAF,
                rotation=turn(y=-30, z=np.rad2deg(angle)),
            ),
        ]  # fmt: skip
    return solids


def _wine(x: float, y: float) -> list[Solid]:
    front = turn(z=-90)  # the middle of the label
    return [
        cylinder((x, y, RUNNER), 0.2, 0.076, 0.076, BOTTLE, texel=0.015),
        cylinder(
            (x, y, RUNNER + 0.05), 0.10, 0.0772, 0.0772, label(2), rotation=front, texel=0.015
        ),
        cylinder((x, y, RUNNER + 0.2), 0.05, 0.076, 0.03, BOTTLE),
        cylinder((x, y, RUNNER + 0.25), 0.07, 0.03, 0.028, tinted(BOTTLE, 0.35, 0.06, 0.10)),
    ]


def _bread(x: float, y: float) -> list[Solid]:
    rolls = ((-0.04, 0.03), (0.04, -0.03), (0.01, 0.05))
    return [
        cylinder((x, y, RUNNER), 0.05, 0.18, 0.23, WICKER, texel=0.015),
        *(
            sphere(
                (x + dx, y + dy, RUNNER + 0.07), (0.12, 0.08, 0.07), CRUST,
                rotation=turn(z=50 * i), texel=0.012,
            )
            for i, (dx, dy) in enumerate(rolls)
        ),
    ]  # fmt: skip


def _candle(x: float) -> list[Solid]:
    return [
        cylinder((x, 0, RUNNER), 0.012, 0.09, 0.07, BRASS),
        cylinder((x, 0, RUNNER + 0.012), 0.06, 0.02, 0.03, BRASS),
        cylinder((x, 0, RUNNER + 0.072), 0.17, 0.022, 0.02, tinted(CHINA, 1.0, 0.96, 0.86)),
    ]


def _salt_and_pepper(x: float, y: float) -> list[Solid]:
    solids = []
    for dx, tone in ((0, 0.95), (-0.05, 0.3)):
        china = tinted(CHINA, tone, tone, tone)
        solids.append(cylinder((x + dx, y, RUNNER), 0.065, 0.04, 0.03, china, texel=0.015))
        solids.append(sphere((x + dx, y, RUNNER + 0.066), (0.03, 0.03, 0.018), STEEL))
    return solids


def _menu(x: float, y: float) -> list[Solid]:
    """Model a card folded into a tent."""
    card = print_of("menu")
    return [
        sheet(
            (x, y + side * 0.03, RUNNER + 0.088), (0.13, 0.18), card,
            facing=facing, rotation=turn(x=18 * side), texel=0.015,
        )
        for facing, side in (("-y", -1), ("+y", 1))
    ]  # fmt: skip
