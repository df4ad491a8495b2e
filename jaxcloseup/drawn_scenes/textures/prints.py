"""Draw printed sheets with letters, from headlines to small print of a few texels.

Each function draws a uint8 sheet, 1024 pixels wide, with its own aspect ratio.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from jaxcloseup.drawn_scenes.textures.dials import clock, plate
from jaxcloseup.drawn_scenes.textures.lettering import (
    BLUE,
    BOLD,
    CREAM,
    DAY,
    DUSK,
    GOLD,
    GRAY,
    GREEN,
    INK,
    RED,
    SCRIPT,
    SERIF,
    WHITE,
    Color,
    bar,
    blank,
    center,
    landscape,
    paragraph,
    write,
)


def _newspaper(rng: np.random.Generator) -> np.ndarray:
    page = blank((231, 226, 212), 1.4)
    center(page, "The Evening Observer", 105, 62, weight=4, font=BOLD)
    center(page, "No. 4,812    CITY EDITION    PRICE TWO PENCE", 145, 14)
    bar(page, (40, 158, 984, 161), INK)
    center(page, "A CLOSER LOOK", 245, 58, weight=5, font=BOLD)
    center(page, "what the far camera never saw", 290, 22)
    landscape(page, (275, 320, 748, 640), GRAY, rng)
    write(page, "The valley at noon, seen from the bridge.", (280, 660), 10)
    for column in range(4):
        left = 42 + column * 238
        top = 320 if column in (0, 3) else 690
        paragraph(page, (left, top, left + 222, 930), 9, rng)
        write(page, ("LETTERS", "WEATHER", "TRADE", "CHESS")[column], (left, 975), 20, font=BOLD)
        paragraph(page, (left, 995, left + 222, 1395), 9, rng)
        if column:
            bar(page, (left - 9, 320 if column == 3 else 690, left - 8, 1395), (120, 116, 110))
    return page


def _recipe(rng: np.random.Generator) -> np.ndarray:
    page = blank(CREAM, 1.35)
    center(page, "Country Bread", 120, 58, RED, font=SCRIPT, weight=4)
    landscape(page, (90, 170, 934, 520), DAY, rng)
    items = ("500 g flour", "350 ml water", "10 g salt", "7 g yeast", "1 tsp honey", "2 tbsp oil")
    write(page, "You need", (90, 590), 26, GREEN, font=BOLD)
    for i, item in enumerate(items):
        cv2.circle(page, (100, 628 + 44 * i), 5, RED, -1, cv2.LINE_AA)
        write(page, item, (118, 636 + 44 * i), 18)
    write(page, "Method", (430, 590), 26, GREEN, font=BOLD)
    for i in range(5):
        write(page, str(i + 1), (430, 640 + 135 * i), 26, RED, font=BOLD, weight=2)
        paragraph(page, (470, 615 + 135 * i, 940, 720 + 135 * i), 12, rng)
    paragraph(page, (90, 940, 400, 1290), 9, rng, (110, 100, 90))
    center(page, "- 47 -", 1350, 14)
    return page


def _cereal(rng: np.random.Generator) -> np.ndarray:
    box = blank((222, 150, 36), 1.45)
    for i in range(24):
        angles = i * np.pi / 12, (i + 0.5) * np.pi / 12
        ends = [(512 + 1500 * np.cos(a), 640 + 1500 * np.sin(a)) for a in angles]
        ray = np.array([(512, 640), *ends]).astype(np.int32)
        cv2.fillPoly(box, [ray], (234, 172, 60), cv2.LINE_AA)
    bar(box, (60, 90, 964, 400), (150, 30, 34))
    center(box, "GOLDEN", 230, 105, WHITE, font=BOLD, weight=12)
    center(box, "OAT HOOPS", 365, 88, (250, 214, 90), font=BOLD, weight=10)
    center(box, "crisp whole grain cereal with honey", 455, 24, INK, weight=2)
    cv2.ellipse(box, (512, 860), (380, 110), 0, 0, 360, (40, 70, 140), -1, cv2.LINE_AA)
    cv2.ellipse(box, (512, 860), (380, 260), 0, 0, 180, (46, 84, 160), -1, cv2.LINE_AA)
    cv2.ellipse(box, (512, 850), (345, 90), 0, 0, 360, (246, 242, 230), -1, cv2.LINE_AA)
    for _ in range(150):
        angle, r = rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform())
        at = (int(512 + 300 * r * np.cos(angle)), int(835 + 72 * r * np.sin(angle) - 30 * (1 - r)))
        cv2.circle(box, at, 17, (142, 90, 24), 11, cv2.LINE_AA)
        cv2.circle(box, at, 17, (206, 150, 62), 6, cv2.LINE_AA)
    bar(box, (640, 1160, 970, 1450), WHITE)
    write(box, "Nutrition per 100 g", (652, 1190), 14, weight=2)
    facts = (
        "Energy 1590 kJ",
        "Fat 5.2 g",
        "Sugars 18 g",
        "Fibre 9.1 g",
        "Protein 10 g",
        "Salt 0.6 g",
    )
    for i, fact in enumerate(facts):
        bar(box, (650, 1204 + 38 * i, 960, 1205 + 38 * i), INK)
        write(box, fact, (655, 1232 + 38 * i), 13)
    write(box, "500 g e", (70, 1420), 44, INK, font=BOLD, weight=3)
    paragraph(box, (70, 1180, 600, 1340), 10, rng)
    return box


def _labels(rng: np.random.Generator) -> np.ndarray:
    """Draw four labels, one in each quarter, for tins, jars and bottles."""
    sheet = blank(WHITE)
    designs = (
        (RED, "TOMATOES", "peeled plum", (205, 52, 40)),
        (GREEN, "GARDEN PEAS", "in water", (96, 150, 60)),
        ((60, 30, 40), "Chateau Lointain", "2019", (120, 26, 50)),
        ((196, 120, 30), "Honey", "wild flower", (236, 176, 50)),
    )
    for i, (color, name, kind, fruit) in enumerate(designs):
        part = blank(CREAM if i > 1 else WHITE)
        bar(part, (0, 0, 1024, 150), color)
        bar(part, (0, 900, 1024, 1024), color)
        for x in range(0, 1024, 64):
            cv2.circle(part, (x + 32, 150), 32, color, -1, cv2.LINE_AA)
        for side in (256, 768):
            font = SCRIPT if i > 1 else BOLD
            write(
                part,
                name,
                (side, 300),
                42 if len(name) < 12 else 34,
                color,
                font=font,
                weight=4,
                centered=True,
            )
            write(part, kind, (side, 360), 26, INK, weight=2, centered=True)
            for dx, dy in ((-80, 0), (80, 0), (0, -60), (0, 60)):
                at = (side + dx, 520 + dy)
                cv2.circle(part, at, 70, fruit, -1, cv2.LINE_AA)
                cv2.circle(
                    part,
                    (at[0] - 22, at[1] - 24),
                    16,
                    [min(255, c + 60) for c in fruit],
                    -1,
                    cv2.LINE_AA,
                )
            paragraph(part, (side - 210, 680, side + 210, 870), 13, rng)
            write(
                part, "400 g   BEST BEFORE 12 2031", (side, 970), 20, WHITE, weight=2, centered=True
            )
        quarter = cv2.resize(part, (512, 512), interpolation=cv2.INTER_AREA)
        y, x = divmod(i, 2)
        sheet[512 * y : 512 * (y + 1), 512 * x : 512 * (x + 1)] = quarter
    return sheet


def _spines(rng: np.random.Generator) -> np.ndarray:
    """Draw eight book spines side by side, with titles along their length."""
    titles = (
        "A HISTORY OF LENSES", "THE LONG STAIRCASE", "Bread and Salt", "ATLAS OF SMALL THINGS",
        "Letters from a Garden", "GEOMETRY, VOL. II", "The Brickmaker", "NIGHT TRAINS",
    )  # fmt: skip
    colors = (
        RED,
        BLUE,
        (92, 64, 40),
        GREEN,
        (120, 90, 120),
        (40, 44, 50),
        (176, 96, 40),
        (206, 196, 170),
    )
    sheet = blank(INK)
    for i, (title, color) in enumerate(zip(titles, colors, strict=True)):
        spine = blank(color, 0.125)
        ink = INK if sum(color) > 450 else (236, 208, 140)
        write(spine, title, (100, 84), 40, ink, font=BOLD if i % 2 else SERIF, weight=3)
        write(spine, ("H. Marlow", "A. Quill", "R. Stone", "E. Vane")[i % 4], (790, 76), 20, ink)
        for x in (40, 56, 950, 966):
            bar(spine, (x, 0, x + 4, 128), ink)
        noise = rng.normal(0, 5, spine.shape[:2])[..., None]
        spine = np.clip(spine + noise, 0, 255).astype(np.uint8)
        sheet[:, 128 * i : 128 * (i + 1)] = np.rot90(spine, -1)
    return sheet


def _map(rng: np.random.Generator) -> np.ndarray:
    """Draw a town map with named streets."""
    sheet = blank((236, 230, 208), 0.75)
    x = np.arange(-20, 1060, 10)
    river = np.stack([x, 420 + 90 * np.sin(x / 170) + 30 * np.sin(x / 60)], 1).astype(np.int32)
    for i in range(260):
        at = rng.integers([20, 90], [1000, 730])
        if abs(at[1] - np.interp(at[0], river[:, 0], river[:, 1])) > 55:
            size = rng.integers(8, 26, 2)
            tone = [(214, 190, 160), (200, 208, 170), (222, 204, 186)][i % 3]
            bar(sheet, (*at, *(at + size)), tone)
            cv2.rectangle(sheet, at.tolist(), (at + size).tolist(), (150, 130, 110), 1, cv2.LINE_AA)
    cv2.polylines(sheet, [river], False, (120, 166, 196), 56, cv2.LINE_AA)
    names = ("Mill Lane", "High Street", "Station Road", "Abbey Walk", "Castle Hill", "Orchard Way")
    for i, name in enumerate(names):
        a, b = np.array([0, 140 + 105 * i]), np.array([1024, 90 + 118 * i])
        for width, color in ((17, (150, 130, 110)), (13, WHITE)):
            cv2.line(sheet, a.tolist(), b.tolist(), color, width, cv2.LINE_AA)
            cv2.line(sheet, (160 * i + 90, 80), (150 * i + 130, 768), color, width, cv2.LINE_AA)
        for k in range(3):
            along = a + (b - a) * (0.12 + 0.33 * k)
            write(sheet, name, (along[0], along[1] + 4), 9)
    places = (("St Anne", 240, 330), ("Market", 520, 560), ("Park", 780, 250), ("Quay", 420, 450))
    for place, column, row in places:
        cv2.circle(sheet, (column - 12, row - 6), 6, RED, -1, cv2.LINE_AA)
        write(sheet, place, (column, row), 15, RED, font=BOLD)
    bar(sheet, (0, 0, 1024, 76), BLUE)
    center(sheet, "PLAN OF THE OLD TOWN", 54, 34, CREAM, font=BOLD, weight=3)
    return sheet


def _chart(rng: np.random.Generator) -> np.ndarray:
    """Draw an eye chart: rows of letters, each row smaller than the one above."""
    sheet = blank(WHITE, 1.4)
    y, height = 0.0, 150.0
    while height > 5:
        y += 1.9 * height if y else 1.35 * height
        letters = rng.choice(list("CDEFHKNOPRSTVZ"), min(12, int(4 * (150 / height) ** 0.55) - 2))
        center(sheet, "  ".join(letters), y, height, INK, font=BOLD, weight=max(1, int(height / 9)))
        height *= 0.72
    center(sheet, "READ FROM THREE METRES", 1410, 12, RED)
    return sheet


def _picture(tones: Sequence[Color], title: str) -> Callable[[np.random.Generator], np.ndarray]:
    def draw(rng: np.random.Generator) -> np.ndarray:
        sheet = blank(WHITE, 1.25)
        landscape(sheet, (90, 90, 934, 1060), tones, rng)
        center(sheet, title, 1150, 34, INK, font=SCRIPT, weight=2)
        center(sheet, "lithograph, 12 / 80", 1200, 13, (110, 106, 100))
        return sheet

    return draw


def _plaque(rng: np.random.Generator) -> np.ndarray:
    sheet = blank((186, 150, 78), 0.45)
    cv2.rectangle(sheet, (18, 18), (1005, 442), (92, 68, 30), 5, cv2.LINE_AA)
    center(sheet, "IN MEMORY OF", 98, 26, (60, 42, 18), weight=2)
    center(sheet, "EDITH MARLOW", 190, 58, (60, 42, 18), font=BOLD, weight=4)
    center(sheet, "1921 - 2009", 252, 28, (60, 42, 18), weight=2)
    center(sheet, "who loved this garden and sat here", 330, 22, (60, 42, 18))
    center(sheet, "most afternoons, reading the small print", 382, 22, (60, 42, 18))
    for at in ((44, 44), (980, 44), (44, 418), (980, 418)):
        cv2.circle(sheet, at, 11, (120, 92, 42), -1, cv2.LINE_AA)
        cv2.line(
            sheet, (at[0] - 8, at[1] - 5), (at[0] + 8, at[1] + 5), (70, 50, 22), 3, cv2.LINE_AA
        )
    return sheet


def _doormat(rng: np.random.Generator) -> np.ndarray:
    sheet = blank((150, 112, 68), 0.6)
    cv2.rectangle(sheet, (40, 40), (984, 574), (50, 36, 24), 14, cv2.LINE_AA)
    center(sheet, "WELCOME", 350, 120, (50, 36, 24), font=BOLD, weight=22)
    center(sheet, "mind the step", 470, 44, (50, 36, 24), font=SCRIPT, weight=6)
    return sheet


def _menu(rng: np.random.Generator) -> np.ndarray:
    sheet = blank(CREAM, 1.4)
    cv2.rectangle(sheet, (40, 40), (984, 1394), GOLD, 6, cv2.LINE_AA)
    cv2.rectangle(sheet, (58, 58), (966, 1376), GOLD, 2, cv2.LINE_AA)
    center(sheet, "Menu", 210, 90, BLUE, font=SCRIPT, weight=6)
    courses = (
        ("TO START", "Leek and potato soup", "Rye bread, salted butter"),
        ("FROM THE OVEN", "Roast chicken with thyme", "Carrots, new potatoes"),
        ("TO FINISH", "Plum tart", "Coffee and walnuts"),
    )
    for i, (course, *dishes) in enumerate(courses):
        y = 360 + 310 * i
        center(sheet, course, y, 28, RED, font=BOLD, weight=2)
        for k, dish in enumerate(dishes):
            center(sheet, dish, y + 75 + 70 * k, 28, INK, font=SERIF, weight=2)
        center(sheet, "please ask about nuts, milk, wheat and celery", y + 195, 13, (110, 104, 96))
    return sheet


PRINTS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "newspaper": _newspaper, "recipe": _recipe, "cereal": _cereal, "labels": _labels,
    "spines": _spines, "map": _map, "chart": _chart, "dusk": _picture(DUSK, "The Valley at Dusk"),
    "day": _picture(DAY, "Early Summer"), "grey": _picture(GRAY, "Winter, from the Pass"),
    "plaque": _plaque, "doormat": _doormat, "menu": _menu, "plate": plate, "clock": clock,
}  # fmt: skip
