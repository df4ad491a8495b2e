"""Draw letters, running text, bars and landscapes on uint8 images with OpenCV."""

from collections.abc import Sequence

import cv2
import numpy as np


SERIF, BOLD, SCRIPT = (
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_SCRIPT_COMPLEX,
)
INK, RED, BLUE, GREEN, GOLD, CREAM, WHITE = (
    (35, 32, 30), (176, 40, 34), (34, 66, 130), (42, 98, 58), (204, 152, 50), (244, 236, 216),
    (250, 249, 246),
)  # fmt: skip
# Printed on textures: any change, even of spelling, changes the pixels of the built-in scenes.
TEXT = """
the lamp stood near a window and its light fell over brick and oak while rain went on in the yard a
kettle began to sing so we cut bread and set plates along the table nobody had measured how far the
stairs were worn but every step kept the print of a shoe and the rail was smooth look closer said
the painter and you will find grain inside the grain small letters under large ones and threads that
cross where you only saw a colour
"""

# Colors of a landscape: sky, sun, then hills from the farthest to the nearest.
DUSK, DAY, GRAY = (
    [(238, 206, 160), (214, 92, 52), (170, 140, 140), (110, 112, 124), (70, 84, 92), (40, 54, 58)],
    [(176, 208, 226), (248, 226, 140), (140, 172, 150), (98, 140, 96), (64, 104, 66), (40, 70, 48)],
    [(206, 204, 198), (240, 240, 236), (150, 148, 144), (112, 110, 99), (76, 75, 72), (44, 43, 42)],
)  # fmt: skip


Color = tuple[int, int, int]
Box = tuple[float, float, float, float]  # left, top, right, bottom in pixels


def write(
    image: np.ndarray, text: str, at: Sequence[float], height: float, color: Color = INK, *,
    font: int = SERIF, weight: int = 1, centered: bool = False,
) -> None:  # fmt: skip
    """Write `text` with its baseline at `at`, capitals `height` pixels tall, into a uint8 image."""
    scale = height / cv2.getTextSize("H", font, 1, 1)[0][1]
    x = at[0] - cv2.getTextSize(text, font, scale, weight)[0][0] / 2 if centered else at[0]
    cv2.putText(image, text, (int(x), int(at[1])), font, scale, color, weight, cv2.LINE_AA)


def center(
    image: np.ndarray, text: str, y: float, height: float, color: Color = INK, *,
    font: int = SERIF, weight: int = 1,
) -> None:  # fmt: skip
    """Write `text` in the middle of a sheet 1024 pixels wide, with its baseline at `y`."""
    write(image, text, (512, y), height, color, font=font, weight=weight, centered=True)


def paragraph(
    image: np.ndarray, box: Box, height: float, rng: np.random.Generator, color: Color = INK
) -> None:
    """Fill a box with running text."""
    left, top, right, bottom = box
    scale = height / cv2.getTextSize("H", SERIF, 1, 1)[0][1]
    words = TEXT.split()
    word = int(rng.integers(len(words)))
    for y in np.arange(top + height, bottom, 1.75 * height):
        line = ""
        while True:
            longer = f"{line} {words[word % len(words)]}".strip()
            if cv2.getTextSize(longer, SERIF, scale, 1)[0][0] > right - left:
                break
            line, word = longer, word + 1
        write(image, line, (left, y), height, color)


def blank(color: Color, aspect: float = 1.0) -> np.ndarray:
    """Return an empty sheet 1024 pixels wide and `aspect` times as tall."""
    return np.full((round(1024 * aspect), 1024, 3), color, np.uint8)


def bar(image: np.ndarray, box: Box, color: Color) -> None:
    """Fill a box with a color."""
    left, top, right, bottom = map(int, box)
    cv2.rectangle(image, (left, top), (right, bottom), color, -1)


def landscape(
    image: np.ndarray, box: Box, tones: Sequence[Color], rng: np.random.Generator
) -> None:
    """Draw hills under a sun into a box, from the farthest layer to the nearest."""
    left, top, right, bottom = map(int, box)
    view = image[top:bottom, left:right]
    height, width = view.shape[:2]
    view[:] = tones[0]
    cv2.circle(view, (int(0.7 * width), int(0.3 * height)), height // 7, tones[1], -1, cv2.LINE_AA)
    x = np.arange(width)
    for i, tone in enumerate(tones[2:]):
        waves = sum(
            np.sin(x / width * 2 * np.pi * f + rng.uniform(0, 6)) / f for f in (0.7, 1.6, 3.3, 7.0)
        )
        level = height * (0.42 + 0.6 * i / len(tones[2:]) - 0.08 * waves)
        hill = np.concatenate([np.stack([x, level], 1), [[width, height], [0, height]]])
        cv2.fillPoly(view, [np.round(hill * 16).astype(np.int32)], tone, cv2.LINE_AA, 4)
        for at in rng.integers(0, width, 14):
            tall = height * 0.012 * (i + 2)
            crown = [at, level[at] + 6] + tall * np.array([[0, -3], [-1, 0], [1, 0]])
            cv2.fillPoly(view, [crown.astype(np.int32)], [int(0.72 * c) for c in tone], cv2.LINE_AA)
    cv2.rectangle(image, (left, top), (right, bottom), INK, 2, cv2.LINE_AA)
