"""Surfels as SPZ, read back by a reader that follows the format's own description."""

import gzip
import struct

import jax.numpy as jnp
import numpy as np
import pytest
from reference_splats import rotation_of, sh_color
from splat_scenes import random_scene, to_surfels

from jaxcloseup.artifacts.spz import pack_spz
from jaxcloseup.io.placement import Placement


FLIP = np.diag([1.0, -1, -1])


def by_hand(packed, *, flags=0):
    """Read a file of version 3, one splat after the other."""
    data = gzip.decompress(packed)
    magic, version, count, degree, bits, *others = struct.unpack_from("<4sIIBBBB", data)
    assert (magic, version, *others) == (b"NGSP", 3, flags, 0)
    bases = (degree + 1) ** 2 - 1
    sizes = [9, 1, 3, 3, 4, 3 * bases]
    starts = 16 + count * np.cumsum([0, *sizes])
    assert starts[-1] == len(data)
    splats = []
    for i in range(count):
        parts = [data[a + i * n : a + i * n + n] for a, n in zip(starts, sizes, strict=False)]
        position, (alpha,), color, scale, turn, sh = parts
        xyz = [
            int.from_bytes(position[j : j + 3], "little", signed=True) / 2**bits for j in (0, 3, 6)
        ]
        (word,) = struct.unpack("<I", turn)
        largest = word >> 30
        rest = [word >> shift & 1023 for shift in (20, 10, 0)]
        quaternion = [(-1 if r >> 9 else 1) * (r & 511) / 511 / 2**0.5 for r in rest]
        quaternion.insert(largest, (1 - sum(q * q for q in quaternion)) ** 0.5)
        splats.append(
            {
                "position": np.array(xyz),
                "opacity": alpha / 255,
                "dc": (np.array(list(color)) / 255 - 0.5) / 0.15,
                "log_scales": np.array(list(scale)) / 16 - 10,
                "rotation": rotation_of(np.array(quaternion)[[3, 0, 1, 2]]),
                "sh": (np.array(list(sh)).reshape(bases, 3) - 128) / 128,
            }
        )
    return splats, 2.0**-bits


def nearest(splat, surfels, alive):
    away = np.linalg.norm(np.asarray(surfels.means) @ FLIP - splat["position"], axis=1)
    return int(np.where(alive, away, np.inf).argmin())


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_splats_come_back_in_the_frame_of_the_format(degree):
    rng = np.random.default_rng(degree)
    surfels = to_surfels(random_scene(1, num_scales=3))
    sh = rng.uniform(-0.9, 0.9, size=(16, (degree + 1) ** 2, 3))
    surfels = surfels.replace(sh=jnp.asarray(sh, jnp.float32))
    alive = np.arange(16) % 3 > 0
    packed, dropped = pack_spz(surfels, jnp.asarray(alive))
    found, step = by_hand(packed)
    rows = np.flatnonzero(alive)
    assert dropped == 0 and len(found) == len(rows)
    # Coordinates are as fine as small splats need, and splats are in the order of their heights.
    smaller = np.sort(np.asarray(surfels.log_scales)[rows], axis=1)[:, 1]
    assert step <= 0.3 * np.exp(np.quantile(smaller, 0.1)) < 2 * step
    assert np.all(np.diff([splat["position"][1] for splat in found]) >= 0)
    rows = [nearest(splat, surfels, alive) for splat in found]
    assert len(set(rows)) == len(found)
    directions = rng.normal(size=(16, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for row, splat in zip(rows, found, strict=True):
        mean, scales = np.asarray(surfels.means[row]), np.asarray(surfels.log_scales[row])
        np.testing.assert_allclose(splat["position"], FLIP @ mean, atol=0.51 * step)
        np.testing.assert_allclose(splat["log_scales"], scales, atol=1 / 31)
        opacity = 1 / (1 + np.exp(-float(surfels.opacity_logits[row])))
        assert splat["opacity"] == pytest.approx(opacity, abs=1 / 500)
        before_turn = rotation_of(np.asarray(surfels.quaternions[row], np.float64))
        # A splat's axes may point either way.
        np.testing.assert_allclose(
            np.abs(np.sum(splat["rotation"] * (FLIP @ before_turn), axis=0)), 1, atol=5e-4
        )
        # A direction in the new frame has the color that it had in the old one.
        coefficients = np.vstack([splat["dc"], splat["sh"]])
        after = sh_color(coefficients, FLIP @ directions[row])
        before = sh_color(np.asarray(surfels.sh[row], np.float64), directions[row])
        np.testing.assert_allclose(after, before, atol=0.15)


def test_splats_are_placed_and_those_without_numbers_are_left_out():
    surfels = to_surfels(random_scene(2))
    surfels = surfels.replace(means=surfels.means.at[3].set(jnp.nan))
    placement = Placement(np.array([100.0, 0, 0]), 0.5)
    packed, dropped = pack_spz(surfels, jnp.ones(16, bool), placement=placement)
    found, step = by_hand(packed)
    assert dropped == 1 and len(found) == 15
    expected = FLIP @ placement.to_file(np.asarray(surfels.means[0]))
    first = min(found, key=lambda splat: np.linalg.norm(splat["position"] - expected))
    np.testing.assert_allclose(first["position"], expected, atol=0.51 * step)
    scales = np.asarray(surfels.log_scales[0]) + np.log(2)
    np.testing.assert_allclose(first["log_scales"][:2], scales, atol=1 / 31)
    thin = max(-10, scales.min() - np.log(1000))
    assert first["log_scales"][2] == pytest.approx(thin, abs=1 / 31)


def test_a_filter_that_keeps_light_is_said():
    surfels = to_surfels(random_scene(3))
    packed, _ = pack_spz(surfels, jnp.ones(16, bool), antialiased=True)
    assert len(by_hand(packed, flags=1)[0]) == 16


def test_radii_beyond_the_formats_range_are_said():
    """It has logarithms of -10 to 5.94: in millimeters a room has larger ones."""
    surfels = to_surfels(random_scene(3, num_scales=3))
    with pytest.warns(UserWarning, match="2 of 16 splats are made larger or smaller"):
        scales = surfels.log_scales.at[0].set(6.5).at[1].set(-11.0)
        scales = scales.at[2].set(jnp.array([-12.0, 0, 1]))
        pack_spz(surfels.replace(log_scales=scales), jnp.ones(16, bool))
