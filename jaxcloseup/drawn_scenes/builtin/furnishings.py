"""Finishes and small objects that several scenes share."""

from typing import Any

import numpy as np

from jaxcloseup.drawn_scenes.modeling import (
    Finish,
    Solid,
    block,
    box,
    cylinder,
    sheet,
    sphere,
    turn,
)


OAK = Finish("oak", 0.5, "grain", 0.22, gloss=0.06, grain=True)
WALNUT = Finish("walnut", 0.5, "grain", 0.2, gloss=0.08, grain=True)
PINE = Finish("pine", 0.45, "grain", 0.2, gloss=0.03, grain=True)
PLANKS = Finish("planks", 1.6, "grain", 0.3, gloss=0.05)
FLOOR_TILES = Finish("floor_tiles", 1.2, "scratches", 0.4, gloss=0.1)
PLASTER = Finish("plaster", 0.8, "paper", 0.3)
WALLPAPER = Finish("wallpaper", 0.9, "paper", 0.2)
WHITE = Finish("white", 0.6, "paper", 0.15, gloss=0.05)
CHINA = Finish("white", 0.5, gloss=0.25)
PAPER = Finish("white", 0.3, "paper", 0.08)
STEEL = Finish("steel", 0.2, "scratches", 0.15, gloss=0.35)
BRASS = STEEL._replace(tint=(1.15, 0.92, 0.50))
BLACK = Finish("white", 0.5, "scratches", 0.3, tint=(0.10, 0.10, 0.11), gloss=0.3)
IRON = Finish("iron", 0.35, "grit", 0.12, gloss=0.08)
CLOTH = Finish("fabric", 0.28, "weave", 0.055)
TERRACOTTA = Finish("plaster", 0.5, "grit", 0.3, tint=(0.92, 0.50, 0.33))
LEAF = Finish("leaves", 0.4, "grain", 0.2, tint=(1.25, 1.28, 1.2))
CRUST = Finish("bread", 0.24, "grit", 0.14)

COVERS = ((0.25, 0.32, 0.5), (0.6, 0.22, 0.18), (0.3, 0.42, 0.3))
PAGES = (0.95, 0.92, 0.84)


def tinted(finish: Finish, red: float, green: float, blue: float) -> Finish:
    """Return the same finish with another tint."""
    return finish._replace(tint=(red, green, blue))


def peel(red: float, green: float, blue: float) -> Finish:
    """Return the skin of a fruit."""
    return Finish("peel", 0.12, "paper", 0.08, tint=(red, green, blue), gloss=0.15)


def print_of(name: str, part: tuple[int, int, int, int] = (0, 0, 1, 1), **options: Any) -> Finish:
    """Return a printed sheet; `part` = (column, row, columns, rows) selects a cell of its grid."""
    column, row, columns, rows = part
    region = column / columns, row / rows, (column + 1) / columns, (row + 1) / rows
    return Finish(name, None, "paper", 0.1, region=region, **options)


def label(index: int) -> Finish:
    """Return a label: 0 is tomatoes, 1 peas, 2 wine, 3 honey."""
    return print_of("labels", (index % 2, index // 2, 2, 2), gloss=0.08)


def spine(index: int) -> Finish:
    """Return the spine of one of eight books."""
    return print_of("spines", (index % 8, 0, 8, 1))


def interior(low: tuple, high: tuple, floor: Finish, wall: Finish, **walls: Finish) -> list[Solid]:
    """Model six sheets that face into a room; `walls` overrides `back` (+y) or `right` (+x)."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    x, y, z = (x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2
    width, depth, height = x1 - x0, y1 - y0, z1 - z0
    back, right = walls.get("back", wall), walls.get("right", wall)
    return [
        sheet((x, y, z0), (width, depth), floor, texel=0.06),
        sheet((x, y, z1), (width, depth), WHITE, facing="-z", texel=0.25),
        sheet((x, y1, z), (width, height), back, facing="-y", texel=0.05),
        sheet((x, y0, z), (width, height), wall, facing="+y", texel=0.25),
        sheet((x0, y, z), (depth, height), wall, facing="+x", texel=0.1),
        sheet((x1, y, z), (depth, height), right, facing="-x", texel=0.07),
    ]


def framed(
    center: tuple, size: tuple, name: str, *, facing: str = "-y", frame: Finish = WALNUT
) -> list[Solid]:
    """Model a print in a frame of four bars, hung on the wall at `center`."""
    out = (-1.0 if facing[0] == "-" else 1.0) * np.eye(3)["xy".index(facing[1])]
    across, up = np.array([abs(out[1]), abs(out[0]), 0]), np.array([0, 0, 1])
    width, height = size
    middle, bar, bulk = center + 0.013 * out, 0.025, 0.026 * np.abs(out)
    solids = [
        sheet(center + 0.012 * out, size, print_of(name, gloss=0.05), facing=facing, texel=0.03)
    ]
    for sign in (-1, 1):
        post = middle + sign * (width + bar) / 2 * across
        rail = middle + sign * (height + bar) / 2 * up
        solids.append(box(post, across * bar + bulk + up * height, frame))
        solids.append(box(rail, across * (width + 2 * bar) + bulk + up * bar, frame))
    return solids


def book(center: tuple, size: tuple, index: int, angle: float) -> list[Solid]:
    """Model a book lying flat; its spine faces -y, rotated by `angle` degrees about z."""
    rotation, cover = turn(z=angle), tinted(PAPER, *COVERS[index % len(COVERS)])
    (width, depth, height), title = size, {2: spine(2 * index + 1)}
    back, lying = center + rotation @ [0, -depth / 2 - 0.002, 0], rotation @ turn(y=-90)
    return [
        box(center, size, tinted(PAPER, *PAGES), rotation=rotation, faces={4: cover, 5: cover}),
        box(back, (height, 0.004, width), cover, rotation=lying, faces=title),
    ]


def standing_book(corner: tuple, size: tuple, index: int) -> Solid:
    """Model an upright book, spine towards -y; `corner` is its lower left front corner."""
    sides = {k: tinted(PAPER, 0.4, 0.36, 0.34) for k in (0, 1)}
    return block(corner, np.add(corner, size), PAPER, faces={2: spine(index), **sides})


def pot_plant(base: tuple, size: float, leaves: int) -> list[Solid]:
    """Model flat leaves that rise in a spiral from a flower pot `size` meters wide."""
    x, y, z = base
    solids = [cylinder(base, 0.88 * size, 0.7 * size, size, TERRACOTTA, texel=0.02)]
    for i in range(leaves):
        angle = 2.4 * i
        out, rise = 0.7 * size, size * (1.35 + 0.9 * i / leaves)
        tip = (x + out * np.cos(angle), y + out * np.sin(angle), z + rise)
        lean = turn(y=25 - 5 * (i % 3), z=np.rad2deg(angle))
        solids.append(sphere(tip, (0.95 * size, 0.42 * size, 0.035 * size), LEAF, rotation=lean))
    return solids
