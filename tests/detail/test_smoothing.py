"""Smoothed depth against loops in float64, and on a plane, a step and noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.detail.smoothing import smooth_depth


HEIGHT, WIDTH = 40, 56
SMOOTH = jax.jit(smooth_depth)


def slanted_plane():
    """Z-depth of a plane: its inverse is linear in the pixels."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return 1 / (0.5 + 0.002 * x - 0.003 * y)


def steps(rng):
    """A plane behind patches that lie up to 2 % before it, as splats do."""
    patches = rng.uniform(-0.02, 0.02, (HEIGHT // 4, WIDTH // 4)).repeat(4, 0).repeat(4, 1)
    return slanted_plane() * (1 + patches)


def oracle(depth, levels):
    """The same passes, pixel by pixel."""
    known, value = depth > 0, np.log(np.where(depth > 0, depth, 1.0))

    def at(row, column):
        return min(max(row, 0), HEIGHT - 1), min(max(column, 0), WIDTH - 1)

    gap, departures = 2**levels // 2, []
    for row in range(HEIGHT):
        for column in range(WIDTH):
            places = [(row, column)]
            places += [at(row + s * gap, column) for s in (-1, 1)]
            places += [at(row, column + s * gap) for s in (-1, 1)]
            if all(known[place] for place in places):
                around = np.mean([value[place] for place in places[1:]])
                departures.append(abs(value[row, column] - around))
    scale = 20 * max(np.median(departures), 1e-6)
    for level in range(levels):
        new = value.copy()
        for row in range(HEIGHT):
            for column in range(WIDTH):
                total = weights = 0.0
                for i in (-1, 0, 1):
                    for j in (-1, 0, 1):
                        y, x = row + i * 2**level, column + j * 2**level
                        if not (0 <= y < HEIGHT and 0 <= x < WIDTH and known[y, x]):
                            continue
                        weight = [1, 2, 1][i + 1] * [1, 2, 1][j + 1]
                        weight *= np.exp(-0.5 * ((value[y, x] - value[row, column]) / scale) ** 2)
                        total, weights = total + weight * value[y, x], weights + weight
                new[row, column] = total / weights if weights else value[row, column]
        value = new
    return np.where(known, np.exp(value), depth)


@pytest.mark.parametrize(("radius", "levels"), [(0.3, 0), (1.5, 2), (3.0, 3)])
def test_as_loops_in_float64(radius, levels):
    rng = np.random.default_rng(0)
    depth = steps(rng)
    depth[:, 30:] *= 1.5
    depth[rng.random(depth.shape) < 0.05] = 0
    found = SMOOTH(jnp.asarray(depth, jnp.float32), radius)
    expected = oracle(depth, levels) if levels else depth
    np.testing.assert_allclose(found, expected, rtol=2e-5)


def test_steps_of_splats_go_and_edges_of_objects_stay():
    depth = steps(np.random.default_rng(1))
    depth[:, 30:] *= 2
    found = np.asarray(SMOOTH(jnp.asarray(depth, jnp.float32), 3.0))
    true = slanted_plane()
    true[:, 30:] *= 2

    def off(values):
        return np.abs(values / true - 1)

    inner = np.s_[8:-8, 8:-8]  # at the border, a slanted plane is averaged from one side
    assert off(found)[inner].mean() < 0.4 * off(depth)[inner].mean()
    # Beside the edge too: neither side takes from the other.
    assert off(found)[8:-8, 28:32].max() < 0.03


def test_what_is_undefined_stays_and_changes_nothing():
    plane = slanted_plane().astype(np.float32)
    depth = plane.copy()
    depth[10:20, 10:20] = 0
    found = np.asarray(SMOOTH(jnp.asarray(depth), 2.0))
    np.testing.assert_array_equal(found == 0, depth == 0)
    np.testing.assert_allclose(found[depth > 0], plane[depth > 0], rtol=0.01)
    np.testing.assert_array_equal(SMOOTH(jnp.zeros((HEIGHT, WIDTH)), 2.0), 0)
