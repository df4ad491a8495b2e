"""Known mistakes of poses and lenses: try each, and name the one that makes matches fit."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxcloseup.captures.corrections import correct_poses
from jaxcloseup.checks.epipolar import Cameras, Fit, epipolar_errors, fit
from jaxcloseup.checks.matches import Matches


_TRIED = 3000  # matches that are tried with each mistake
_FITS = 0.7  # share of fitting matches with which a correction counts as right
_GAIN = 0.2  # by which it is better than the capture as it is, and than any other correction
_WORST = 10.0  # pixels; larger errors count as this, so that wrong matches do not lead the search
_MOST_ZOOM = math.log(10)  # of focal lengths, either way
_OUTSIDE = 0.1  # how far, in widths and heights, the principal point may lie outside of the image
_SAME = 0.02  # share of focal length or width within which two lenses are the same


class Mistake(NamedTuple):
    """A known mistake and its correction."""

    corrections: tuple[str, ...]  # as `captures.corrections` takes them
    sentence: str  # what is wrong, for example "the poses are world-to-camera"
    fit: Fit  # how well matches fit after the correction


_POSES = {
    ("axes",): "the cameras' axes are of the other convention (OpenGL's y and z, or OpenCV's)",
    ("inverse",): "the matrices are world-to-camera, not camera-to-world",
    ("inverse", "axes"): (
        "the matrices are world-to-camera, not camera-to-world, with the axes of the other "
        "convention (OpenGL's y and z, or OpenCV's)"
    ),
}


def find_mistake(matches: Matches, cameras: Cameras, *, opengl: bool) -> Mistake | None:
    """Return the only known mistake whose correction makes most matches fit, if there is one.

    Args:
      matches: matches of photographs, some.
      cameras: cameras as they were read.
      opengl: whether the files' matrices have OpenGL's axes.
    """
    matches = matches.take(slice(None, None, math.ceil(len(matches.views) / _TRIED)))
    before = fit(matches, cameras).share
    tried = [
        Mistake(corrections, sentence, fit(changed, corrected))
        for corrections, sentence, changed, corrected in _candidates(matches, cameras, opengl)
    ]
    best, *others = sorted(tried, key=lambda mistake: -mistake.fit.share)
    second = max((other.fit.share for other in others), default=0.0)
    clear = best.fit.share - max(before, second) >= _GAIN
    if best.fit.share >= _FITS and clear:
        return best
    precise = [mistake for mistake in tried if mistake.fit.all_precise]
    return precise[0] if len(precise) == 1 else None


def _candidates(
    matches: Matches, cameras: Cameras, opengl: bool
) -> Iterator[tuple[tuple[str, ...], str, Matches, Cameras]]:
    """Yield corrections, what is said of each mistake, and matches and cameras as corrected."""
    for corrections, sentence in _POSES.items():
        poses = cameras.camtoworld
        for correction in corrections:
            poses = correct_poses(poses, correction, opengl=opengl)
        yield corrections, sentence, matches, cameras._replace(camtoworld=poses)
    for turns in (1, 2, 3):
        sentence = f"the photographs are turned by {90 * turns} degrees against their poses"
        yield (f"turn={turns}",), sentence, *_turned(matches, cameras, turns)
    corrections, sentence, corrected = _lens(matches, cameras)
    if corrections:
        yield corrections, sentence, matches, corrected


def _turned(matches: Matches, cameras: Cameras, turns: int) -> tuple[Matches, Cameras]:
    """Turn photographs by quarter turns counterclockwise; their intrinsics stay those given."""
    x, y = np.moveaxis(matches.pixels, -1, 0)
    sizes, lens = cameras.sizes, cameras.intrinsics.copy()
    in_middle = np.isclose(lens[:, 2:], sizes / 2).all(-1)
    for _ in range(turns):
        x, y = y, sizes[matches.views, 0] - x
        sizes = sizes[:, ::-1]
    # A principal point that nobody gave is the middle of the photograph turned back.
    lens[in_middle, 2:] = sizes[in_middle] / 2
    pixels = np.stack([x, y], -1)
    return matches._replace(pixels=pixels), cameras._replace(intrinsics=lens, sizes=sizes)


def _lens(matches: Matches, cameras: Cameras) -> tuple[tuple[str, ...], str, Cameras]:
    """Find the focal length and principal point that fit best, and name how they differ."""
    middle = np.median(0.5 - cameras.intrinsics[:, 2:] / cameras.sizes, axis=0)
    given = 0.5 - middle
    starts = [
        (log, *center)
        for log in np.linspace(-_MOST_ZOOM, _MOST_ZOOM, 25)
        for center in ((0, 0), middle, (math.exp(log) - 1) * given)
    ]
    low, high = -_OUTSIDE - given, 1 + _OUTSIDE - given
    bounds = np.array([[-_MOST_ZOOM, *low], [_MOST_ZOOM, *high]])
    zoom, *center = _search(matches, cameras, starts, bounds)
    zoom, moved = math.exp(zoom), np.array(center)
    best = _with_lens(cameras, zoom, moved)
    if np.abs(moved).max() < _SAME and abs(zoom - 1) < _SAME:
        return (), "", best
    if np.abs(moved - (zoom - 1) * given).max() < _SAME and abs(zoom - 1) > _SAME:
        size = _simple(1 / zoom)
        simple = _with_lens(cameras, 1 / size, (1 / size - 1) * given)
        if fit(matches, simple).share < fit(matches, best).share - _SAME:
            size, simple = 1 / zoom, best
        sentence = f"the intrinsics are of photographs {size:.3g} times as large"
        return (f"size={size:.6g}",), sentence, simple
    corrections, parts = [], []
    if abs(zoom - 1) > _SAME:
        corrections.append(f"focal={zoom:.6g}")
        parts.append(f"the focal length is {zoom:.3g} times the given one")
    if np.abs(moved).max() > _SAME:
        corrections.append(f"center={moved[0]:.6g},{moved[1]:.6g}")
        parts.append(
            f"the principal point lies {100 * moved[0]:.0f} % of the width and "
            f"{100 * moved[1]:.0f} % of the height from the given one, as in cropped photographs"
        )
    return tuple(corrections), " and ".join(parts), best


def _simple(factor: float) -> float:
    """Return the fraction of small numbers next to a factor of sizes, or the factor."""
    small = [a / b for a in range(1, 9) for b in range(1, 9)]
    nearest = min(small, key=lambda ratio: abs(ratio / factor - 1))
    return nearest if abs(nearest / factor - 1) < 2 * _SAME else factor


def _with_lens(cameras: Cameras, zoom: float, moved: np.ndarray) -> Cameras:
    lens = cameras.intrinsics * np.array([zoom, zoom, 1, 1])
    lens[:, 2:] += moved * cameras.sizes
    return cameras._replace(intrinsics=lens)


def _search(
    matches: Matches, cameras: Cameras, starts: Sequence[tuple[float, ...]], bounds: np.ndarray
) -> tuple[float, ...]:
    """Return log zoom and move of the principal point with the smallest errors, by pattern search.

    Args:
      matches: matches of photographs.
      cameras: cameras as they were read.
      starts: parameters to begin with; the best is refined.
      bounds: `[2, 3]` smallest and largest parameters.
    """

    def cost(parameters: tuple[float, ...]) -> float:
        changed = _with_lens(cameras, math.exp(parameters[0]), np.array(parameters[1:]))
        return float(np.minimum(epipolar_errors(matches, changed), _WORST).mean())

    best, lowest = min(((start, cost(start)) for start in starts), key=lambda pair: pair[1])
    step = 0.08
    while step > 1e-3:
        around = [
            tuple(np.clip(np.add(best, sign * step * np.eye(3)[axis]), *bounds))
            for axis in range(3)
            for sign in (-1, 1)
        ]
        nearest, found = min(((at, cost(at)) for at in around), key=lambda pair: pair[1])
        if found < lowest:
            best, lowest = nearest, found
        else:
            step /= 2
    return best
