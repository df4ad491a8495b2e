"""A painted statue of a travelling bear on a round pedestal, photographed from all sides.

It has another face on each side: muzzle and coat, suitcase, rucksack and bedroll, clock and
umbrella; about half of the photographs see each.
"""

import itertools

import numpy as np

from jaxcloseup.drawn_scenes.builtin.furnishings import (
    BLACK,
    BRASS,
    CHINA,
    IRON,
    OAK,
    PAPER,
    PLANKS,
    PLASTER,
    STEEL,
    WALLPAPER,
    WALNUT,
    WHITE,
    framed,
    interior,
    label,
    print_of,
    tinted,
)
from jaxcloseup.drawn_scenes.lighting import Ambience, Lamp
from jaxcloseup.drawn_scenes.modeling import (
    Finish,
    Model,
    Rig,
    Solid,
    box,
    cylinder,
    rod,
    sheet,
    sphere,
    turn,
)


FUR = Finish("bread", 0.3, "pile", 0.12, tint=(0.95, 0.85, 0.75))
PALE = Finish("white", 0.3, "pile", 0.1, tint=(0.92, 0.76, 0.55))
COAT = Finish("upholstery", 0.16, "weave", 0.06)
FELT = Finish("plaster", 0.3, "grit", 0.15, tint=(0.78, 0.24, 0.2))
SCARF = Finish("fabric", 0.14, "weave", 0.05, tint=(1.1, 0.95, 0.55))
BOOT = Finish("peel", 0.2, "scratches", 0.15, tint=(0.85, 0.68, 0.16), gloss=0.25)
LEATHER = Finish("walnut", 0.35, "grit", 0.12, tint=(1.5, 1.2, 0.95), gloss=0.12)
CANVAS = Finish("fabric", 0.3, "weave", 0.06, tint=(0.62, 0.72, 0.46))
BEDROLL = Finish("carpet", 0.3, "pile", 0.1)
GRANITE = Finish("granite", 0.3, "grit", 0.25, gloss=0.15)
PALE_GRANITE = tinted(GRANITE, 1.9, 1.8, 1.65)
STONE = tinted(PLASTER, 0.8, 0.8, 0.78)
PLAQUE = Finish("plaque", None, "scratches", 0.1, gloss=0.2)
# the handle of the umbrella, from where it begins
HOOK = np.array([(0, 0, 0), (-0.02, 0, 0.035), (-0.06, 0, 0.035), (-0.075, 0, 0)])
TOP = 0.5  # height of the pedestal in meters


def statue() -> Model:
    """Build the model of the scene and its camera rig."""
    solids = [
        *interior((-3.2, -3.2, 0), (3.2, 3.2, 3.0), PLANKS, PLASTER, back=WALLPAPER),
        *_pedestal(),
        *_body(),
        *_head(),
        *_arms(),
        *_suitcase(),
        *_rucksack(),
        *_umbrella(),
    ]
    for x, y, facing in ((0.0, 3.2, "-y"), (3.2, 0.0, "-x"), (0.0, -3.2, "+y"), (-3.2, 0.0, "+x")):
        for along, name in ((-1.5, "dusk"), (0.0, "day"), (1.5, "grey")):
            center = (x or along, y or along, 1.5)
            solids += framed(center, (0.8, 1.0), name, facing=facing)
    lamps = [
        Lamp((1.4, -1.5, 2.7), 0.25, (2.7, 2.5, 2.2)),
        Lamp((-1.6, -0.4, 2.7), 0.3, (1.5, 1.5, 1.5)),
        Lamp((0.5, 1.6, 2.7), 0.3, (1.8, 1.9, 2.0)),
    ]
    interests = (
        (0.0, -0.15, TOP + 0.68, 0.12), (0.36, 0.0, TOP + 0.13, 0.14), (0.0, 0.3, TOP + 0.38, 0.14),
        (-0.2, 0.2, TOP + 0.42, 0.1), (0.0, -0.19, TOP + 0.36, 0.13), (0.0, 0.22, TOP + 0.6, 0.12),
        (-0.24, -0.2, TOP + 0.4, 0.12), (0.15, 0.0, TOP + 0.7, 0.1), (0.0, -0.46, 0.26, 0.14),
        (0.0, 0.13, TOP + 0.74, 0.1), (-0.2, 0.05, TOP + 0.3, 0.12), (0.0, -0.1, TOP + 0.08, 0.1),
    )  # fmt: skip
    rig = Rig(
        (0.0, 0.0, 0.86), (2.1, 2.4), (-180, 180), (2, 38), interests,
        photographs=24, magnification=(2.1, 4.0),
    )  # fmt: skip
    return Model(solids, lamps, Ambience((0.52, 0.52, 0.54), 0.6), rig)


def _pedestal() -> list[Solid]:
    """Model a drum of granite between stone rings, with beads around its edge and a plaque."""
    solids = [
        cylinder((0, 0, 0), 0.06, 1.2, 1.2, STONE, texel=0.04),
        cylinder((0, 0, 0.06), 0.05, 1.1, 0.96, STONE),
        cylinder((0, 0, 0.11), 0.31, 0.92, 0.86, GRANITE),
        cylinder((0, 0, 0.42), 0.04, 0.86, 0.98, STONE),
        cylinder((0, 0, 0.46), TOP - 0.46, 1.0, 1.0, PALE_GRANITE, texel=0.02),
        box((0, -0.452, 0.26), (0.3, 0.02, 0.135), BRASS, rotation=turn(x=-5.5), faces={2: PLAQUE}),
    ]
    for angle in np.deg2rad(np.arange(0, 360, 15)):
        at = (0.465 * np.cos(angle), 0.465 * np.sin(angle), 0.43)
        solids.append(sphere(at, 0.045, WHITE, texel=0.02))
    return solids


def _body() -> list[Solid]:
    """Model boots, legs, a coat with toggles and pockets, and a scarf."""
    solids = []
    for side in (-1, 1):
        x, lean = side * 0.095, turn(z=8 * side)
        solids += [
            sphere((x, -0.06, TOP + 0.045), (0.13, 0.26, 0.11), BOOT, rotation=lean, texel=0.02),
            cylinder((x, 0, TOP), 0.14, 0.125, 0.125, BOOT, texel=0.02),
            cylinder((x, 0, TOP + 0.135), 0.02, 0.14, 0.14, tinted(BOOT, 0.4, 0.3, 0.1)),
            cylinder((x, 0, TOP + 0.14), 0.1, 0.11, 0.11, FUR, texel=0.02),
            box((side * 0.125, -0.165, TOP + 0.29), (0.09, 0.012, 0.08), COAT,
                rotation=turn(x=-11, z=36 * side), texel=0.02),
        ]  # fmt: skip
    solids += [
        cylinder((0, 0, TOP + 0.19), 0.34, 0.44, 0.3, COAT, texel=0.02),
        cylinder((0, 0, TOP + 0.185), 0.02, 0.45, 0.445, tinted(COAT, 0.55, 0.5, 0.5)),
        sphere((0, 0, TOP + 0.5), (0.34, 0.3, 0.2), COAT, texel=0.02),
        sphere((0, -0.01, TOP + 0.575), (0.27, 0.26, 0.09), SCARF, texel=0.015),
        box((0.075, -0.158, TOP + 0.46), (0.07, 0.018, 0.2), SCARF,
            rotation=turn(x=-11, y=-6, z=20), texel=0.015),
    ]  # fmt: skip
    for z in (0.27, 0.35, 0.43):
        toggle = np.array([0, 0.206 * z - 0.273, TOP + z])  # on the slope of the coat
        across = np.array([0.03, 0, 0])
        solids.append(rod(toggle - 2 * across, toggle + 2 * across, 0.008, OAK))
        solids.append(rod(toggle - across, toggle + across, 0.024, WALNUT))
    return solids


def _head() -> list[Solid]:
    """Model a bear's head under a hat with a ticket in its ribbon."""
    z, tilt = TOP + 0.7, turn(x=-6, y=5)

    def on_hat(height: float, x: float = 0.0, y: float = 0.0) -> np.ndarray:
        return np.array([x, y, z + 0.07]) + tilt @ [0, 0, height]

    solids = [
        sphere((0, 0, z), (0.31, 0.29, 0.28), FUR, texel=0.015),
        sphere((0, -0.14, z - 0.04), (0.15, 0.15, 0.11), PALE, texel=0.012),
        sphere((0, -0.212, z - 0.012), (0.05, 0.035, 0.034), BLACK, texel=0.01),
        rod((0, -0.208, z - 0.03), (0, -0.206, z - 0.065), 0.006, BLACK),
        cylinder(on_hat(0), 0.014, 0.43, 0.42, FELT, rotation=tilt, texel=0.02),
        cylinder(on_hat(0.014), 0.12, 0.27, 0.22, FELT, rotation=tilt, texel=0.02),
        cylinder(on_hat(0.014), 0.035, 0.277, 0.262, SCARF, rotation=tilt, texel=0.02),
        sphere(on_hat(0.13), (0.22, 0.22, 0.05), FELT, rotation=tilt, texel=0.02),
        box(on_hat(0.06, 0.05, -0.128), (0.05, 0.004, 0.075), PAPER,
            rotation=tilt @ turn(x=-8, y=12, z=20), faces={2: print_of("chart")}),
    ]  # fmt: skip
    for side in (-1, 1):
        ear = (side * 0.155, 0.02, z + 0.01)
        solids += [
            sphere((side * 0.062, -0.128, z + 0.025), (0.036, 0.024, 0.04), BLACK, texel=0.01),
            sphere((side * 0.056, -0.139, z + 0.032), 0.01, WHITE),
            sphere(ear, (0.11, 0.06, 0.11), FUR, rotation=turn(y=15 * side), texel=0.015),
            sphere(np.add(ear, (side * 0.006, -0.022, 0)), (0.07, 0.03, 0.07), PALE, texel=0.015),
        ]
    return solids


def _limb(joints: list[tuple], thickness: float, finish: Finish) -> list[Solid]:
    """Model bars with round ends from joint to joint."""
    ends = [np.add(joint, (0, 0, TOP)) for joint in joints]
    return [
        *(rod(a, b, thickness, finish, texel=0.02) for a, b in itertools.pairwise(ends)),
        *(sphere(end, thickness, finish, texel=0.02) for end in ends),
    ]


def _arms() -> list[Solid]:
    """Model one arm that holds a newspaper and one that holds the suitcase."""
    folded = turn(x=-18, z=-24)
    return [
        *_limb([(-0.15, 0, 0.5), (-0.25, -0.04, 0.36), (-0.21, -0.15, 0.35)], 0.1, COAT),
        sphere((-0.205, -0.2, TOP + 0.355), 0.105, FUR, texel=0.015),
        *_limb([(0.15, 0, 0.5), (0.25, 0.01, 0.39), (0.28, 0, 0.32)], 0.1, COAT),
        sphere((0.285, 0, TOP + 0.28), 0.1, FUR, texel=0.015),
        box(
            (-0.23, -0.255, TOP + 0.42), (0.2, 0.014, 0.27), PAPER, rotation=folded,
            faces={2: print_of("newspaper"), 3: print_of("map")}, texel=0.02,
        ),
    ]  # fmt: skip


def _suitcase() -> list[Solid]:
    """Model a leather suitcase with straps, brass corners and labels."""
    x, z = 0.3, TOP + 0.115
    solids = [
        box((x, 0, z), (0.1, 0.36, 0.225), LEATHER, texel=0.02),
        rod((x, -0.06, z + 0.11), (x, -0.05, z + 0.15), 0.014, BLACK),
        rod((x, 0.06, z + 0.11), (x, 0.05, z + 0.15), 0.014, BLACK),
        rod((x, -0.05, z + 0.15), (x, 0.05, z + 0.15), 0.018, BLACK),
        box((x, 0, z), (0.104, 0.37, 0.008), BLACK),
        sheet((x + 0.0515, -0.03, z - 0.045), (0.13, 0.1), label(1), facing="+x", texel=0.02),
        sheet((x + 0.0515, 0.06, z + 0.055), (0.11, 0.09), print_of("day"), facing="+x"),
        sheet((x - 0.03, -0.1815, z + 0.05), (0.03, 0.06), print_of("recipe"), facing="-y"),
        sheet((x + 0.005, 0.1815, z - 0.03), (0.07, 0.1), print_of("menu"), facing="+y"),
    ]
    for y in (-0.12, 0.125):
        solids.append(box((x, y, z), (0.108, 0.022, 0.232), tinted(LEATHER, 0.6, 0.45, 0.35)))
        solids.append(box((x + 0.055, y, z + 0.08), (0.006, 0.034, 0.026), BRASS))
    for sx in (-1, 1):
        for sy in (-1, 1):
            for sz in (-1, 1):
                corner = (x + sx * 0.042, sy * 0.172, z + sz * 0.104)
                solids.append(sphere(corner, 0.034, BRASS, texel=0.02))
    return solids


def _rucksack() -> list[Solid]:
    """Model a rucksack with pockets, a bedroll, a mug and a clock."""
    y, z = 0.235, TOP + 0.37
    strap = tinted(LEATHER, 0.6, 0.45, 0.35)
    solids = [
        box((0, y, z), (0.3, 0.16, 0.3), CANVAS, texel=0.02),
        box((0, y + 0.012, z + 0.115), (0.32, 0.18, 0.09), tinted(CANVAS, 0.5, 0.56, 0.4),
            rotation=turn(x=-6), texel=0.02),
        box((0.0, y + 0.1, z - 0.06), (0.2, 0.06, 0.14), CANVAS, texel=0.015),
        sheet((0.0, y + 0.1315, z - 0.06), (0.13, 0.1), print_of("cereal"), facing="+y"),
        rod((-0.21, y + 0.01, z + 0.225), (0.21, y + 0.01, z + 0.225), 0.13, BEDROLL, texel=0.015),
        cylinder((0.165, y + 0.02, z - 0.12), 0.085, 0.07, 0.075, tinted(STEEL, 1.1, 1.1, 1.0)),
        cylinder((0.165, y + 0.02, z - 0.03), 0.005, 0.076, 0.076, CHINA),
        cylinder((-0.15, y, z + 0.02), 0.035, 0.13, 0.13, BRASS, rotation=turn(y=-90),
            faces={2: print_of("clock")}, texel=0.015),
    ]  # fmt: skip
    for x in (-0.1, 0.1):
        solids += [
            box((x, y + 0.095, z + 0.08), (0.022, 0.05, 0.2), strap, rotation=turn(x=-6)),
            box((x, y + 0.122, z + 0.03), (0.034, 0.01, 0.03), BRASS, rotation=turn(x=-6)),
            cylinder((x - 0.012, y + 0.01, z + 0.225), 0.024, 0.136, 0.136, strap,
                rotation=turn(y=90)),
            rod((x, -0.1, TOP + 0.56), (x, y, TOP + 0.53), 0.02, strap),
            rod((x, -0.1, TOP + 0.56), (x * 1.5, -0.14, TOP + 0.4), 0.02, strap),
        ]  # fmt: skip
    return solids


def _umbrella() -> list[Solid]:
    """Model a rolled umbrella that leans against the rucksack."""
    foot, grip = np.array([-0.3, 0.24, TOP]), np.array([-0.2, 0.17, TOP + 0.71])
    way = grip - foot
    axes = turn(y=np.rad2deg(np.arcsin(way[0] / np.linalg.norm(way))))
    axes = turn(x=np.rad2deg(np.arctan2(-way[1], way[2]))) @ axes  # turns z along the way
    hook = [grip + curve for curve in HOOK]
    return [
        rod(foot, grip, 0.014, IRON),
        cylinder(foot + 0.08 * way, 0.45, 0.02, 0.075, SCARF, rotation=axes, texel=0.015),
        cylinder(foot + 0.7 * way, 0.06, 0.075, 0.03, SCARF, rotation=axes, texel=0.015),
        *(rod(a, b, 0.02, WALNUT) for a, b in itertools.pairwise(hook)),
    ]
