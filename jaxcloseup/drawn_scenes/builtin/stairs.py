"""A flight of stairs with a runner, balusters and a handrail, beside a wall of pictures."""

import numpy as np

from jaxcloseup.drawn_scenes.builtin.furnishings import (
    BLACK,
    BRASS,
    FLOOR_TILES,
    OAK,
    PLASTER,
    WALLPAPER,
    WALNUT,
    WHITE,
    book,
    framed,
    interior,
    pot_plant,
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


RUNNER = Finish("carpet", 0.42, "pile", 0.15)
COIR = Finish("white", 0.3, "pile", 0.12, tint=(0.6, 0.45, 0.28))
DOORMAT = Finish("doormat", None, "pile", 0.13)
RUBBER = Finish("white", 0.5, "paper", 0.1, tint=(0.16, 0.34, 0.22), gloss=0.25)
RISE, RUN, STEPS = 0.185, 0.27, 10


def stairs() -> Model:
    """Build the model of the scene and its camera rig."""
    solids = [
        *interior((-2.3, -3.2, 0), (0.62, 2.9, 3.4), FLOOR_TILES, PLASTER, right=WALLPAPER),
        block((0.602, -3.2, 0), (0.62, 0.0, 0.12), WHITE, texel=0.1),
        block((-2.3, 2.88, 0), (-0.5, 2.9, 0.12), WHITE, texel=0.1),
        *(solid for step in range(STEPS) for solid in _step(step)),
        *_handrail(),
        block((-0.25, -0.72, 0.0), (0.45, -0.3, 0.018), COIR, faces={5: DOORMAT}, texel=0.03),
        *_boot((-0.72, -0.3, 0.0), 20),
        *_boot((-0.86, -0.24, 0.0), -5),
        *pot_plant((-0.34, 0.12, RISE), 0.16, 9),
    ]
    sizes, angles = ((0.22, 0.16, 0.036), (0.2, 0.15, 0.03), (0.18, 0.13, 0.032)), (6, -8, 14)
    for i, (size, angle) in enumerate(zip(sizes, angles, strict=True)):
        at = (0.46, 2 * RUN + 0.12, 3 * RISE + 0.018 + 0.034 * i)
        solids += book(at, size, i, angle)
    for i, name in enumerate(("dusk", "map", "grey", "day")):
        frame = (0.6, 0.45) if name == "map" else (0.44, 0.55)
        solids += framed((0.62, -0.45 + 0.75 * i, 1.45 + 0.42 * i), frame, name, facing="-x")
    lamps = [
        Lamp((-1.3, -1.6, 3.0), 0.22, (3.6, 3.3, 2.9)),
        Lamp((-1.6, 1.2, 3.1), 0.4, (1.0, 1.1, 1.25)),
    ]
    interests = (
        (0.1, -0.5, 0.02, 0.2), (0.62, -0.45, 1.45, 0.25), (0.62, 0.3, 1.87, 0.25),
        (-0.78, -0.3, 0.2, 0.2), (-0.34, 0.10, 0.32, 0.14), (0.44, 0.66, 0.6, 0.12),
        (-0.46, -0.1, 1.2, 0.12), (0.05, 0.27, 0.3, 0.15), (-0.46, 0.25, 0.8, 0.2),
        (0.05, 0.8, 0.7, 0.2), (0.62, 0.2, 1.2, 0.3), (-0.1, 0.0, 0.15, 0.15),
    )  # fmt: skip
    rig = Rig((-0.08, 0.1, 0.68), (2.35, 2.75), (-52, -8), (5, 32), interests)
    return Model(solids, lamps, Ambience((0.52, 0.52, 0.54), 0.6), rig)


def _step(number: int) -> list[Solid]:
    """Model tread, riser, runner with its rod, and two balusters."""
    y, low, z = RUN * number, RISE * number, RISE * (number + 1)
    solids = [
        block((-0.48, y, 0), (0.60, y + RUN, z - 0.03), WHITE, texel=0.08),
        block((-0.52, y - 0.03, z - 0.03), (0.60, y + RUN, z), OAK),
        block((-0.22, y - 0.032, z - 0.001), (0.36, y + RUN, z + 0.006), RUNNER),
        block((-0.22, y - 0.006, low), (0.36, y, z - 0.03), RUNNER),
        rod((-0.24, y - 0.012, low + 0.012), (0.38, y - 0.012, low + 0.012), 0.012, BRASS),
    ]
    for k in (0.25, 0.75):
        foot, up = np.array([-0.46, y + RUN * k - 0.03, z]), np.array([0, 0, 1])
        solids.append(rod(foot, foot + (0.86 + RISE * k) * up, 0.022, WHITE, texel=0.05))
        solids.append(cylinder(foot, 0.10, 0.042, 0.03, WHITE))
    return solids


def _handrail() -> list[Solid]:
    foot = np.array([-0.46, -0.13, RISE + 0.79])
    top = foot + np.array([0, RUN * STEPS + 0.1, RISE * STEPS + 0.07])
    return [
        rod(foot, top, 0.06, WALNUT, texel=0.04),
        block((-0.52, -0.15, 0), (-0.40, -0.03, 1.12), WHITE),
        block((-0.535, -0.165, 1.12), (-0.385, -0.015, 1.15), WALNUT),
        sphere((-0.46, -0.09, 1.21), 0.13, WALNUT, texel=0.02),
    ]


def _boot(base: tuple, facing: float) -> list[Solid]:
    """Model a rubber boot that points to -y, rotated by `facing` degrees about z."""
    rotation = turn(z=facing)

    def at(*p: float) -> np.ndarray:
        return rotation @ np.array(p) + base

    inside = {2: tinted(RUBBER, 0.05, 0.05, 0.05)}
    sole, lining = tinted(BLACK, 0.2, 0.17, 0.14), tinted(BLACK, 0.8, 0.78, 0.7)
    return [
        box(at(0, -0.06, 0.011), (0.085, 0.25, 0.022), sole, rotation=rotation),
        sphere(at(0, -0.09, 0.05), (0.095, 0.2, 0.10), RUBBER, rotation=rotation, texel=0.02),
        cylinder(at(0, 0.01, 0.02), 0.13, 0.092, 0.09, RUBBER, texel=0.02),
        cylinder(at(0, 0.01, 0.15), 0.16, 0.09, 0.115, RUBBER, texel=0.02, faces=inside),
        cylinder(at(0, 0.01, 0.295), 0.012, 0.118, 0.118, lining, faces=inside),
    ]
