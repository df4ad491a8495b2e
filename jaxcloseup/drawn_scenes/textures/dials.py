"""Draw a plate and a clock face on square sheets, uint8 `[1024, 1024, 3]`."""

import cv2
import numpy as np

from jaxcloseup.drawn_scenes.textures.lettering import (
    BLUE,
    BOLD,
    CREAM,
    GOLD,
    INK,
    WHITE,
    blank,
    center,
    write,
)


def plate(rng: np.random.Generator) -> np.ndarray:
    """Draw a china plate from above: rim bands, a ring of leaves, a flower."""
    sheet = blank((240, 239, 234))
    for radius, width, color in (
        (505, 10, BLUE),
        (480, 3, BLUE),
        (350, 4, BLUE),
        (338, 2, GOLD),
        (330, 14, (222, 221, 216)),
    ):
        cv2.circle(sheet, (512, 512), radius, color, width, cv2.LINE_AA)
    for i in range(36):
        angle = i * 2 * np.pi / 36
        at = 512 + 415 * np.array([np.cos(angle), np.sin(angle)])
        tilt = np.rad2deg(angle) + (30 if i % 2 else -30)
        cv2.ellipse(
            sheet, at.astype(int).tolist(), (44, 14), tilt, 0, 360, (62, 98, 168), -1, cv2.LINE_AA
        )
        cv2.ellipse(
            sheet, at.astype(int).tolist(), (40, 2), tilt, 0, 360, (210, 220, 236), -1, cv2.LINE_AA
        )
    for i in range(9):
        angle = i * 2 * np.pi / 9
        at = 512 + 80 * np.array([np.cos(angle), np.sin(angle)])
        cv2.ellipse(
            sheet,
            at.astype(int).tolist(),
            (70, 24),
            np.rad2deg(angle),
            0,
            360,
            (90, 124, 186),
            -1,
            cv2.LINE_AA,
        )
        cv2.ellipse(
            sheet,
            at.astype(int).tolist(),
            (56, 3),
            np.rad2deg(angle),
            0,
            360,
            WHITE,
            -1,
            cv2.LINE_AA,
        )
    cv2.circle(sheet, (512, 512), 34, GOLD, -1, cv2.LINE_AA)
    return sheet


def clock(rng: np.random.Generator) -> np.ndarray:
    """Draw a clock face with numerals, hands and small print."""
    sheet = blank(CREAM)
    cv2.circle(sheet, (512, 512), 500, (60, 44, 32), 22, cv2.LINE_AA)
    for i in range(60):
        direction = np.array([np.sin(i * np.pi / 30), -np.cos(i * np.pi / 30)])
        a, b = 512 + (440 if i % 5 else 420) * direction, 512 + 465 * direction
        cv2.line(
            sheet,
            a.astype(int).tolist(),
            b.astype(int).tolist(),
            INK,
            3 if i % 5 else 9,
            cv2.LINE_AA,
        )
        if i % 5 == 0:
            at = 512 + 355 * direction
            write(
                sheet,
                str(i // 5 or 12),
                (at[0], at[1] + 32),
                64,
                INK,
                font=BOLD,
                weight=5,
                centered=True,
            )
    center(sheet, "WREN & SONS", 690, 24, INK, weight=2)
    center(sheet, "eight day movement", 728, 12, INK)
    for angle, length, width in ((5.3, 240, 20), (0.9, 360, 12)):
        tip = 512 + length * np.array([np.sin(angle), -np.cos(angle)])
        cv2.line(sheet, (512, 512), tip.astype(int).tolist(), INK, width, cv2.LINE_AA)
    cv2.circle(sheet, (512, 512), 24, INK, -1, cv2.LINE_AA)
    return sheet
