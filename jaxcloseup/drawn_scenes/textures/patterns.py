"""Periodic patterns on the unit square for textures: noise, cells, scattered shapes.

`SIZE` is the side of every texture in texels; x runs along the second axis, y along the first.
"""

import itertools
from collections.abc import Callable

import numpy as np


SIZE = 1024


def noise(
    rng: np.random.Generator, *, octave: float = 4, slope: float = 1.5, stretch: float = 1.0
) -> np.ndarray:
    """Draw periodic fractal noise `[S, S]` with mean 0 and variance 1.

    Args:
      rng: random generator.
      octave: number of waves per side up to which the power spectrum is flat.
      slope: exponent of the fall-off of the amplitude beyond.
      stretch: values above 1 make streaks along x.
    """
    waves = np.fft.fftfreq(SIZE, 1 / SIZE).astype(np.float32)
    squared = (stretch * waves[None, : SIZE // 2 + 1]) ** 2 + waves[:, None] ** 2
    spectrum = rng.standard_normal((*squared.shape, 2), np.float32).view(np.complex64)[..., 0]
    spectrum *= (1 + squared / np.float32(octave**2)) ** np.float32(-slope / 2 - 0.5)
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum)
    return field / field.std()


def ramp(value: np.ndarray, *colors: tuple[float, float, float]) -> np.ndarray:
    """Interpolate colors `[..., 3]` along a polyline through `colors`, for `value` from 0 to 1."""
    stops, fine = np.linspace(0, 1, len(colors)), np.linspace(0, 1, 1024)
    table = np.stack([np.interp(fine, stops, c) for c in np.array(colors).T], -1)
    index = (np.clip(value, 0, 1) * 1023).astype(np.int32)
    return np.take(table.astype(np.float32), index, axis=0)


def rgb(*values: float) -> np.ndarray:
    """Return a color `[3]` in float32."""
    return np.array(values, np.float32)


def axes() -> tuple[np.ndarray, np.ndarray]:
    """Return texel centers x `[1, S]` and y `[S, 1]` in [0, 1]."""
    line = (np.arange(SIZE, dtype=np.float32) + 0.5) / SIZE
    return line[None], line[:, None]


def grid(columns: int, rows: int, *, bond: float = 0.0) -> tuple[np.ndarray, ...]:
    """Return cells of a periodic wall: position in the cell, column and row, each `[S, S]`."""
    x, y = axes()
    row = np.floor(y * rows)
    shifted = (x + 0 * y) * columns + bond * row
    column = np.floor(shifted) % columns
    return shifted % 1, (y * rows % 1) + 0 * x, column.astype(int), (row + 0 * x).astype(int)


def edge_distance(u: np.ndarray, v: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """Return the distance to the cell's border, in units of the texture's side."""
    return np.minimum(np.minimum(u, 1 - u) / columns, np.minimum(v, 1 - v) / rows)


def step(value: np.ndarray, low: float, high: float) -> np.ndarray:
    """Smooth step `[..., 1]` from 0 below `low` to 1 above `high`."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return (t * t * (3 - 2 * t))[..., None]


def scatter(
    rng: np.random.Generator, base: np.ndarray, count: int, draw: Callable[..., None]
) -> np.ndarray:
    """Draw `count` small shapes at random positions, wrapped around the borders."""
    image = np.ascontiguousarray(base, np.float32)
    for at in rng.uniform(0, SIZE, (count, 2)):
        state = rng.integers(2**32)
        copies = [(x, x - SIZE) if x > SIZE - 60 else (x, x + SIZE) if x < 60 else (x,) for x in at]
        for place in itertools.product(*copies):
            draw(image, np.random.default_rng(state), np.array(place))
    return image
