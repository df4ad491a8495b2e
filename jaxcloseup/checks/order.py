"""Find which pose belongs to which photograph, where their order differs."""

from collections.abc import Sequence

import numpy as np

from jaxcloseup.checks.epipolar import FITTING, Cameras, epipolar_errors
from jaxcloseup.checks.matches import Matches


_SEEDS = 8  # pairs of photographs with which an assignment may begin
_USED = 24  # matches of a pair that are tried
_FITS = 0.6  # share of a photograph's matches with which a pose is taken


def find_order(matches: Matches, cameras: Cameras) -> np.ndarray | None:
    """Return the order of poses in which matches fit, or None if there is none.

    An assignment begins with the two poses that fit a pair of photographs best, and grows by one
    photograph a time: the one with most matches to those that have a pose, with the free pose that
    fits these. Several beginnings are tried, and the assignment with most fitting matches wins.

    Args:
      matches: matches of photographs.
      cameras: cameras, pose i beside photograph i.

    Returns:
      `[V]` index of the pose of each photograph, or None.
    """
    pairs = _pairs(matches)
    best, most = None, _FITS
    count = len(cameras.intrinsics)
    by_size = sorted(pairs, key=lambda pair: -len(pairs[pair].views))
    for seed in by_size[:: max(1, len(by_size) // _SEEDS)][:_SEEDS]:
        order = _grow(seed, pairs, cameras)
        given = cameras._replace(camtoworld=cameras.camtoworld[order])
        share = float(np.mean(epipolar_errors(matches, given) <= FITTING))
        if share > most:
            best, most = order, share
    return best if best is not None and (best != np.arange(count)).any() else None


def _pairs(matches: Matches) -> dict[tuple[int, int], Matches]:
    """Return up to `_USED` matches of each pair of photographs, spread over all of them."""
    found = {}
    for pair in np.unique(matches.views, axis=0):
        rows = np.flatnonzero((matches.views == pair).all(-1))
        some = rows[np.linspace(0, len(rows) - 1, min(_USED, len(rows))).astype(int)]
        found[int(pair[0]), int(pair[1])] = matches.take(some)
    return found


def _grow(
    seed: tuple[int, int], pairs: dict[tuple[int, int], Matches], cameras: Cameras
) -> np.ndarray:
    """Assign poses to photographs, beginning with a pair; those that none fits share out a rest."""
    count = len(cameras.intrinsics)
    order: dict[int, int] = {}
    seeds = [seed, *sorted(pairs, key=lambda pair: -len(pairs[pair].views))]
    for first, second in seeds:  # more than one where photographs form groups without matches
        if first in order or second in order:
            continue
        free = _free(order, count)
        table = _shares(pairs[first, second], (first, second), free, free, cameras)
        np.fill_diagonal(table, -1)
        a, b = np.unravel_index(np.argmax(table), table.shape)
        if table[a, b] >= _FITS:
            order |= {first: int(free[a]), second: int(free[b])}
            _spread(order, pairs, cameras)
    rest = iter(_free(order, count))
    return np.array([order[view] if view in order else next(rest) for view in range(count)])


def _free(order: dict[int, int], count: int) -> np.ndarray:
    return np.setdiff1d(np.arange(count), list(order.values()))


def _spread(order: dict[int, int], pairs: dict[tuple[int, int], Matches], cameras: Cameras) -> None:
    """Add poses of photographs that have matches with those of an order, one a time."""
    refused: set[int] = set()
    while len(free := _free(order, len(cameras.intrinsics))):
        waiting: dict[int, list[tuple[int, int]]] = {}
        for first, second in pairs:
            if (first in order) != (second in order):
                view = second if first in order else first
                if view not in refused:
                    waiting.setdefault(view, []).append((first, second))
        if not waiting:
            return
        view = max(waiting, key=lambda v: sum(len(pairs[pair].views) for pair in waiting[v]))
        scores = np.zeros(len(free))
        for first, second in waiting[view]:
            matches = pairs[first, second]
            if view == first:
                known = [order[second]]
                scores += _shares(matches, (first, second), free, known, cameras)[:, 0]
            else:
                known = [order[first]]
                scores += _shares(matches, (first, second), known, free, cameras)[0]
        if scores.max() >= _FITS * len(waiting[view]):
            order[view] = int(free[scores.argmax()])
            refused.clear()
        else:
            refused.add(view)


def _shares(
    matches: Matches,
    pair: tuple[int, int],
    first: Sequence[int] | np.ndarray,
    second: Sequence[int] | np.ndarray,
    cameras: Cameras,
) -> np.ndarray:
    """Return the share of a pair's matches that fit, `[A, B]`, for poses of both photographs."""
    a, b = (np.ravel(x) for x in np.meshgrid(first, second, indexing="ij"))
    size = len(matches.views)
    # One camera for each combination of a photograph's lens and a pose.
    lenses = np.concatenate([np.tile(cameras.intrinsics[view], (len(a), 1)) for view in pair])
    sizes = np.concatenate([np.tile(cameras.sizes[view], (len(a), 1)) for view in pair])
    combined = Cameras(cameras.camtoworld[np.concatenate([a, b])], lenses, sizes)
    views = np.repeat(np.stack([np.arange(len(a)), len(a) + np.arange(len(a))], -1), size, axis=0)
    pixels = np.tile(matches.pixels, (len(a), 1, 1))
    copies = Matches(views, pixels, np.zeros((len(pixels), 2, 3), np.uint8))
    inside = epipolar_errors(copies, combined) <= FITTING
    return inside.reshape(len(first), len(second), size).mean(-1)
