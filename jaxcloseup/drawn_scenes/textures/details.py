"""Draw fine structure that multiplies a color: gray `[S, S]` deviations from the mean.

Each function draws a periodic texture; `patterns` has the noise and the cells.
"""

from collections.abc import Callable

import numpy as np

from jaxcloseup.drawn_scenes.textures.patterns import SIZE, grid, noise, step


def _plain(rng: np.random.Generator) -> np.ndarray:
    return np.zeros((SIZE, SIZE), np.float32)


def _grain(rng: np.random.Generator) -> np.ndarray:
    fibres = noise(rng, octave=120, stretch=14, slope=1)
    pores = step(noise(rng, octave=200, stretch=16, slope=2), 1.5, 2.3)[..., 0]
    return 0.06 * fibres - 0.24 * pores


def _grit(rng: np.random.Generator) -> np.ndarray:
    pits = step(noise(rng, octave=110, slope=2), 1.5, 2.2)[..., 0]
    return 0.12 * noise(rng, octave=150, slope=0.8) - 0.28 * pits


def _pile(rng: np.random.Generator) -> np.ndarray:
    """Draw carpet tufts in rows."""
    u, v, column, row = grid(56, 56, bond=0.5)
    tone = rng.uniform(-0.10, 0.10, (56, 56))[row, column]
    tuft = 0.9 * np.exp(-3.2 * ((u - 0.5) ** 2 + (v - 0.45) ** 2) * 2) - 0.6
    return 0.4 * tuft + tone + 0.09 * noise(rng, octave=260, slope=0.8)


def _weave(rng: np.random.Generator) -> np.ndarray:
    """Draw threads that cross over and under each other."""
    u, v, column, row = grid(64, 64)
    over = (column + row) % 2 == 0
    along, across = np.where(over, u, v), np.where(over, v, u)
    thread = np.sin(np.pi * across) ** 0.7 * (0.65 + 0.35 * np.sin(np.pi * along))
    tone = np.where(over, rng.normal(0, 0.05, 64)[row], rng.normal(0, 0.05, 64)[column])
    return 0.42 * thread + tone + 0.05 * noise(rng, octave=300, slope=0.8)


def _paper(rng: np.random.Generator) -> np.ndarray:
    return 0.022 * noise(rng, octave=150, slope=0.6)


def _scratches(rng: np.random.Generator) -> np.ndarray:
    brush = noise(rng, octave=240, stretch=150, slope=0.8)
    cross = np.rot90(noise(rng, octave=120, stretch=100, slope=2))
    return 0.03 * brush - 0.12 * step(cross, 2.6, 3.2)[..., 0]


DETAILS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "plain": _plain, "grain": _grain, "grit": _grit, "pile": _pile, "weave": _weave,
    "paper": _paper, "scratches": _scratches,
}  # fmt: skip
