"""Response curves: what light a camera's colors stand for, where it is not what sRGB encodes.

Two photographs of one point at different exposures tell the slope of the curve between their
colors. The curve is then known up to a power of the light, which needs exposures that are known.
"""

from typing import NamedTuple

import numpy as np

from jaxcloseup.photos.exposures import USABLE, solve_gains


LEVELS = 256  # colors at which a curve says what light they stand for, from black to white
_KNOTS = 6  # colors, from black to white, between which slopes are linear
_PAIRINGS = 8  # other photographs that each is compared with
_PHOTOGRAPHS = 200  # of a camera that are compared, at most
_MOST = 60_000  # of their colors, about; so 300 points stay, however many photographs show them
_FEWEST = 200  # points and pairs that tell something
_LEAST = 0.05  # residual of log light below which all count alike
_APART = 0.1  # least difference of log gains whose pair tells a slope
_ROUNDS, _TURNS = 6, 3  # of reweighting; of gains and curve
_EQUAL = 1e-3  # weight of slopes on a line, and a fifth of it of slopes of 1, in all pairs
_STEEP = 4.0  # largest slope, and inverse of the smallest
# Share of the error at left-out points that a curve may leave, to be used: curves that left 83 and
# 94 % made renders worse.
_BETTER = 0.75


def srgb_curve(colors: np.ndarray) -> np.ndarray:
    """Return the light of colors as sRGB encodes it, in float64."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


SRGB = srgb_curve(np.linspace(0, 1, LEVELS))


def fit_response(logs: np.ndarray) -> np.ndarray | None:
    """Return the light `[LEVELS]` of a camera's colors; None where sRGB's is as good.

    Its power is such that slopes against sRGB's are 1 on average, and its scale such that the
    mean log light of all points stays as it is.

    Args:
      logs: `[V, P, 3]` log light of points as sRGB encodes it; NaN where a photograph of the camera
        does not show a point.
    """
    # At random, because exposures may repeat in a sequence.
    logs = logs[np.sort(np.random.default_rng(2).permutation(len(logs))[:_PHOTOGRAPHS])]
    shown = np.isfinite(logs[..., 0])
    shared = shown.sum(axis=0) > 1
    step = max(1, shown[:, shared].sum() // _MOST)
    logs = np.asarray(logs[:, shared][:, ::step], np.float64)
    if logs.shape[1] < _FEWEST:
        return None
    half = np.random.default_rng(0).random(logs.shape[1]) < 0.5
    slopes, gains = _solve(logs[:, half])
    left_out = _compare(logs[:, ~half], gains)
    straight = _compare(logs[:, ~half], solve_gains(logs[:, half]))
    if min(len(left_out.change), len(straight.change)) < _FEWEST:
        return None
    if left_out.error(slopes) > _BETTER * straight.error(np.ones(_KNOTS)):
        return None
    return _curve(_solve(logs)[0], logs)


def straighten(logs: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """Return log light by a curve `[LEVELS]`, from log light as sRGB encodes it."""
    return np.interp(logs, np.log(SRGB[1:]), np.log(curve[1:]))


class _Pairs(NamedTuple):
    """Colors of points in two photographs, N in all."""

    change: np.ndarray  # `[N]` by how much their log light as sRGB encodes it differs
    gain: np.ndarray  # `[N]` by how much log gains differ
    knot: np.ndarray  # `[N]` knot below the color between them
    share: np.ndarray  # `[N]` of the next knot

    def residual(self, slopes: np.ndarray) -> np.ndarray:
        """Return `[N]` what slopes at the knots leave of the changes."""
        return self.change - self.gain * _slope(slopes, self.knot, self.share)

    def error(self, slopes: np.ndarray) -> float:
        """Return the median absolute residual; wrong matches do not count."""
        return float(np.median(np.abs(self.residual(slopes))))


def _solve(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes `[_KNOTS]` of log light as sRGB encodes it over log light, and gains."""
    gains = solve_gains(logs)
    for _ in range(_TURNS):
        slopes = _fit_slopes(_compare(logs, gains))
        gains = solve_gains(straighten(logs, _curve(slopes, logs)))
    return slopes, gains


def _compare(logs: np.ndarray, gains: np.ndarray) -> _Pairs:
    """Pair photographs at random.

    A pair counts by its middle and its gains alone, not by its change, whose noise would tell the
    slope; so no change reaches beyond what photographs show.
    """
    rng = np.random.default_rng(1)
    low, high = np.log(srgb_curve(np.array(USABLE)))
    found = []
    for _ in range(_PAIRINGS):
        order = rng.permutation(len(logs))
        change, middle = logs - logs[order], (logs + logs[order]) / 2
        gain = np.broadcast_to((gains - gains[order])[:, None], logs.shape)
        reach = 0.75 * np.abs(gain) + 0.1
        counts = (np.abs(gain) > _APART) & (middle + reach < high) & (middle - reach > low)
        found.append(np.stack([change[counts], gain[counts], middle[counts]]))
    change, gain, middle = np.concatenate(found, axis=1)
    return _Pairs(
        change, gain, *_at_knots(np.interp(np.exp(middle), SRGB, np.linspace(0, 1, LEVELS)))
    )


def _at_knots(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    place = np.clip(colors, 0, 1) * (_KNOTS - 1)
    knot = np.minimum(place.astype(int), _KNOTS - 2)
    return knot, place - knot


def _slope(slopes: np.ndarray, knot: np.ndarray, share: np.ndarray) -> np.ndarray:
    return slopes[knot] * (1 - share) + slopes[knot + 1] * share


def _fit_slopes(pairs: _Pairs) -> np.ndarray:
    """Fit slopes `[_KNOTS]` with small absolute residuals, smooth where few pairs tell them."""
    slopes = np.ones(_KNOTS)
    bend = np.diff(np.eye(_KNOTS), 2, axis=0)
    parts = pairs.gain * (1 - pairs.share), pairs.gain * pairs.share
    for _ in range(_ROUNDS if len(pairs.change) else 0):
        weight = _LEAST / np.maximum(np.abs(pairs.residual(slopes)), _LEAST)
        system, wanted = np.zeros((_KNOTS, _KNOTS)), np.zeros(_KNOTS)
        for i, one in enumerate(parts):
            wanted += np.bincount(pairs.knot + i, weight * one * pairs.change, _KNOTS)
            for j, other in enumerate(parts):
                sums = np.bincount(pairs.knot, weight * one * other, _KNOTS - 1)
                system[np.arange(_KNOTS - 1) + i, np.arange(_KNOTS - 1) + j] += sums
        held = _EQUAL * np.trace(system)
        system += held * (bend.T @ bend + 0.2 * np.eye(_KNOTS))
        slopes = np.linalg.solve(system, wanted + 0.2 * held)
        slopes = np.clip(slopes, 1 / _STEEP, _STEEP)
        scale = np.average(_slope(slopes, pairs.knot, pairs.share), weights=weight * pairs.gain**2)
    return slopes / scale if len(pairs.change) else slopes


def _curve(slopes: np.ndarray, logs: np.ndarray) -> np.ndarray:
    """Return the light `[LEVELS]` of colors by slopes at the knots."""
    colors = np.linspace(0, 1, 16 * LEVELS + 1)[1:]
    slope = _slope(slopes, *_at_knots(colors))
    encoded = np.log(srgb_curve(colors))
    steps = np.diff(encoded) * 2 / (slope[1:] + slope[:-1])
    light = np.concatenate([[0], np.cumsum(steps)])
    known = logs[np.isfinite(logs)]
    light -= np.mean(np.interp(known, encoded, light) - known)
    return np.concatenate([[0], np.exp(np.interp(np.log(SRGB[1:]), encoded, light))])
